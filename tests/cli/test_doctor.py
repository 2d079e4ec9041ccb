"""``s4a doctor``: what is broken on a machine is named, with what to type, and the exit code."""

import stat
import subprocess
import sys

import pytest

from s4a import cli
from s4a.cli import doctor
from s4a.cli.doctor import Finding


def of(findings, what):
    (found,) = [finding for finding in findings if finding.what == what]
    return found


@pytest.fixture
def other_modules(tmp_path, monkeypatch):
    """A folder whose modules processes find before all others."""
    folder = tmp_path / "modules"
    folder.mkdir()
    monkeypatch.setenv("PYTHONPATH", str(folder), prepend=":")
    return folder


def test_on_this_machine_nothing_is_lacking_and_nothing_is_left_behind(tmp_path, capsys):
    assert cli.main(["doctor", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "0 missing" in said
    assert "missing  " not in said
    assert list(tmp_path.iterdir()) == []


def test_what_is_lacking_makes_the_exit_code_1(monkeypatch, capsys):
    lacking = [Finding("a", "missing", "broken", "mend a"), Finding("b", "note", "odd")]
    monkeypatch.setattr("s4a.cli.commands.examine", lambda folder: lacking)
    assert cli.main(["doctor"]) == 1
    said = capsys.readouterr().out
    assert "-> mend a" in said
    assert said.endswith("1 missing, 1 to know\n")


@pytest.mark.parametrize(
    "source, told",
    [
        ("raise ImportError('libGL.so.1: no such file')\n", "libGL.so.1"),
        ("class MeshSet:\n    def __init__(self, verbose): pass\n", "without its filters"),
        ("import os; os.abort()\n", "ends its process"),
    ],
)
def test_a_broken_pymeshlab_is_no_more_than_a_note_on_wrapping(other_modules, source, told):
    (other_modules / "pymeshlab.py").write_text(source)
    found = doctor.wrapping()
    assert (found.what, found.state) == ("for --wrap", "note")
    assert told in found.found
    assert "libgl1 libopengl0" in found.do


def test_without_pymeshlab_its_extra_is_named(monkeypatch):
    there = doctor.version_of
    monkeypatch.setattr(doctor, "version_of", lambda n: "" if n == "pymeshlab" else there(n))
    found = of(list(doctor.extras()), "for --wrap")
    assert (found.state, found.do) == ("note", "pip install 's4a[wrap]'")


def test_a_package_that_is_missing_old_or_broken_is_named_with_what_to_type(
    other_modules, monkeypatch
):
    (other_modules / "igl.py").write_text("raise OSError('wrong ELF class')\n")
    needed = [("nosuchthing", "1.0"), ("numpy", "99.1"), ("libigl", "1.0"), ("scipy", "1.0")]
    monkeypatch.setattr(doctor, "needed", lambda extra="": needed)
    found = list(doctor.dependencies())
    assert of(found, "nosuchthing").do == "pip install --upgrade 'nosuchthing>=1.0'"
    assert of(found, "numpy").do == "pip install --upgrade 'numpy>=99.1'"
    assert "wrong ELF class" in of(found, "igl").found
    assert of(found, "igl").do == "pip install --force-reinstall libigl"
    assert {one.state for one in found} == {"missing"}
    assert len(found) == 3


def test_the_packages_are_those_of_the_project_and_none_of_its_extras():
    names = {name for name, _ in doctor.needed()}
    assert {"numpy", "libigl", "xarray"} <= names
    assert not names & {"jupyterlab", "pymeshlab", "pytest", "dask"}
    assert "jupyterlab" in {name for name, _ in doctor.needed("notebook")}


def test_a_folder_that_is_not_there_or_a_file_is_told(tmp_path):
    assert doctor.writable("study folder", tmp_path, "another").state == "ok"
    assert doctor.writable("study folder", tmp_path / "none", "another").state == "missing"
    (tmp_path / "file").touch()
    assert doctor.writable("study folder", tmp_path / "file", "another").state == "missing"


def test_a_folder_without_leave_to_write_is_told(tmp_path):
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        (tmp_path / "as root").touch()
    except PermissionError:
        assert doctor.writable("study folder", tmp_path, "another").state == "missing"
    else:
        pytest.skip("root may write everywhere")
    finally:
        tmp_path.chmod(stat.S_IRWXU)


def test_little_memory_is_a_note(monkeypatch):
    monkeypatch.setattr(doctor, "LEAST_MEMORY", 1e9)
    assert doctor.memory().state == "note"


def test_it_runs_where_a_package_that_s4a_imports_is_missing():
    code = (
        "import sys; sys.modules['xarray'] = None; sys.modules['joblib'] = None\n"
        "from s4a import cli; sys.exit(cli.main(['doctor']))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert "Traceback" not in result.stderr
    assert "for --wrap" in result.stdout
