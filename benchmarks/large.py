"""A large collection from its files to its modes, killed in every stage, and how it grows.

``large.py run 1000`` writes so many synthetic brains of ``--vertices 20000`` into a folder,
analyses them there by ``s4a run`` with five pairs a shape, kills that with SIGKILL half-way through
every stage, and starts it again.  ``large.py sum`` prints what every run in that folder took, by
stage, and the exponents in the number of shapes.  ``--whole`` kills nothing; ``--twice`` compares
the killed study with one that was not, file by file.  ``large.py insert 20`` inserts so
many into a study of twelve: one by one, together, and by a dask cluster of four workers, one of
which is killed.

CPU seconds and memory are those of all processes of the run, looked at every half second; memory is
the sum of their resident sets, in which pages that they share count for each.
"""

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import joblib
import numpy as np
import psutil

import s4a
from s4a import synthetic
from s4a.study import netcdf
from s4a.study.progress import FILE, STAGES

BATCH = 50  # brains that are made at once, all of one population
LOOK = 0.5  # seconds between two looks at the processes
START = "start"


def say(text):
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def collection(n, n_vertices, folder):
    """The first n of a series of brains, as files; those that are there are not made again."""
    folder.mkdir(parents=True, exist_ok=True)
    while (done := len(list(folder.glob("*.ply")))) < n:
        seed, some = done // BATCH, min(BATCH, n - done)
        new = folder / "new"
        for i, file in enumerate(synthetic.write(synthetic.brains(some, n_vertices, seed), new)):
            file.rename(folder / f"brain_{done + i:05d}.ply")
        shutil.rmtree(new)
    return sorted(folder.glob("*.ply"))[:n]


def stage_of(study, pid):
    """The stage that a run is at, how many of its tasks were done, are, and are in all."""
    said = {}
    with contextlib.suppress(FileNotFoundError):
        said = json.loads((study / FILE).read_text())
    if said.get("owner") == pid:  # not what the one before it said
        for name, (done, of, had, *_, ended) in said["stages"].items():
            if not ended:
                return name, had, done, of
    return START, 0, 0, 0


def files_of(study):
    """The finished files of a study: path -> what tells whether it was written again."""
    found = {}
    for path in study.rglob("[!.]*.nc"):
        with contextlib.suppress(FileNotFoundError):
            about = path.stat()
            found[path.relative_to(study).as_posix()] = about.st_ino, about.st_mtime_ns
    return found


class Watch:
    """CPU seconds and peak memory of a run and of all processes below it, by stage."""

    def __init__(self, kept=None):
        self.stages = kept or {}
        self.cpu = {}

    def look(self, process, stage):
        """Add what the processes took since the last look to the stage."""
        memory, family = 0.0, []
        with contextlib.suppress(psutil.Error):
            family = [process, *process.children(recursive=True)]
        found = self.stages.setdefault(stage, {"cpu": 0.0, "wall": 0.0, "memory": 0.0})
        for one in family:
            with contextlib.suppress(psutil.Error):
                key = str((one.pid, one.create_time()))
                spent = one.cpu_times()
                now = spent.user + spent.system
                found["cpu"] += now - self.cpu.get(key, 0.0)
                self.cpu[key] = now
                memory += one.memory_info().rss / 2**20
        found["memory"] = max(found["memory"], memory)


