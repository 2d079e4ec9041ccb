"""Lessons run again and again on a busy machine: how many hung?

``python benchmarks/hangs.py [04 07 ...] [--runs 20] [--load 2] [--seconds 240]``.

Each run is ``jupyter execute`` of a lesson, in a folder of its own, beside `load` processes that do
nothing but compute.  A run that has used no processor time for half a minute while its client still
waits is hung; one that is not done in time is slow, and is ended as well.  A client whose kernel
has ended did all cells, and hangs while it closes its sockets (jupyter_client, issue 771): that
is counted by itself, as no lesson can help it.
"""

import argparse
import contextlib
import multiprocessing
import sys
import tempfile
import time
from pathlib import Path

import psutil

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
MORE = NOTEBOOKS.parent / "morphometrics" / "notebooks"
STILL = 30  # seconds without processor time that make a hung run
LITTLE = 0.5  # seconds of it that an idle client and kernel may use in that time


def burn() -> None:
    """Compute until ended."""
    while True:
        sum(range(100_000))


def spent(process: psutil.Process, used: dict[int, float]) -> float:
    """Seconds of processor time of a process and all that it started, those that ended too."""
    for one in [process, *process.children(recursive=True)]:
        with contextlib.suppress(psutil.NoSuchProcess):
            times = one.cpu_times()
            used[one.pid] = times.user + times.system
    return sum(used.values())


def end(process: psutil.Process) -> None:
    """End a process and those that it started."""
    for one in [*process.children(recursive=True), process]:
        with contextlib.suppress(psutil.NoSuchProcess):
            one.kill()


def executed(lesson: Path, folder: str, seconds: float) -> tuple[str, float]:
    """How a run ended: done, failed, hung, hung at its end or slow; and after how many seconds."""
    command = [sys.executable, "-m", "jupyter", "execute", "--output", f"{folder}/out.ipynb"]
    begin = time.monotonic()
    with open(Path(folder, "log"), "w", encoding="utf-8") as log:
        process = psutil.Popen([*command, str(lesson)], cwd=folder, stdout=log, stderr=log)
        seen, used = [(begin, 0.0)], {}
        while process.poll() is None:
            time.sleep(1)
            now = time.monotonic()
            seen.append((now, spent(process, used)))
            before = [had for at, had in seen if at <= now - STILL]
            if before and seen[-1][1] - before[-1] < LITTLE:
                how = "hung" if process.children() else "at its end"
                end(process)
                return how, now - begin
            if now - begin > seconds:
                end(process)
                return "slow", now - begin
    return "failed" if process.returncode else "done", time.monotonic() - begin


def write(line: str) -> None:
    """A line, at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> None:
    """Run the lessons that are named, or all, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("lessons", nargs="*", help="how their names begin; all by default")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--load", type=int, default=2, help="processes that compute beside them")
    parser.add_argument("--seconds", type=float, default=240, help="that a run may take")
    options = parser.parse_args()
    lessons = [
        path
        for path in [*sorted(NOTEBOOKS.glob("*.ipynb")), *sorted(MORE.glob("*.ipynb"))]
        if not options.lessons or path.name.startswith(tuple(options.lessons))
    ]
    burners = [multiprocessing.Process(target=burn, daemon=True) for _ in range(options.load)]
    for burner in burners:
        burner.start()
    write(f"{options.load} processes beside; runs: done, failed, hung, at its end, slow; seconds")
    for lesson in lessons:
        ends = []
        for _ in range(options.runs):
            with tempfile.TemporaryDirectory() as folder:
                ends.append(executed(lesson, folder, options.seconds))
                if ends[-1][0] == "failed":
                    sys.stderr.write(Path(folder, "log").read_text(encoding="utf-8")[-1500:])
        kinds = ("done", "failed", "hung", "at its end", "slow")
        counts = [sum(how == kind for how, _ in ends) for kind in kinds]
        times = sorted(seconds for _, seconds in ends)
        told = " ".join(f"{count:4}" for count in counts)
        write(f"{lesson.stem:24} {told}   {times[0]:.0f} to {times[-1]:.0f}")
    for burner in burners:
        burner.terminate()


if __name__ == "__main__":
    main()
