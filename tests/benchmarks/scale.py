"""How S4A starts, and how its steps grow with the number of shapes.

``scale.py start`` measures processes from their first moment on: CPU seconds, the least of five,
and peak memory.
"""

import os
import subprocess
import sys
import time

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


def cost(arguments):
    """CPU seconds of a Python with these arguments, seconds of the clock, its peak in MiB."""
    begin = time.perf_counter()
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, arguments
    wall = time.perf_counter() - begin
    return used.ru_utime + used.ru_stime, wall, used.ru_maxrss / 1024


def start():
    """What a process costs before it computes anything."""
    say(f"\n{'':28} {'CPU s':>8} {'wall s':>8} {'MiB':>8}")
    for name, arguments in STARTS.items():
        cpu, wall, memory = map(min, zip(*(cost(arguments) for _ in range(5)), strict=True))
        say(f"{name:28} {cpu:8.2f} {wall:8.2f} {memory:8.0f}")


PARTS = {"start": start}

if __name__ == "__main__":
    for part in sys.argv[1:] or PARTS:
        PARTS[part]()
