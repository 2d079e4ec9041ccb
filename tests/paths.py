"""Where the tests find what is not beside them."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
DOCS = ROOT / "docs"
NOTEBOOKS = ROOT / "notebooks"
DATA = ROOT.parent / "shared" / "data"  # real meshes, beside the repository; tests skip without
BENCHMARKS = TESTS / "benchmarks"


def benchmark(name: str) -> ModuleType:
    """A script of the benchmarks as a module."""
    if str(BENCHMARKS) not in sys.path:
        sys.path.append(str(BENCHMARKS))
    return importlib.import_module(name)