def run_until(command, study, watch, after):
    """Run a command until it ends, or until it is to be killed; the stage of that, its exit code.

    It is killed half-way through the first stage for which ``after`` has seconds, after these where
    the stage is one task.
    """
    with (study.parent / f"{study.name}.log").open("ab") as log:
        child = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
    process = psutil.Process(child.pid)
    stage, since, looked = START, time.monotonic(), 0.0
    before = since
    while child.poll() is None:
        now_at, had, done, of = stage_of(study, child.pid)
        now = time.monotonic()
        watch.stages.setdefault(stage, {"cpu": 0.0, "wall": 0.0, "memory": 0.0})
        watch.stages[stage]["wall"] += now - before
        before = now
        if now_at != stage or now - looked > LOOK:
            watch.look(process, stage)
            looked = now
        if now_at != stage:
            stage, since = now_at, now
        half = done - had >= max(1, (of - had) // 2)
        if of == 1:
            half = now - since > after.get(stage, 0)
        if stage in after and half:
            watch.look(process, stage)
            child.send_signal(signal.SIGKILL)
            child.wait()
            return stage, None
        time.sleep(0.1)
    return "", child.returncode


def command_of(paths, study, n):
    words = ["-m", "s4a", "run", str(paths[0].parent), "--out", str(study), "--n-jobs", "-1"]
    return [sys.executable, *words, "--n-pairs", str(5 * n), "--pattern", "*.ply"]


def one_run(paths, study, kills):
    """A run that is killed in each stage of `kills` and started again until it comes to its end."""
    n = len(paths)
    watch, killed, left = Watch(), [], dict.fromkeys(kills, 0.002 * n)
    finished, code = {}, None
    while code is None:
        had = dict(finished)
        stage, code = run_until(command_of(paths, study, n), study, watch, left)
        finished = files_of(study)
        again = sorted(path for path in had if finished.get(path) != had[path])
        if stage:
            del left[stage]
            time.sleep(1)  # its workers end
        killed.append({"stage": stage, "files": len(finished), "again": again})
        say(f"{time.strftime('%H:%M:%S')} {stage or 'end'}: {len(finished)} files; again: {again}")
    assert code == 0, f"exit {code}: see {study}.log"
    return {"shapes": n, "stages": watch.stages, "killed": killed, "not killed in": [*left]}


def run(folder, n, n_vertices, whole, twice):
    """Analyse n brains and write what it took."""
    files = folder / f"files_{n}_{n_vertices}"
    paths = collection(n, n_vertices, files)
    kinds = {"killed": STAGES, "whole": ()}
    for kind in ["whole"] if whole else ["killed", "whole"] if twice else ["killed"]:
        study = folder / f"{kind}_{n}_{n_vertices}"
        shutil.rmtree(study, ignore_errors=True)
        found = one_run(paths, study, kinds[kind])
        disk = sum(path.stat().st_size for path in study.rglob("*.nc")) / 2**20
        found |= {"vertices": n_vertices, "kind": kind, "disk": disk, "cores": os.cpu_count()}
        study.with_suffix(".json").write_text(json.dumps(found, indent=1))
    if twice:
        same = equal_studies(*(folder / f"{kind}_{n}_{n_vertices}" for kind in kinds))
        say(f"{n} shapes, killed and whole: {same}")


def equal_studies(a, b):
    """Whether two studies hold the same, but for what the clock says."""
    names = sorted(files_of(a))
    if names != sorted(files_of(b)):
        return "not the same files"
    differ = []
    for name in names:
        one, other = (netcdf.read(study / name) for study in (a, b))
        if name == "report.nc":
            one, other = one.drop_dims("stage"), other.drop_dims("stage")
        if not one.identical(other):
            differ.append(name)
    return f"differ: {differ}" if differ else f"{len(names)} files, all the same bit-identical"


def one_by_one(study, files):
    """Each inserted by itself, into a study that was opened for it."""
    return [s4a.insert(s4a.open_study(study), [file]) for file in files]


def together(study, files):
    """All at once, in two processes."""
    return [s4a.insert(s4a.open_study(study), files, n_jobs=2)]


def by_dask(study, files):
    """All at once, by four workers of dask, of which one is killed when it is at work."""
    from dask.distributed import Client, LocalCluster

    local = LocalCluster(n_workers=4, threads_per_worker=1, dashboard_address=None)
    with local, Client(local) as client, joblib.parallel_config(backend="dask"):

        def kill_one():
            while not (busy := [w for w, calls in client.processing().items() if calls]):
                time.sleep(0.05)
            time.sleep(1)
            os.kill(client.run(os.getpid, workers=busy[:1])[busy[0]], signal.SIGKILL)

        killer = threading.Thread(target=kill_one)
        killer.start()
        found = [s4a.insert(s4a.open_study(study), files, n_jobs=-1)]
        killer.join()
    return found


def same_bytes(values):
    """The bytes of numbers; of a text the text, as its array has room for the longest."""
    return values.tobytes() if values.dtype.kind in "iuf" else values.tolist()


def inserts(folder, n, n_vertices):
    """Insert n shapes in three ways, and compare every variable of every one."""
    paths = collection(12 + n, n_vertices, folder / f"files_{12 + n}_{n_vertices}")
    study = folder / f"study_12_{n_vertices}"
    s4a.analyse(paths[:12], store=study, n_jobs=-1).close()
    ways = {}
    for way in (one_by_one, together, by_dask):
        begin = time.perf_counter()
        parts = way(study, paths[12:])
        ways[way.__name__] = {
            (path.stem, node, name): same_bytes(data[name].sel(shape=path.stem).values)
            for path in paths[12:]
            for part in parts
            for node in ("latent", "registration", "pca")
            if path.stem in (data := part[node].to_dataset())["shape"]
            for name in data
            if "shape" in data[name].dims
        }
        say(f"{way.__name__}: {n} inserted, {time.perf_counter() - begin:.0f} s")
    first, *others = ways.values()
    same = all(one == first for one in others)
    say(f"{len(first)} arrays of {n} shapes: {'the same bit-identical' if same else 'THEY DIFFER'}")


def table(folder):
    """What all runs of a folder took, and the exponents."""
    found = [json.loads(path.read_text()) for path in folder.glob("*.json")]
    if not found:
        sys.exit(f"a run in {folder} is needed, found none: large.py run 50 comes first")
    for kind in sorted({(one["kind"], one["vertices"]) for one in found}):
        runs = [one for one in found if (one["kind"], one["vertices"]) == kind]
        runs.sort(key=lambda one: one["shapes"])
        sizes = [one["shapes"] for one in runs]
        say(f"\n{kind[0]}, {kind[1]:,} vertices, {', '.join(map(str, sizes))} shapes")
        for stage in (START, *STAGES):
            rows = [one["stages"].get(stage, {"cpu": 0, "wall": 0, "memory": 0}) for one in runs]
            cells = "  ".join(f"{r['cpu']:8.1f} {r['wall']:7.1f} {r['memory']:6.0f}" for r in rows)
            say(f"{stage:32} {cells}   {slope(sizes, [r['cpu'] for r in rows])}")
        for name, of in (("CPU s", "cpu"), ("wall s", "wall")):
            total = [sum(s[of] for s in one["stages"].values()) for one in runs]
            say(f"{name:32} {'  '.join(f'{t:8.1f}' for t in total)}   {slope(sizes, total)}")
        peak = [max(s["memory"] for s in one["stages"].values()) for one in runs]
        disk = [one["disk"] for one in runs]
        for name, of in (("MiB at most", peak), ("MiB on disk", disk)):
            say(f"{name:32} {'  '.join(f'{m:8.0f}' for m in of)}")
        for one in runs:
            hit = [k["stage"] for k in one["killed"] if k["stage"]]
            again = sorted({path for k in one["killed"] for path in k["again"]})
            say(f"{one['shapes']} shapes: killed in {len(hit)} stages, written again {again}")


def slope(sizes, seconds):
    """The exponent of seconds in the sizes, in words; nothing of one size."""
    if len(sizes) < 2:
        return ""
    seconds = np.maximum(seconds, 1e-2)
    return f"exponent {np.polyfit(np.log(sizes), np.log(seconds), 1)[0]:5.2f}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("run", "sum", "insert"))
    parser.add_argument("shapes", type=int, nargs="*")
    parser.add_argument("--vertices", type=int, default=20_000)
    parser.add_argument("--folder", type=Path, default=Path("large"))
    parser.add_argument("--whole", action="store_true", help="kill nothing")
    parser.add_argument("--twice", action="store_true", help="compare with one not killed")
    args = parser.parse_args()
    if args.part == "insert":
        inserts(args.folder, *(args.shapes or [20]), args.vertices)
        return
    for n in args.shapes or [50] if args.part == "run" else []:
        run(args.folder, n, args.vertices, args.whole, args.twice)
    table(args.folder)


if __name__ == "__main__":
    main()
