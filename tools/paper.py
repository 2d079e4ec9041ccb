"""Every table that README, documentation and papers quote, made again: ``make paper``.

The commands are those that the pages name in backticks, such as ``speed.py growth``; they are
scripts of ``benchmarks``. Each writes what it prints into ``docs/tables``, with day, machine
and versions at its foot; those of speed, which ``make bench`` runs, into ``docs/performance``. Both
folders stand in the repository, and the documentation has a page of each. All of them take more
than a night on two cores: ``make paper ONLY=accuracy`` takes those whose command contains the word,
``make paper ONLY=--list`` names all and runs none, and ``make paper ONLY=--rest`` goes on with
those that have not ended well yet; with ``--minutes=20`` beside it a command that takes longer is
ended and told, and what it printed before stays. ``tests/project/test_documents.py`` fails where a
page quotes a figure without a command.
"""

import os
import platform
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[1]
BENCHMARKS = ROOT / "benchmarks"
TABLES = ROOT / "docs" / "tables"
PAGES = (
    "README.md",
    "docs/claims.md",
    "docs/clusters.md",
    "docs/comparison.md",
    "docs/decisions.md",
    "docs/differences.md",
    "docs/frontends.md",
    "docs/howto/options.md",
    "docs/install.md",
    "docs/plausibility.md",
    "docs/quality_control.md",
    "docs/results.md",
    "docs/scaling.md",
    "paper/paper.md",
    "paper/jose.md",
)
SPEED = (
    ("scale.py", "start"),
    ("scale.py", "open", "400"),
    ("scale.py", "left_out", "200"),
    ("speed.py", "nearest"),
    ("speed.py", "stages"),
    ("speed.py", "growth"),
    ("speed.py", "pipelines", "10", "100000"),
    ("speed.py", "whole", "51", "100000"),
    ("speed.py", "versions", "51", "100000"),
    ("speed.py", "sizes"),
    ("speed.py", "million"),
    ("widgets.py",),
)
FLAGS = ("--speed", "--list", "--rest")
MINUTES = "--minutes="
PERFORMANCE = ROOT / "docs" / "performance"
PACKAGES = ("numpy", "scipy", "xarray", "libigl", "robust_laplacian", "scikit-learn", "pymeshlab")
CODE = re.compile(r"`([^`]+)`")
FENCE = re.compile(r"```.*?```", re.DOTALL)


def commands_in(text):
    """The commands that a text names, without the folder and what writes into the pages."""
    found = []
    for code in CODE.findall(FENCE.sub("", text)):
        words = shlex.split(code) if code.count('"') % 2 == 0 and "'" not in code else code.split()
        words = words[1:] if words[:1] == ["python"] else words
        if not words or not words[0].endswith(".py"):
            continue
        name = words[0].removeprefix("benchmarks/")
        if (BENCHMARKS / name).is_file():
            found.append((name, *(word for word in words[1:] if word != "--write")))
    return found


def commands(pages=PAGES):
    """The commands of all pages, each once, in their order."""
    texts = [(ROOT / page).read_text(encoding="utf-8") for page in pages]
    return list(dict.fromkeys(command for text in texts for command in commands_in(text)))


def machine():
    """What it ran on, as the foot of a table."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = re.findall(r"^model name\s*: (.+)$", info.read_text(), re.MULTILINE)
        model = names[0] if names else model
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
        told = f", {memory:.0f} GiB"
    except (AttributeError, ValueError, OSError):  # not on Windows
        told = ""
    return f"{model}, {os.cpu_count()} cores{told}, {platform.platform()}"


def versions():
    """The versions of S4A and of what computes for it."""
    revision = subprocess.run(
        ["git", "describe", "--always"], cwd=ROOT, capture_output=True, text=True
    ).stdout.strip()
    code = ["s4a", "benchmarks", "pyproject.toml"]  # a picture drawn again changes no number
    changed = subprocess.run(
        ["git", "diff", "--quiet", "HEAD", "--", *code], cwd=ROOT, capture_output=True
    ).returncode
    revision += "-dirty" if revision and changed else ""
    named = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    at = f" at {revision}" if revision else ""
    return f"S4A {version('s4a')}{at}, Python {platform.python_version()}, {named}"


def kept(command):
    """The file with what a command printed."""
    slug = re.sub(r"\W+", "-", " ".join(command).replace(".py", "")).strip("-")
    return (PERFORMANCE if command in SPEED else TABLES) / f"{slug}.md"


def as_markdown(text):
    """What a command printed: tables of Markdown as they are, other lines as they stood.

    Folders that it made for the time are of one machine, and only named.
    """
    temporary = re.escape(tempfile.gettempdir() + os.sep)
    text = re.sub(rf"{temporary}[^\s/]+", "FOLDER", text.strip("\n"))
    return text if re.search(r"^\|", text, re.MULTILINE) else f"```text\n{text}\n```"


def run(command, seconds=None):
    """Run a command; its output and foot as a file. Gives its path and the exit code.

    TimeoutExpired where it takes longer than `seconds`; then nothing is written.
    """
    begin = time.time()
    process = subprocess.Popen(
        [sys.executable, str(BENCHMARKS / command[0]), *command[1:]],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        printed, _ = process.communicate(timeout=seconds)
    finally:
        if process.poll() is None:  # too late, or interrupted: its workers go with it
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    day = time.strftime("%Y-%m-%d")
    foot = f"{day}, {time.time() - begin:.0f} s. {machine()}. {versions()}."
    failed = f"\n\nIt ended with {process.returncode}." if process.returncode else ""
    path = kept(command)
    path.parent.mkdir(parents=True, exist_ok=True)
    head = f"# `{shlex.join(command)}`"
    said = as_markdown(printed)
    path.write_text(f"{head}\n\n{said}\n\n---\n\n{foot}{failed}\n", encoding="utf-8")
    return path, process.returncode


def ended_well(command):
    """Whether there is what a command printed, to its end."""
    path = kept(command)
    return path.exists() and "\n\nIt ended with " not in path.read_text(encoding="utf-8")


def limit_in(words):
    """The seconds that ``--minutes=N`` gives each command, or None; and the other words."""
    given = [word for word in words if word.startswith(MINUTES)]
    seconds = 60 * float(given[-1].removeprefix(MINUTES)) if given else None
    return seconds, [word for word in words if word not in given]


def main(words):
    seconds, words = limit_in(words)
    unknown = [word for word in words if word.startswith("-") and word not in FLAGS]
    if unknown:
        sys.stderr.write(
            f"{__doc__}\n{unknown[0]}: unknown; known are {', '.join(FLAGS)}, {MINUTES}N\n"
        )
        return 2
    known = SPEED if "--speed" in words else commands()
    chosen = [c for c in known if all(word in " ".join(c) for word in words if word[0] != "-")]
    if "--rest" in words:
        chosen = [command for command in chosen if not ended_well(command)]
    codes = []
    for command in chosen:
        sys.stdout.write(f"{shlex.join(command)}\n")
        sys.stdout.flush()
        if "--list" not in words:
            try:
                path, code = run(command, seconds)
                said = f"{path.relative_to(ROOT)}{f', failed: {code}' if code else ''}"
            except subprocess.TimeoutExpired:
                code, said = 1, f"nothing: not at its end after {seconds:.0f} s"
            codes.append(code)
            sys.stdout.write(f"  -> {said}\n")
            sys.stdout.flush()
    return 1 if any(codes) else 0


def end(number, _frame):
    """Leave as after an error, so that a command that is running is ended, too."""
    sys.exit(128 + number)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, end)
    sys.exit(main(sys.argv[1:]))
