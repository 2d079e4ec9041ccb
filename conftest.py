"""Examples of docstrings run as they stand, with no name that they do not make themselves.

The example studies are made once, and what examples write to temporary folders is gone afterwards.
"""

import tempfile

import pytest

from s4a import synthetic
from s4a.datasets import structures


@pytest.fixture(scope="session")
def example_study():
    return synthetic.example_study()


@pytest.fixture(scope="session")
def example_structures():
    return structures.example_structures()


@pytest.fixture(autouse=True)
def example(request):
    """The surroundings of an example; nothing is made for tests that are none."""
    if not isinstance(request.node, pytest.DoctestItem):
        return
    request.node.dtest.globs.clear()
    monkeypatch = request.getfixturevalue("monkeypatch")
    monkeypatch.setattr(tempfile, "tempdir", str(request.getfixturevalue("tmp_path")))
    for module, name in ((synthetic, "example_study"), (structures, "example_structures")):
        if any(name in example.source for example in request.node.dtest.examples):
            study = request.getfixturevalue(name)
            monkeypatch.setattr(module, name, lambda study=study: study)
