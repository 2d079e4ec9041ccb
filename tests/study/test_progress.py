"""Progress of a run: running, stopped, killed and finished."""

import json
import subprocess
import sys

import pytest
from small import OPTIONS

from s4a import analyse, cli
from s4a.study import pipeline, progress, tasks
from s4a.study.progress import FILE, STAGES, status


def test_a_finished_run_has_done_all_of_every_stage(study_folder, capsys):
    result = status(study_folder)
    assert result.state == "finished"
    assert tuple(result.stages) == STAGES
    assert all(stage.done == stage.all and stage.ended for stage in result.stages.values())
    assert result.stages["registration"].all == 4
    assert result.failures == {}
    assert (result.memory, result.processes) == (0, 0)
    assert cli.main(["status", str(study_folder)]) == 0
    first, _, *lines = capsys.readouterr().out.splitlines()
    assert first.startswith("finished at 20")
    assert [line.split("  ")[0] for line in lines] == list(STAGES)


def test_a_running_or_stopped_run_has_a_progress(brains, tmp_path, monkeypatch, capsys):
    calls = []

    def remesh(folder, name, options):
        if name == "brain_03":
            calls.append(status(folder))
            cli.main(["status", str(folder)])
            raise KeyboardInterrupt
        return tasks.remesh_shape(folder, name, options)

    monkeypatch.setattr(progress, "EVERY", 0)
    monkeypatch.setattr(pipeline, "remesh_shape", remesh)
    with pytest.raises(KeyboardInterrupt):
        analyse(brains, store=tmp_path, **OPTIONS)
    (result,) = calls
    assert (result.state, result.processes >= 1, result.memory > 10) == ("running", True, True)
    now, before = result.stages["remesh and spectrum"], result.stages["compare"]
    assert (now.done, now.all, now.done_before, now.ended) == (2, 4, 0, False)
    assert (before.done, before.all, before.ended) == (4, 4, True)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("running since 20")
    (line,) = (line for line in lines if line.startswith("remesh and spectrum"))
    assert line.split()[3:5] == ["2", "4"]
    assert line.split()[-2] == "about"
    assert lines[-1].split() == ["modes", *"-----"]

    stopped = status(tmp_path)
    assert stopped.state == "stopped"
    assert stopped.stages["remesh and spectrum"][:3] == (2, 4, 0)
    monkeypatch.undo()
    analyse(brains, store=tmp_path, **OPTIONS).close()
    again = status(tmp_path)
    assert again.state == "finished"
    assert again.stages["remesh and spectrum"][:3] == (4, 4, 2)
    assert again.stages["read and clean"][:3] == (4, 4, 4)
    analyse(brains, store=tmp_path, **OPTIONS).close()  # nothing is left to do
    assert list(status(tmp_path).stages) == list(again.stages)


@pytest.fixture
def note(study_folder, tmp_path):
    """Write a changed status file of a finished run into a folder."""

    def put(**changes):
        message = json.loads((study_folder / FILE).read_text())
        (tmp_path / FILE).write_text(json.dumps(message | changes))
        return tmp_path

    return put


def test_a_run_without_process_is_stopped_and_one_of_another_machine_elsewhere(note, capsys):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    assert status(note(over="", owner=gone.pid)).state == "stopped"
    # a process of that number which began after the run is another one
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        assert status(note(over="", owner=child.pid, begun=10**9)).state == "stopped"
        assert status(note(over="", owner=child.pid, begun=10**10)).state == "running"
    finally:
        child.communicate(b"\n")
    folder = note(over="", host="node-17", failures={"a": "x", "b": "y " * 99})
    assert status(folder).state == "elsewhere"
    assert cli.main(["status", str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("on node-17, ")
    assert "left out: a: x" in lines
    assert " ".join(lines).count("y") > 98  # a sentence is not cut
    assert max(map(len, lines)) < 130


def test_a_note_of_another_form_is_refused(tmp_path):
    for text in (b"", b"{", b"[]", b"null", b'{"stages": {}}', b'{"stages": {"a": [1]}}', b"\xff"):
        (tmp_path / FILE).write_bytes(text)
        with pytest.raises(ValueError, match=r"\.progress\.json"):
            status(tmp_path)


def test_a_folder_without_a_run_is_an_error(tmp_path, capsys):
    assert cli.main(["status", str(tmp_path)]) == 2
    assert "no run of this version of s4a was started there" in capsys.readouterr().err
