"""Runs that are killed at random moments, and what the next run makes of them.

``python benchmarks/kills.py [--kills 100] [--dask 20]``.

Each kill hits ``s4a run`` over a small collection, with one or two processes, at a random time or
when a random file of the study has just been written.  It is asked how long any process of the run
lives on, what it leaves in memory and among temporary files, and, when the run was started again
(and killed again, until it came to its end), whether every file of the study is that of an
undisturbed run.

A power cut kills all processes at once; then every file that was not synchronized with the disk
loses its content, all or a part, or its name, and every file may lose the name that it was given
last.
"""

import argparse
import contextlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from s4a import cli, synthetic
from s4a.study import netcdf

SMALL = "--no-intersections --include-flagged --n-coarse 100 --k-init 8 --k 12".split()
STAGES = {  # the first file of each, the last stage first
    "modes, report": "pca.nc",
    "registration": "registration.nc",
    "Consistent ZoomOut": "network.nc",
    "initial maps": "network/initial_*.nc",
    "align": "network/alignment_*.nc",
    "remesh": "coarse/*.nc",
    "compare": "network/comparison_*.nc",
    "read and clean": "original/*.nc",
    "start": "",
}
# who gets which signal
KINDS = {
    "SIGINT, Ctrl-C": (signal.SIGINT, "group"),
    "SIGTERM": (signal.SIGTERM, "run"),
    "SIGHUP, terminal closed": (signal.SIGHUP, "group"),
    "SIGKILL": (signal.SIGKILL, "run"),
    "SIGKILL of a worker": (signal.SIGKILL, "worker"),
    "power cut": (signal.SIGKILL, "group"),
}
OF_DASK = {
    "SIGKILL of a worker of dask": (signal.SIGKILL, "worker"),
    "SIGKILL of its client": (signal.SIGKILL, "run"),
}
TWO = ("--n-jobs", "2")
# in every process of a run: which files are safe from a power cut
JOURNAL = """
import os
synchronize, journal = os.fsync, os.environ["JOURNAL"]
def fsync(handle):
    if os.environ.get("UNSYNCHRONIZED"):
        return
    synchronize(handle)
    with open(journal, "a") as told:
        told.write(f"{os.fstat(handle).st_ino}\\n")
os.fsync = fsync
"""


