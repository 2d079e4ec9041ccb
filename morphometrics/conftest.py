"""The example study of several structures is made once for all tests and examples."""

import pytest

from s4a_morphometrics import open_structures, synthetic


@pytest.fixture(scope="session")
def several(structures_folder):
    """A registered study of six subjects with two structures, that of the examples."""
    return open_structures(structures_folder).load()


@pytest.fixture(autouse=True)
def made_once(request, monkeypatch):
    """Examples take the study that is there."""
    if isinstance(request.node, pytest.DoctestItem):
        if any("example_structures" in one.source for one in request.node.dtest.examples):
            study = request.getfixturevalue("several")
            monkeypatch.setattr(synthetic, "example_structures", lambda: study)
