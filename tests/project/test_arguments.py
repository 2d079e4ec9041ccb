"""Every public function works with a path, or says what it found, what it expected, what to do."""

import inspect
import re

import numpy as np
import pytest

import s4a
from s4a.geometry.mesh import as_arrays

SMALL = {"n_coarse": 100, "k_init": 6, "k": 10}
FUNCTIONS = {
    f"{module.__name__}.{name}": getattr(module, name)
    for module in (s4a, s4a.statistics)
    for name in module.__all__
    if inspect.isfunction(getattr(module, name))
}
# what a message has to say, of S4A or of Python for a path
SAYS = re.compile(
    r"found|must be|expected .*, not|no (such )?(file|folder|label)|could not convert"
)


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """What a user may give by mistake, or because another function takes it."""
    folder = tmp_path_factory.mktemp("given")
    s4a.write_mesh(folder / "ball.ply", *as_arrays(s4a.synthetic.ellipsoid(200)))
    paths = {"path": folder / "ball.ply", "folder": str(folder), "missing": "nowhere.ply"}
    return paths | {"array": np.zeros((3, 3)), "list": [1, 2], "number": 3, "none": None}


def arguments_of(function, value, folder):
    """The value for every argument that is required, and small options; files go to a folder."""
    parameters = inspect.signature(function).parameters.values()
    required = [p for p in parameters if p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD]
    written = {"path": folder / "out.png", "folder": folder, "name": "name"}
    others = [p.name for p in required[1:]]
    takes_pairs = any(p.kind is p.VAR_KEYWORD for p in parameters) and "preset" in str(parameters)
    options = {n: v for n, v in SMALL.items() if takes_pairs or n in {p.name for p in parameters}}
    return [value, *(written.get(name, value) for name in others)], options


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_takes_what_is_given_or_says_what_it_needs(name, given, tmp_path):
    for kind, value in given.items():
        values, options = arguments_of(FUNCTIONS[name], value, tmp_path)
        said = "found"
        try:
            FUNCTIONS[name](*values, **options)
        except (TypeError, ValueError) as error:
            said = str(error)
        assert SAYS.search(said), kind


def test_files_are_taken_where_meshes_are(given):
    ball = s4a.read_shape(given["path"])
    found = s4a.match_pair(given["path"], str(given["path"]), **SMALL)
    np.testing.assert_array_equal(found["match"], s4a.match_pair(ball, ball, **SMALL)["match"])
    pairs = s4a.register_pairs(given["path"], {"same": given["path"]}, **SMALL)
    assert pairs["registration"].sizes["shape"] == 2
    assert s4a.coarsen(given["path"], n_coarse=100).sizes["vertex"] < 110


def test_a_folder_that_is_no_study_gets_advice_that_works(given, tmp_path):
    with pytest.raises(ValueError, match="there is no such folder"):
        s4a.open_study(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=f"s4a run {given['folder']} --out FOLDER"):
        s4a.open_study(given["folder"])
