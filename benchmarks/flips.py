"""A flipped bit in a finished study: a named error or the same result, and nothing else.

``python benchmarks/flips.py [--flips 100] [--seed 0]``.

Each flip is of a random bit of a random file of a small study.  Then the study is shown, tested,
verified and loaded, each in a process of its own with limits of time and memory.  What comes is

- a named error: one sentence with the file, and the exit code of an error;
- the same result: all that was said and written is as it is without the flip;
- wrong: a traceback, an error that does not name the file, a crash, another result, no end.

It exits with 1 where anything was wrong.  Flips that ``s4a verify`` has not seen are listed: HDF5
has bytes that nothing reads.
"""

import argparse
import contextlib
import hashlib
import io
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np
import xarray as xr

from s4a import analyse, cli, open_study, synthetic
from s4a.show import draw, page, pictures

N_SHAPES, N_VERTICES = 6, 400
OPTIONS = {"n_coarse": 150, "k_init": 8, "k": 12, "intersections": False, "include_flagged": True}
LIMIT, END = 60, 600  # seconds of CPU of a command, and of the clock
MEMORY = 4 * 2**30  # bytes that it may ask for more than it has
NAMED, SAME, WRONG = "named error", "same result", "wrong"


def show(study, out):
    """``s4a view``, with small pictures; all that they are drawn of is noted beside the page."""
    drawn = hashlib.sha256()

    def small(points, triangles, *, colors=None, **options):
        for values in (points, triangles, np.zeros(0) if colors is None else colors):
            drawn.update(np.ascontiguousarray(values).tobytes())
        return draw.render(points, triangles, colors=colors, **options | {"size": (50, 40)})

    page.render = pictures.render = small
    code = cli.main(["view", str(study), "--page", str(out / "page.html")])
    (out / "drawn").write_text(drawn.hexdigest())
    return code


def test(study, out):
    """``s4a statistics``."""
    options = ["--group", "group", "--permutations", "9"]
    return cli.main(["statistics", str(study), *options, "--out", str(out / "statistics")])


def verify(study, out):
    """``s4a verify``."""
    return cli.main(["verify", str(study)])


def load(study, out):
    """Open a study and read all of it."""
    try:
        with open_study(study) as tree:
            sys.stdout.write(digest_of(tree.load()))
    except (ValueError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


COMMANDS = {
    "s4a view": show,
    "s4a statistics": test,
    "s4a verify": verify,
    "s4a.open_study(...).load()": load,
}


def make(folder):
    """The folder of a finished study with a table."""
    files = synthetic.write(synthetic.brains(N_SHAPES, N_VERTICES, seed=2), folder / "meshes")
    names = [file.stem for file in files if file.suffix == ".ply"]
    rows = [f"{name},{'ab'[i % 2]},{30 + i * i}" for i, name in enumerate(names)]
    (folder / "table.csv").write_text("\n".join(["shape,group,age", *rows]))
    meshes = folder / "meshes" / "*.ply"
    analyse(meshes, store=folder / "study", table=folder / "table.csv", **OPTIONS).close()
    return folder / "study"


def digest_of(tree):
    """All that a tree holds, as one number."""
    found = hashlib.sha256()
    for node in tree.subtree:
        data = node.to_dataset(inherit=False)
        found.update(repr((node.path, sorted(data.attrs.items()))).encode())
        for name in sorted(map(str, data.variables)):
            values = data[name].values
            found.update(f"{name} {data[name].dims} {values.dtype.kind} {values.shape}".encode())
            found.update(repr(values.tolist()).encode())
    return found.hexdigest()


def written(folder):
    """What a command has written: file -> digest."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        if path.suffix == ".nc":
            with xr.open_dataset(path, engine="h5netcdf") as data:
                found[path.name] = digest_of(xr.DataTree(data.load()))
        else:
            found[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def outcome(command, study, out):
    """The exit code of a command in a process of its own, what it said, and what it wrote."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    said, complained = out.with_suffix(".out"), out.with_suffix(".err")
    sys.stdout.flush()  # or the process below says it, too
    process = os.fork()
    if not process:
        for number, path in ((1, said), (2, complained)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
        spent = int(time.process_time())
        resource.setrlimit(resource.RLIMIT_CPU, (spent + LIMIT, spent + LIMIT))
        code = 70
        try:
            code = command(study, out)
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    end = time.monotonic() + END
    while not (state := os.waitpid(process, os.WNOHANG))[0]:
        if time.monotonic() > end:
            os.kill(process, signal.SIGKILL)
        time.sleep(0.01)
    code = os.waitstatus_to_exitcode(state[1])
    return code, said.read_text(), complained.read_text(), written(out)


def judge(found, expected, name):
    """What came of a flip in a file of this name."""
    code, said, complained, files = found
    if "Traceback" in said + complained:
        return WRONG
    if (code, said, files) == (expected[0], expected[1], expected[3]):
        return SAME
    sentences = [line for line in (said + complained).splitlines() if name in line]
    return NAMED if code in (1, 2) and sentences else WRONG


def flip(path, bit):
    """Turn one bit of a file."""
    with path.open("r+b") as file:
        file.seek(bit // 8)
        byte = file.read(1)[0]
        file.seek(bit // 8)
        file.write(bytes([byte ^ 1 << bit % 8]))


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flips", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(arguments)
    rng, begin, unseen = random.Random(args.seed), time.monotonic(), 0
    counts = {command: dict.fromkeys((NAMED, SAME, WRONG), 0) for command in COMMANDS}
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder).resolve()
        study, out = make(folder), folder / "out"
        out.mkdir()
        with contextlib.redirect_stdout(io.StringIO()):
            for command in COMMANDS.values():  # what they import, each process below has then
                command(study, out)
        whole = {name: outcome(command, study, out) for name, command in COMMANDS.items()}
        again = {name: outcome(command, study, out) for name, command in COMMANDS.items()}
        assert whole == again
        assert all(code == 0 for code, *_ in whole.values()), whole
        files = sorted(path for path in study.rglob("*") if path.is_file() and path.stat().st_size)
        for _ in range(args.flips):
            path = rng.choice(files)
            bit = rng.randrange(8 * path.stat().st_size)
            name = path.relative_to(study).as_posix()
            flip(path, bit)
            sys.stderr.write(f"bit {bit} of {name}\n")
            for command, function in COMMANDS.items():
                found = outcome(function, study, out)
                what = judge(found, whole[command], name)
                counts[command][what] += 1
                if what == WRONG:
                    words = "\n".join([*found[1].splitlines()[:5], *found[2].splitlines()[-5:]])
                    sys.stdout.write(f"bit {bit} of {name}, {command}: exit {found[0]}\n{words}\n")
                if function is verify and what == SAME:
                    unseen += 1
                    sys.stdout.write(f"bit {bit} of {name} was not seen by {command}\n")
            flip(path, bit)
        restored = {name: outcome(command, study, out) for name, command in COMMANDS.items()}
        assert restored == whole
    sys.stdout.write(
        f"| {args.flips} flips in {len(files)} files | {' | '.join((NAMED, SAME, WRONG))} |\n"
    )
    sys.stdout.write("|---|---|---|---|\n")
    for command, row in counts.items():
        sys.stdout.write(f"| {command} | {' | '.join(map(str, row.values()))} |\n")
    sys.stdout.write(f"{unseen} not seen by s4a verify; {time.monotonic() - begin:.0f} s\n")
    return 1 if any(row[WRONG] for row in counts.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
