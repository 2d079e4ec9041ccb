"""``s4a doctor``: what this machine lacks for S4A, and what to type.

Every check gives a :class:`Finding`; it imports or writes what a run would, and changes nothing:
files that it writes are removed.
"""

import contextlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

GIB = 2**30
LEAST_MEMORY = 2.0  # GiB, for ten heads of 150,000 vertices on two cores; the demo takes less
LEAST_DISK = 1.0  # GiB, for a study
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "firefox", "safari")
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
# what wrap=True uses, asked of it in a process of its own: a broken one may end the process
TRIAL = """
import pymeshlab
meshes = pymeshlab.MeshSet(verbose=False)
print("ok" if hasattr(meshes, "generate_alpha_wrap") else "lacks its filters")
"""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Parameters
    ----------
    what : str
    state : {"ok", "note", "lacks"}
        "lacks" is what a run with all defaults needs; "note" what only some commands need.
    found : str
    do : str
        What to type, or what to do.
    """

    what: str
    state: str
    found: str
    do: str = ""


def noted(what: str, is_fine: object, fine: str, otherwise: str, do: str) -> Finding:
    """That a thing is fine, or a note on it."""
    return Finding(what, "ok", fine) if is_fine else Finding(what, "note", otherwise, do)


def examine(folder: Path | str = ".") -> list[Finding]:
    """All findings on this machine, for studies in a folder.

    Examples
    --------
    >>> from s4a.cli.doctor import examine
    >>> [finding.state for finding in examine() if finding.what == "Python"]
    ['ok']
    """
    found = [Finding("Python", "ok", f"{sys.version.split()[0]}, {sys.executable}")]
    found += [*dependencies(), writable("study folder", Path(folder), "a place for it")]
    temporary = Path(tempfile.gettempdir())
    found += [writable("temporary folder", temporary, "export TMPDIR=FOLDER")]
    for check in (cache, memory, cores, threads):
        with contextlib.suppress(ImportError):  # what does not import is told above
            found.append(check())
    return [*found, disk(Path(folder)), browser(), *extras()]


def dependencies() -> Iterator[Finding]:
    """Packages that S4A needs and that are missing or older than its floor; one finding if none."""
    wrong = []
    for name, floor in needed():
        here = version_of(name)
        if not here:
            wrong.append(Finding(name, "lacks", "not installed", f"pip install '{name}>={floor}'"))
        elif numbers(here) < numbers(floor):
            told = f"{here}, and {floor} or newer is needed"
            wrong.append(Finding(name, "lacks", told, f"pip install --upgrade '{name}>={floor}'"))
    modules = [MODULES.get(name, name.replace("-", "_")) for name, _ in needed()]
    result = run(IMPORTS, *modules)
    for line in result.stdout.splitlines():
        name, _, error = line.partition(" ")
        if not any(MODULES.get(one.what, one.what) == name for one in wrong):
            doing = f"pip install --force-reinstall {NAMES.get(name, name)}"
            wrong.append(Finding(name, "lacks", f"does not import: {error}", doing))
    if result.returncode:
        wrong.append(
            Finding("packages", "lacks", f"end the process: {end_of(result)}", "a new venv")
        )
    told = f"S4A {version('s4a')} and the {len(modules)} that it needs"
    yield from wrong or [Finding("packages", "ok", told)]


def needed(extra: str = "") -> list[tuple[str, str]]:
    """Name and floor of every package that S4A, or one of its extras, requires itself."""
    found = []
    for line in requires("s4a") or []:
        of = re.search(r"extra == ['\"](\w+)['\"]", line)
        pair = re.match(r"([\w.-]+)(?:\[\w+\])?>=([\w.]+)", line)
        if pair and (of[1] if of else "") == extra:
            found.append((pair[1], pair[2]))
    return found


def numbers(text: str) -> tuple[int, ...]:
    """A version as numbers.

    Examples
    --------
    >>> from s4a.cli.doctor import numbers
    >>> numbers("2025.7.post1"), numbers("1.15.0rc1") > numbers("1.9")
    ((2025, 7), True)
    """
    return tuple(map(int, re.findall(r"^\d+(?:\.\d+)*", text)[0].split(".")))


def version_of(name: str) -> str:
    """The version of a distribution, or nothing where it is not there."""
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def run(script: str, *words: str) -> subprocess.CompletedProcess[str]:
    """A script in a process of its own, which a broken library may end."""
    command = [sys.executable, "-c", script, *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def end_of(result: subprocess.CompletedProcess[str]) -> str:
    """The last that a process said, or how it ended."""
    lines = [*result.stdout.splitlines(), *result.stderr.strip().splitlines()]
    return lines[-1] if lines else f"ends its process with {result.returncode}"


def wrapping() -> Finding:
    """Whether PyMeshLab, which only ``wrap=True`` needs, imports and has its filters."""
    result = run(TRIAL)
    is_fine = not result.returncode and result.stdout.strip() == "ok"
    fine = f"PyMeshLab {version_of('pymeshlab')}, with its filters"
    return noted("for --wrap", is_fine, fine, f"PyMeshLab: {end_of(result)}", GL)


def writable(what: str, folder: Path, instead: str) -> Finding:
    """Whether a file can be made, locked and renamed in a folder, as every run does."""
    try:
        with tempfile.TemporaryDirectory(prefix=".s4a-", dir=folder) as name:
            there = Path(name) / "a"
            with open(there, "w") as file, contextlib.suppress(ImportError):
                from s4a.study.processes import hold

                hold(file.fileno())
            there.rename(Path(name) / "b")
    except OSError as error:
        return Finding(what, "lacks", f"{folder}: {error}", f"give another: {instead}")
    return Finding(what, "ok", f"{folder.resolve()} can be written and locked")


def cache() -> Finding:
    """Whether matplotlib can keep its list of fonts."""
    import matplotlib

    folder = matplotlib.get_cachedir()
    told = f"{folder} cannot be written: every command that draws looks for all fonts again"
    do = "export MPLCONFIGDIR=FOLDER"
    return noted("cache of fonts", os.access(folder, os.W_OK), folder, told, do)


def memory() -> Finding:
    """Memory that is free now."""
    from s4a.geometry.compiled import psutil

    if not psutil:
        return Finding("memory", "note", "how much is free cannot be seen", "pip install psutil")
    free = psutil.virtual_memory().available / GIB
    told = f"{free:.1f} GiB free"
    few = f"{told}; {LEAST_MEMORY:.0f} is little for large meshes"
    return noted("memory", free >= LEAST_MEMORY, told, few, "--n-jobs 1, or close other programs")


def disk(folder: Path) -> Finding:
    """Room where the study would lie."""
    there = next(p for p in (folder.resolve(), *folder.resolve().parents) if p.exists())
    free = shutil.disk_usage(there).free / GIB
    told = f"{free:.1f} GiB free"
    return noted("disk", free >= LEAST_DISK, told, f"{told} in {there}", "--out in another place")


def cores() -> Finding:
    """Cores that this process may use: those of a container or a job, not of the machine."""
    from joblib import cpu_count

    return Finding("cores", "ok", f"{cpu_count()} for this process; --n-jobs takes all by default")


def threads() -> Finding:
    """The libraries of linear algebra and how many threads each would start by itself."""
    import numpy as np
    import scipy.linalg  # loads its own
    from threadpoolctl import threadpool_info

    np.linalg.inv(np.eye(2))
    scipy.linalg.inv(np.eye(2))
    told = ", ".join(
        " ".join(f"{pool['internal_api']} {pool['version'] or ''} of {pool['num_threads']}".split())
        for pool in threadpool_info()
    )
    return Finding("threads", "ok", f"{told}; workers of a run take one each")


def browser() -> Finding:
    """Whether a browser is there to look at pages; the pages themselves are made without."""
    here = next((name for name in BROWSERS if shutil.which(name)), "")
    if not here and sys.platform in ("darwin", "win32"):
        here = "that of the system"
    told = "none found: pages of s4a view are written all the same"
    return noted("browser", here, here, told, "open them on another machine")


def extras() -> Iterator[Finding]:
    """The extras for notebooks, the course, clusters and closed surfaces around broken ones."""
    uses = {"notebook": "panels", "course": "lessons", "cluster": "--cluster", "wrap": "--wrap"}
    for extra, what in uses.items():
        missing = [name for name, _ in needed(extra) if not version_of(name)]
        if extra == "wrap" and not missing:
            yield wrapping()
        else:
            do = f"pip install 's4a[{extra}]'"
            told = f"without {', '.join(missing)}"
            yield noted(f"for {what}", not missing, f"s4a[{extra}] is there", told, do)


def lines(findings: list[Finding]) -> list[str]:
    """Findings as lines, each followed by what to do.

    Examples
    --------
    >>> from s4a.cli.doctor import Finding, lines
    >>> print(*lines([Finding("disk", "note", "0.2 GiB free", "--out elsewhere")]), sep="\\n")
    note   disk              0.2 GiB free
                             -> --out elsewhere
    """
    found = []
    for one in findings:
        found.append(f"{one.state:<7}{one.what:<18}{one.found}")
        if one.do:
            found.append(f"{'':25}-> {one.do}")
    return found
