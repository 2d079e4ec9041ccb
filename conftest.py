"""Examples of docstrings run as they stand, with no name that they do not make themselves.

The example studies are made once, and what examples write to temporary folders is gone afterwards.
"""

import tempfile

import pytest

from s4a import synthetic


@pytest.fixture(scope="session")
def example_study():
    return synthetic.example_study()


@pytest.fixture(autouse=True)
def example(request):
    """The surroundings of an example; nothing is made for tests that are none."""
    if not isinstance(request.node, pytest.DoctestItem):
        return
    request.node.dtest.globs.clear()
    monkeypatch = request.getfixturevalue("monkeypatch")
    monkeypatch.setattr(tempfile, "tempdir", str(request.getfixturevalue("tmp_path")))
    if any("example_study" in example.source for example in request.node.dtest.examples):
        study = request.getfixturevalue("example_study")
        monkeypatch.setattr(synthetic, "example_study", lambda: study)
