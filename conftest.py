"""Examples of docstrings run as they stand, with no name that they do not make themselves.

What is slow in them is made once, and what they write to temporary folders is gone afterwards.
"""

import re
import tempfile

import pytest

from s4a import synthetic


@pytest.fixture(scope="session")
def example_study():
    return synthetic.example_study()


@pytest.fixture(scope="session")
def small_brains():
    return synthetic.brains(6, 200)


@pytest.fixture(scope="session")
def small_store(tmp_path_factory, small_brains):
    from s4a import analyse

    folder = tmp_path_factory.mktemp("examples") / "study"
    analyse(small_brains, n_coarse=100, k=10, k_init=6, n_pairs=6, store=folder)
    return folder


@pytest.fixture(autouse=True)
def example(request):
    """The surroundings of an example; nothing is made for tests that are none."""
    if not isinstance(request.node, pytest.DoctestItem):
        return
    source = " ".join(example.source for example in request.node.dtest.examples)
    monkeypatch = request.getfixturevalue("monkeypatch")
    monkeypatch.setattr(tempfile, "tempdir", str(request.getfixturevalue("tmp_path")))
    if "example_study" in source:
        study = request.getfixturevalue("example_study")
        monkeypatch.setattr(synthetic, "example_study", lambda: study)
    known = {  # for examples that are not yet on their own
        "brains": "small_brains",
        "study": "example_study",
        "store": "small_store",
        "folder": "tmp_path",
    }
    for name, fixture in known.items():
        if re.search(rf"\b{name}\b", source) and f"{name} = " not in source:
            request.node.dtest.globs[name] = request.getfixturevalue(fixture)
