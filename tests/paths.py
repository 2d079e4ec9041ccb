"""Where the tests find what is not beside them."""

from pathlib import Path

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
DOCS = ROOT / "docs"
NOTEBOOKS = ROOT / "notebooks"
DATA = ROOT.parent / "shared" / "data"  # real meshes, beside the repository; tests skip without
