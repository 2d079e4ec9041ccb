"""What examples of docstrings find.

Six small ``brains``, their ``study`` and its ``store``, an empty ``folder``.
"""

import re

import pytest

import s4a


@pytest.fixture(scope="session")
def small_brains():
    return s4a.synthetic.brains(6, 200)


@pytest.fixture(scope="session")
def small_store(small_brains, tmp_path_factory):
    folder = tmp_path_factory.mktemp("examples") / "study"
    s4a.analyse(small_brains, n_coarse=100, k=10, k_init=6, n_pairs=6, store=folder)
    return folder


@pytest.fixture(scope="session")
def small_study(small_store):
    return s4a.open_study(small_store).load()


@pytest.fixture(autouse=True)
def examples(request):
    """The names that an example uses; nothing is computed for tests that are none."""
    if not isinstance(request.node, pytest.DoctestItem):
        return
    source = " ".join(example.source for example in request.node.dtest.examples)
    known = {
        "brains": "small_brains",
        "study": "small_study",
        "store": "small_store",
        "folder": "tmp_path",
    }
    for name, fixture in known.items():
        if name not in request.node.dtest.globs and re.search(rf"\b{name}\b", source):
            request.node.dtest.globs[name] = request.getfixturevalue(fixture)
