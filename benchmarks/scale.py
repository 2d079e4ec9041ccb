"""How S4A starts, and how its steps grow with the number of shapes.

``scale.py start`` measures processes from their first moment on: CPU seconds, the least of five,
and peak memory.  ``scale.py left_out 800`` computes leave-one-out of so many shapes in both ways,
``scale.py open 1000`` opens a study of so many small shapes, ``scale.py growth 50 100 200 400``
analyses so many tiny ones and fits the exponents of every stage.
"""

import contextlib
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import s4a
from s4a import synthetic
from s4a.analysis import model
from s4a.study import netcdf, store
from s4a.study.runner import Run

STARTS = {
    "python, nothing": ["-c", ""],
    "import s4a": ["-c", "import s4a"],
    "s4a --help": ["-m", "s4a", "--help"],
    "s4a run --help": ["-m", "s4a", "run", "--help"],
    "from s4a import analyse": ["-c", "from s4a import analyse"],
    "a worker's imports": ["-c", "import s4a.study.runner, s4a.study.tasks"],
    "from s4a import statistics": ["-c", "from s4a import statistics"],
}


def say(text):
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


# Runs what follows as -c or -m, and says its own peak at last: ru_maxrss begins with the parent's.
WITH_PEAK = """
import atexit, sys
def say():
    with open("/proc/self/status") as status:
        sys.stderr.write(next(line for line in status if line.startswith("VmHWM")))
atexit.register(say)
kind, what, *sys.argv[1:] = sys.argv[1:]
if kind == "-c":
    exec(what)
else:
    import runpy
    runpy.run_module(what, run_name="__main__", alter_sys=True)
"""


def cost(arguments):
    """CPU seconds of a Python with these arguments, seconds of the clock, its peak in MiB."""
    begin = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-c", WITH_PEAK, *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    said = process.stderr.read()
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, arguments
    wall = time.perf_counter() - begin
    return used.ru_utime + used.ru_stime, wall, int(said.split("VmHWM:")[1].split()[0]) / 1024


def start():
    """What a process costs before it computes anything."""
    say(f"\n{'':28} {'CPU s':>8} {'wall s':>8} {'MiB':>8}")
    for name, arguments in STARTS.items():
        cpu, wall, memory = map(min, zip(*(cost(arguments) for _ in range(5)), strict=True))
        say(f"{name:28} {cpu:8.2f} {wall:8.2f} {memory:8.0f}")


def left_out(*sizes):
    """Leave-one-out: the components of all shapes but one from those of all, and each again."""
    say(f"\n{'shapes':>8} {'CPU s':>8} {'again':>8} {'largest difference of the errors':>36}")
    for s in sizes or (100, 200, 400):
        x = np.random.default_rng(0).normal(size=(s, 2000)) * np.linspace(1, 0.01, 2000)
        K = x @ x.T
        begin = time.process_time()
        error, _ = model.leave_one_out(K)
        between = time.process_time()
        again = []
        for i in range(s):
            others = np.delete(np.arange(s), i)
            rows = K[np.ix_(others, others)], K[i, others], K[i, i]
            again.append(model.describe_by_others(*rows)[0])
        spent = between - begin, time.process_time() - between
        gap = np.abs(error - again).max() / error.max()
        say(f"{s:8} {spent[0]:8.2f} {spent[1]:8.2f} {gap:36.1e}")


def study_of(n, folder):
    """The study of four small brains as one of n: their files under other names."""
    s4a.analyse(synthetic.brains(4, 1000), store=folder, n_jobs=1, n_coarse=300, k=20, n_pairs=6)
    own = [path.stem for path in sorted((folder / "original").glob("*.nc"))]
    names = [*own, *(f"copy_{i:04d}" for i in range(4, n))]
    for i, name in enumerate(names[4:]):
        for stage in ("original", "coarse", "registration"):
            shutil.copy(folder / stage / f"{own[i % 4]}.nc", folder / stage / f"{name}.nc")
    for of_all in ("latent", "report"):
        data = netcdf.read(folder / f"{of_all}.nc")
        key, made_from = data.attrs["task_key"], data.attrs["made_from"].split()
        data = data.isel(shape=np.arange(n) % 4).assign_coords(shape=names)
        store.write(data, folder / f"{of_all}.nc", key, made_from)
    return names


def opened(folder):
    """CPU seconds of opening a study, of reading one shape, MiB of both, and files left open."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, 256))
    open_study = s4a.open_study
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin = time.process_time()
    study = open_study(folder)
    between = time.process_time()
    study["registration"]["displacement"][-1].load()
    spent = between - begin, time.process_time() - between
    n_open = len(os.listdir("/proc/self/fd")) if sys.platform == "linux" else -1
    return *spent, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024, n_open


def opening(*sizes):
    """How long a study of so many small shapes takes to open, with at most 256 open files."""
    say(f"\n{'shapes':>8} {'open s':>8} {'one s':>8} {'MiB':>8} {'files open':>11}")
    for n in sizes or (50, 200):
        with tempfile.TemporaryDirectory() as folder:
            study_of(n, Path(folder) / "study")
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                found = pool.submit(opened, Path(folder) / "study").result()
        say("{:8} {:8.2f} {:8.3f} {:8.0f} {:11}".format(n, *found))


def spent_on(n):
    """CPU seconds of every stage of n tiny shapes, with four pairs each, and of what follows."""
    spent, stage = {}, Run.stage

    @contextlib.contextmanager
    def timed(self, name, *arguments, **options):
        begin = time.process_time()
        with stage(self, name, *arguments, **options):
            yield
        spent[name] = time.process_time() - begin

    Run.stage = timed
    with tempfile.TemporaryDirectory() as folder:
        # of meshes as coarse as these some registrations are flagged
        options = {"n_coarse": 150, "k_init": 8, "k": 12, "include_flagged": True}
        s4a.analyse(synthetic.brains(n, 500), store=folder, n_jobs=1, n_pairs=4 * n, **options)
        begin = time.process_time()
        study = s4a.open_study(folder)
        spent["open the study"] = time.process_time() - begin
        begin = time.process_time()
        s4a.statistics.outliers(study)
        spent["outliers"] = time.process_time() - begin
    return spent


def growth(*sizes):
    """How the CPU seconds of every stage grow with the shapes: the slope of their logarithms."""
    sizes = sizes or (50, 100, 200, 400)
    found = []
    for n in sizes:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            found.append(pool.submit(spent_on, n).result())
    say(f"\nCPU seconds, one process, {', '.join(map(str, sizes))} shapes of 500 vertices")
    for stage in found[0]:
        seconds = np.array([max(one[stage], 1e-3) for one in found])
        slope = np.polyfit(np.log(sizes), np.log(seconds), 1)[0]
        say(f"{stage:32} {' '.join(f'{s:8.2f}' for s in seconds)}   exponent {slope:5.2f}")


PARTS = {"start": start, "left_out": left_out, "open": opening, "growth": growth}

if __name__ == "__main__":
    part, *words = sys.argv[1:] or [""]
    for run in [PARTS[part]] if part else PARTS.values():
        run(*map(int, words))