class Forked:
    """A run of the command line in a session of its own: nothing is imported again."""

    def __init__(self, arguments, env, folder):
        self.code, self.folder = None, folder
        self.pid = os.fork()
        if self.pid:
            return
        os.setsid()
        said = os.open(folder / "said", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(said, 1)
        os.dup2(said, 2)
        os.environ.update(env)
        tempfile.tempdir = env["TMPDIR"]
        # they are ignored below a background job of a shell, and below nohup
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        exec(JOURNAL, {})
        code = 1
        with contextlib.suppress(SystemExit):  # as of a library that gives up
            code = cli.main(list(map(str, arguments)))
        os._exit(code)

    def poll(self):
        """The exit code, None while it runs; that of a signal is negative."""
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.code = os.waitstatus_to_exitcode(status) if pid else None
        return self.code

    def wait(self):
        """The exit code, once there is one."""
        while self.poll() is None:
            time.sleep(0.01)
        return self.code

    def said(self):
        """What it wrote."""
        return (self.folder / "said").read_text()

    def workers(self):
        """Its worker processes."""
        found = []
        with contextlib.suppress(psutil.NoSuchProcess):  # one that has just ended, too
            for process in psutil.Process(self.pid).children():
                if "LokyProcess" in " ".join(process.cmdline()):
                    found.append(process)
        return found


class Bench:
    """A collection, the study of an undisturbed run, and the environment of the others."""

    def __init__(self, folder, unsynchronized=False):
        self.folder = Path(folder)
        self.files = synthetic.write(synthetic.brains(3, 200, seed=2), self.folder / "meshes")
        self.files[0].with_name("truth.nc").unlink()
        (self.folder / "hook").mkdir()
        (self.folder / "hook" / "sitecustomize.py").write_text(JOURNAL)
        (self.folder / "tmp").mkdir()
        self.journal = self.folder / "journal"
        path = os.pathsep.join([str(self.folder / "hook"), os.environ.get("PYTHONPATH", "")])
        self.env = {"PYTHONPATH": path, "JOURNAL": str(self.journal), "OMP_NUM_THREADS": "1"}
        self.env |= {"TMPDIR": str(self.folder / "tmp")}
        if unsynchronized:
            self.env["UNSYNCHRONIZED"] = "1"
        self.study, self.pids = self.folder / "study", set()
        begin = time.monotonic()
        process = self.start(*TWO)
        assert process.wait() == 0, process.said()
        self.seconds = time.monotonic() - begin
        self.whole = contents(self.study)
        shutil.rmtree(self.study)

    def start(self, *flags):
        """A run over the collection."""
        return Forked(
            ["run", *self.files, "--out", self.study, *SMALL, *flags], self.env, self.folder
        )

    def wait_for_moment(self, process, rng):
        """Wait for a random time or file; whether the run is still there then."""
        written = list_files(self.study)
        if rng.random() < 0.3:
            end, enough = time.monotonic() + rng.uniform(0, self.seconds), len(self.whole) + 1
        else:
            end, enough = float("inf"), rng.randint(*sorted((len(written) + 1, len(self.whole))))
        while process.poll() is None and time.monotonic() < end:
            if len(list_files(self.study)) >= enough:
                time.sleep(rng.uniform(0, 0.2))
                break
            time.sleep(0.005)
        return process.poll() is None

    def is_whole(self):
        """Whether every file of the study is that of the undisturbed run."""
        found = contents(self.study)
        wrong = [f for f in self.whole if f not in found or not self.whole[f].identical(found[f])]
        more = sorted(set(found) - set(self.whole))
        if wrong or more:
            sys.stdout.write(f"differ: {wrong}; not in the undisturbed study: {more}\n")
        return not (wrong or more)

    def cut_power(self, rng):
        """Drop what the disk need not have of the files of the study."""
        safe = set(self.journal.read_text().split()) if self.journal.exists() else set()
        for path in [path for path in self.study.rglob("*") if path.is_file()]:
            size, chance = path.stat().st_size, rng.random()
            if str(path.stat().st_ino) in safe:
                if chance < 0.2 and path.suffix == ".nc":  # the name that it had before
                    path.rename(path.with_name(f".{path.name}.{rng.randint(2, 32768)}.tmp"))
            elif chance < 0.25:
                path.unlink()
            elif chance < 0.5:
                path.write_bytes(b"")
            elif chance < 0.75 and size > 8192:  # its last blocks
                with path.open("r+b") as file:
                    file.seek(rng.randrange(4096, size, 4096))
                    file.write(bytes(size - file.tell()))


def list_files(study):
    """The finished files of a study."""
    return list(study.rglob("[!.]*.nc"))


def contents(study):
    """Every file of a study, without what the clock says."""
    found = {}
    for path in list_files(study):
        data, file = netcdf.read(path), path.relative_to(study).as_posix()
        found[file] = data.drop_dims("stage") if file == "report.nc" else data
    return found


def members(session):
    """The living processes of a session."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, ProcessLookupError):
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
    return found


def seconds_until_gone(session, limit=30):
    """How long processes of a session live on; they are ended after the limit."""
    begin = time.monotonic()
    while time.monotonic() - begin < limit:
        if not members(session):
            return time.monotonic() - begin
        time.sleep(0.01)
    for process in members(session):
        process.kill()
    return float("inf")


def left_behind(bench, pid=""):
    """Semaphores and memory maps of a process, or of all that are no more; temporary folders."""
    shared = Path("/dev/shm")
    found = [*shared.glob(f"sem.loky-{pid}*"), *shared.glob(f"joblib_memmapping_folder_{pid}*")]
    if not pid:
        found = [path for path in found if int(re.search(r"\d+", path.name)[0]) in bench.pids]
    # that of dask stays, and dask empties it
    return [*found, *(bench.folder / "tmp").glob("[!d]*")]


def stage_of(study):
    """The stage that a run had come to."""
    return next(stage for stage, file in STAGES.items() if not file or any(study.glob(file)))


def kill_at_random(bench, n_kills, rng, kinds, flags=(), workers=Forked.workers):
    """Kill runs and start them again; what was seen of each kind of kill, and what went wrong."""
    seen = {
        kind: {"times": 0, "gone": [], "stages": set(), "left": 0, "equal": 0} for kind in kinds
    }
    hit, wrong, kill, equal = [], 0, 0, True
    while kill < n_kills or hit:
        next_kind = list(kinds)[kill % len(kinds)]
        n_jobs = 2 if kinds[next_kind][1] == "worker" else rng.choice((1, 2, 2))
        process = bench.start(*(flags or ("--n-jobs", n_jobs)))
        bench.pids.add(process.pid)
        if kill < n_kills and bench.wait_for_moment(process, rng):
            kind, (number, who) = next_kind, kinds[next_kind]
            seen[kind]["stages"].add(stage_of(bench.study))
            seen[kind]["times"] += 1
            hit.append(kind)
            kill += 1
            if who == "worker":
                if found := workers(process):
                    rng.choice(found).send_signal(number)
            else:
                (os.killpg if who == "group" else os.kill)(process.pid, number)
                seen[kind]["gone"].append(seconds_until_gone(process.pid))
                process.wait()
                left = left_behind(bench, process.pid)
                if kind == "power cut":
                    bench.cut_power(rng)
                    for path in left:  # memory is empty then
                        shutil.rmtree(path) if path.is_dir() else path.unlink()
                else:
                    seen[kind]["left"] += bool(left)
                continue
        code = process.wait()
        equal = code == 0 and bench.is_whole()
        if not equal:
            wrong += 1
            sys.stdout.write(f"after {hit}: exit {code}: {process.said()}\n")
        for kind in hit:
            seen[kind]["equal"] += equal
        sys.stderr.write(f"{kill} kills: {', '.join(hit)}: {'equal' if equal else 'DIFFER'}\n")
        hit = []
        shutil.rmtree(bench.study)
        bench.journal.unlink(missing_ok=True)
    return seen, wrong


def table(seen):
    """The kills as a table."""
    head = ["kill", "times", "stages", "seconds until all processes are gone, median, most"]
    head += ["left something behind", "resumed, the same bits"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for kind, row in seen.items():
        gone = sorted(row["gone"])
        spent = f"{gone[len(gone) // 2]:.2f}, {gone[-1]:.2f}" if gone else ""
        cells = [kind, row["times"], f"{len(row['stages'])} of {len(STAGES)}", spent, row["left"]]
        lines.append("| " + " | ".join(map(str, [*cells, row["equal"]])) + " |")
    return "\n".join(lines)


@contextlib.contextmanager
def dask_cluster(folder):
    """A scheduler and two workers, each with a nurse that starts it again; address and workers."""
    file = folder / "scheduler.json"
    dask = [sys.executable, "-m"]
    scheduler = ["distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    worker = ["distributed.cli.dask_worker", "--nworkers", "2", "--nthreads", "1"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": folder}
    with contextlib.ExitStack() as stack:
        for words in ([*scheduler, "--scheduler-file", file], [*worker, "--scheduler-file", file]):
            process = subprocess.Popen([*dask, *map(str, words)], **quiet)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            while not file.exists():
                time.sleep(0.1)
        nurse = psutil.Process(process.pid)

        def workers(_):
            spawned = [p for p in nurse.children() if "spawn_main" in " ".join(p.cmdline())]
            return spawned

        while len(workers(None)) < 2:
            time.sleep(0.1)
        yield json.loads(file.read_text())["address"], workers


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--dask", type=int, default=20, help="kills with workers of dask")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--unsynchronized", action="store_true", help="as if the disk were never waited for"
    )
    args = parser.parse_args(arguments)
    rng, begin = random.Random(args.seed), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(folder, args.unsynchronized)
        seen, wrong = kill_at_random(bench, args.kills, rng, KINDS)
        if args.dask:
            with dask_cluster(bench.folder) as (address, workers):
                flags = ("--cluster", address)
                found = kill_at_random(bench, args.dask, rng, OF_DASK, flags, workers)
            local = {"SIGKILL of a run with --cluster local:2": (signal.SIGKILL, "run")}
            more = kill_at_random(bench, args.dask // 2, rng, local, ("--cluster", "local:2"))
            seen, wrong = seen | found[0] | more[0], wrong + found[1] + more[1]
        left = left_behind(bench)
        sys.stdout.write(f"{table(seen)}\n{wrong} studies differ; left behind: {left or 'nothing'}")
    sys.stdout.write(f"; {time.monotonic() - begin:.0f} s\n")
    if args.unsynchronized:  # it is asked how many differ then
        wrong = 0
    return 1 if wrong or left else 0


if __name__ == "__main__":
    sys.exit(main())
