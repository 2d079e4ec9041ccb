"""``s4a doctor``: check a machine for what S4A needs.

Every check returns a :class:`Finding`.  It imports and writes what a run would, and removes the
files that it has written.
"""

import contextlib
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

GIB = 2**30
LEAST_MEMORY = 2.0  # GiB, for ten heads of 150,000 vertices on two cores; the demo takes less
GL = "apt-get install libgl1 libopengl0, or what your system calls libGL.so.1 and libOpenGL.so.0"
# distributions whose modules have other names
MODULES = {"libigl": "igl", "pillow": "PIL", "scikit-learn": "sklearn"}
NAMES = {module: name for name, module in MODULES.items()}
IMPORTS = """
import importlib, sys
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
    except Exception as error:
        print(name, *str(error).split())
"""
# the test of PyMeshLab for wrap=True, in a process of its own, which a broken library may end
TRIAL = """
import pymeshlab
meshes = pymeshlab.MeshSet(verbose=False)
print("ok" if hasattr(meshes, "generate_alpha_wrap") else "without its filters")
"""


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Parameters
    ----------
    what : str
    state : {"ok", "note", "missing"}
        "missing" if a run with all defaults needs it, "note" if only some commands do.
    found : str
    do : str
        The command to type, or what to do.
    """

    what: str
    state: str
    found: str
    do: str = ""


def noted(what: str, is_fine: object, fine: str, otherwise: str, do: str) -> Finding:
    """Return a finding that is "ok", or a note."""
    return Finding(what, "ok", fine) if is_fine else Finding(what, "note", otherwise, do)


def examine(folder: Path | str = ".") -> list[Finding]:
    """Return all findings on this machine, for studies in a folder.

    Examples
    --------
    >>> from s4a.cli.doctor import examine
    >>> [finding.state for finding in examine() if finding.what == "Python"]
    ['ok']
    """
    found = [Finding("Python", "ok", f"{sys.version.split()[0]}, {sys.executable}")]
    found += [*dependencies(), writable("study folder", Path(folder), "another --out")]
    temporary = Path(tempfile.gettempdir())
    found += [writable("temporary folder", temporary, "export TMPDIR=FOLDER")]
    with contextlib.suppress(ImportError):  # packages that do not import are reported above
        found.append(memory())
    return [*found, *extras()]


def dependencies() -> Iterator[Finding]:
    """Yield packages that are missing or too old, or one finding if there are none."""
    wrong = []
    for name, floor in needed():
        here = version_of(name)
        if not here or numbers(here) < numbers(floor):
            text = f"{here}, and {floor} or newer is needed" if here else "not installed"
            wrong.append(Finding(name, "missing", text, f"pip install --upgrade '{name}>={floor}'"))
    modules = [MODULES.get(name, name.replace("-", "_")) for name, _ in needed()]
    result = run(IMPORTS, *modules)
    for line in result.stdout.splitlines():
        name, _, error = line.partition(" ")
        if not any(MODULES.get(one.what, one.what) == name for one in wrong):
            doing = f"pip install --force-reinstall {NAMES.get(name, name)}"
            wrong.append(Finding(name, "missing", f"does not import: {error}", doing))
    if result.returncode:
        text = f"end the process: {end_of(result)}"
        wrong.append(Finding("packages", "missing", text, "a new venv"))
    text = f"S4A {version('s4a')} and the {len(modules)} packages that it needs"
    yield from wrong or [Finding("packages", "ok", text)]


def needed(extra: str = "") -> list[tuple[str, str]]:
    """Return name and lowest version of the packages that S4A, or one of its extras, requires."""
    found = []
    for line in requires("s4a") or []:
        of = re.search(r"extra == ['\"](\w+)['\"]", line)
        pair = re.match(r"([\w.-]+)(?:\[\w+\])?>=([\w.]+)", line)
        if pair and (of[1] if of else "") == extra:
            found.append((pair[1], pair[2]))
    return found


def numbers(text: str) -> tuple[int, ...]:
    """Return a version as numbers.

    Examples
    --------
    >>> from s4a.cli.doctor import numbers
    >>> numbers("2025.7.post1"), numbers("1.15.0rc1") > numbers("1.9")
    ((2025, 7), True)
    """
    return tuple(map(int, re.findall(r"^\d+(?:\.\d+)*", text)[0].split(".")))


def version_of(name: str) -> str:
    """Return the version of a distribution, empty if it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def run(script: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a script in a process of its own, which a broken library may end."""
    command = [sys.executable, "-c", script, *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def end_of(result: subprocess.CompletedProcess[str]) -> str:
    """Return the last line of output of a process, or its exit code."""
    lines = [*result.stdout.splitlines(), *result.stderr.strip().splitlines()]
    return lines[-1] if lines else f"ends its process with {result.returncode}"


def wrapping() -> Finding:
    """Check that PyMeshLab, which only ``wrap=True`` needs, imports and has its filters."""
    result = run(TRIAL)
    is_fine = not result.returncode and result.stdout.strip() == "ok"
    fine = f"PyMeshLab {version_of('pymeshlab')}, with its filters"
    return noted("for --wrap", is_fine, fine, f"PyMeshLab: {end_of(result)}", GL)


def writable(what: str, folder: Path, instead: str) -> Finding:
    """Check that a file can be made, locked and renamed in a folder, as in every run."""
    try:
        with tempfile.TemporaryDirectory(prefix=".s4a-", dir=folder) as name:
            there = Path(name) / "a"
            with open(there, "w") as file, contextlib.suppress(ImportError):
                from s4a.study.processes import try_lock

                try_lock(file.fileno())
            there.rename(Path(name) / "b")
    except OSError as error:
        return Finding(what, "missing", f"{folder}: {error}", f"give another: {instead}")
    return Finding(what, "ok", f"{folder.resolve()} can be written and locked")


def memory() -> Finding:
    """Return the free memory."""
    from s4a.geometry.compiled import psutil

    if not psutil:
        return Finding("memory", "note", "the free memory is not known", "pip install psutil")
    free = psutil.virtual_memory().available / GIB
    text = f"{free:.1f} GiB free"
    few = f"{text}; {LEAST_MEMORY:.0f} is little for large meshes"
    return noted("memory", free >= LEAST_MEMORY, text, few, "--n-jobs 1, or close other programs")


def extras() -> Iterator[Finding]:
    """Check the extras for notebooks, the course, clusters and watertight wrapping."""
    uses = {"notebook": "panels", "course": "lessons", "cluster": "--cluster", "wrap": "--wrap"}
    for extra, what in uses.items():
        missing = [name for name, _ in needed(extra) if not version_of(name)]
        if extra == "wrap" and not missing:
            yield wrapping()
        else:
            do = f"pip install 's4a[{extra}]'"
            text = f"without {', '.join(missing)}"
            yield noted(f"for {what}", not missing, f"s4a[{extra}] is there", text, do)


def lines(findings: list[Finding]) -> list[str]:
    """Return the lines of findings, each followed by what to do.

    Examples
    --------
    >>> from s4a.cli.doctor import Finding, lines
    >>> print(*lines([Finding("disk", "note", "0.2 GiB free", "--out elsewhere")]), sep="\\n")
    note     disk              0.2 GiB free
                               -> --out elsewhere
    """
    found = []
    for one in findings:
        found.append(f"{one.state:<9}{one.what:<18}{one.found}")
        found += [f"{'':27}-> {one.do}"] * bool(one.do)
    return found
