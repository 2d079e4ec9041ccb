"""Where the tests find what is not beside them."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
DOCS = ROOT / "docs"
NOTEBOOKS = ROOT / "notebooks"
LESSONS = sorted(
    [*NOTEBOOKS.glob("*.ipynb"), *(ROOT / "morphometrics" / "notebooks").glob("*.ipynb")],
    key=lambda path: path.name,
)
DATA = ROOT.parent / "shared" / "data"  # real meshes, beside the repository; tests skip without
BENCHMARKS = ROOT / "benchmarks"


def script(path: Path) -> ModuleType:
    """A script as a module; it finds those beside it."""
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    return importlib.import_module(path.stem)


def benchmark(name: str) -> ModuleType:
    """A script of the benchmarks as a module."""
    return script(BENCHMARKS / f"{name}.py")
