"""What the tests of both distributions share: small shapes and studies, and how examples run.

Shapes are made once in a worker and the studies on the disk once in a run, when first needed; tests
copy what they change.
Examples of docstrings run as they stand, with no name that they do not make themselves; what they
write to temporary folders is gone afterwards.
"""

import contextlib
import os
import sys
import tempfile
from functools import partial

import pytest
from small import OPTIONS, without_pictures

import s4a
from s4a import analyse, coarsen, open_study, spectrum, synthetic

# where no number of processes is given, commands use one: to start another takes as long as a small
# study. Tests of several processes give their number
os.environ.setdefault("LOKY_MAX_CPU_COUNT", "1")

# jsonschema, of nbformat, would make the grammar of addresses of it, for a second in every worker
sys.modules["rfc3987_syntax"] = None
# what a test reads, the system has, before it is on the disk
os.fsync = lambda handle: None


@pytest.fixture(autouse=True)
def example(request):
    """The surroundings of an example; nothing is made for tests that are none."""
    if not isinstance(request.node, pytest.DoctestItem):
        return
    request.node.dtest.globs.clear()
    monkeypatch = request.getfixturevalue("monkeypatch")
    monkeypatch.setattr(tempfile, "tempdir", str(request.getfixturevalue("tmp_path")))
    source = "".join(example.source for example in request.node.dtest.examples)
    if "example_study" in source:
        study = request.getfixturevalue("example_study")
        monkeypatch.setattr(synthetic, "example_study", lambda: study)
    if "example_structures" in source and "synthetic" not in request.node.path.stem:
        from s4a_morphometrics import open_structures

        several = open_structures(request.getfixturevalue("structures_folder")).load()
        monkeypatch.setattr("s4a_morphometrics.synthetic.example_structures", lambda: several)


@pytest.fixture(scope="session")
def brains():
    """Four small brains with labels, landmarks and the truth."""
    return synthetic.brains(4, 1500, seed=1)


@pytest.fixture(scope="session")
def meshes(brains):
    """The brains as Datasets by name."""
    return {name: node.to_dataset() for name, node in brains["original"].children.items()}


@pytest.fixture(scope="session")
def brain_files(brains, tmp_path_factory):
    """The brains as PLY files."""

    def make(folder):
        synthetic.write(brains, folder)
        (folder / "truth.nc").unlink()

    return sorted(made_once(tmp_path_factory, "brains", make).glob("*.ply"))


def made_once(tmp_path_factory, name, make):
    """A folder that one worker makes for all; where none can wait for it, each makes its own."""
    base = tmp_path_factory.getbasetemp()
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(ImportError):
            import fcntl

            base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
            fcntl.flock(stack.enter_context(open(base / f"{name}.lock", "w")), fcntl.LOCK_EX)
        if not (base / f"{name}.made").exists():
            make(base / name)
            (base / f"{name}.made").touch()
    return base / name


@pytest.fixture(scope="session")
def study_folder(brains, tmp_path_factory):
    """The folder of the finished study of the brains."""

    def make(folder):
        analyse(brains, store=folder, **OPTIONS).close()

    return made_once(tmp_path_factory, "study_of_brains", make)


@pytest.fixture(scope="session")
def example_study(tmp_path_factory):
    """The study of examples, which is in memory."""

    def make(folder):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(synthetic, "analyse", partial(analyse, store=folder))
            synthetic.example_study().close()

    with open_study(made_once(tmp_path_factory, "study_of_examples", make)) as tree:
        return tree.load()


@pytest.fixture(scope="session")
def structures_folder(tmp_path_factory):
    """The folder of the example study of several structures."""
    from s4a_morphometrics import analyse_structures
    from s4a_morphometrics.synthetic import subjects

    small = {"n_coarse": 100, "k": 10, "k_init": 6, "n_pairs": 6}

    def make(folder):
        analyse_structures(subjects(6, 200), store=folder, **small)

    return made_once(tmp_path_factory, "study_of_structures", make)


@pytest.fixture(scope="session")
def study(study_folder):
    """The study of the brains, in memory."""
    with open_study(study_folder) as tree:
        return tree.load()


@pytest.fixture(scope="session")
def study_of_files(brain_files, tmp_path_factory):
    """The study of the files, whose positions are rounded to single precision."""

    def make(folder):
        analyse(brain_files, store=folder, **OPTIONS).close()

    with open_study(made_once(tmp_path_factory, "study_of_files", make)) as tree:
        return tree.load()


@pytest.fixture(scope="session")
def brain():
    """One brain of 4,000 vertices."""
    return synthetic.brains(1, 4000)["original/brain_01"].to_dataset()


@pytest.fixture(scope="session")
def low_brain(brain):
    """That brain at low resolution, with 40 eigenfunctions."""
    return spectrum(coarsen(brain, n_coarse=900), k=40)


@pytest.fixture
def short_films(monkeypatch):
    """Commands write films of two small pictures; long ones have tests of their own."""
    film = s4a.write_film
    monkeypatch.setattr(s4a, "write_film", lambda *what: film(*what, n_frames=2, width=100))


@pytest.fixture
def no_pictures(monkeypatch):
    """Pages have pictures of a few pixels; those that are looked at have tests of their own."""
    without_pictures(monkeypatch)


@pytest.fixture(scope="module")
def no_pictures_in_module():
    """The same for all tests of a module that comes first to pages."""
    with pytest.MonkeyPatch.context() as patch:
        without_pictures(patch)
        yield


def pytest_terminal_summary(terminalreporter):
    """Processor time and peak memory of every notebook that ran, and of all together."""
    reports = [r for kind in ("passed", "failed") for r in terminalreporter.getreports(kind)]
    spent = sorted(
        value
        for r in reports
        if r.when == "call"
        for name, value in r.user_properties
        if name == "notebook"
    )
    if spent:
        terminalreporter.section("notebooks")
        for name, seconds, memory in spent:
            terminalreporter.write_line(f"{name:28}{seconds:8.1f} s{memory:8.0f} MiB")
        total, most = sum(s for _, s, _ in spent), max(m for *_, m in spent)
        terminalreporter.write_line(
            f"{f'{len(spent)} together':28}{total:8.1f} s{most:8.0f} MiB at most"
        )


# files that take long begin first, the longest before all, so that no worker waits for the other
SLOW = """
notebooks browser pages site interruptions panels_browser study_files several faults quality_control
scenes_browser leave_one_out scalable_study labels insert save_browser complete widgets pipeline
steps initial_map cli release subjects landmarks plausibility in_browser reflect compare cluster
preset touch_browser properties fuzz features asymmetry extension raw two_block
""".split()


def pytest_collection_modifyitems(items):
    """Slow files first; the others stay in their order."""
    place = {f"test_{name}": i for i, name in enumerate(SLOW)}
    items.sort(key=lambda item: place.get(item.path.stem, len(SLOW)))
