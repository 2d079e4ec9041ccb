"""The command line: what it prints, how it ends, and that its options are those of `analyse`."""

import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import version

import numpy as np
import pytest
from small import FLAGS

from s4a import Options, cli, synthetic, write_mesh
from s4a.cli import Parser, tables
from s4a.cli.commands import COMMANDS, exit_code
from s4a.extensions import extensions
from s4a.geometry.mesh import as_arrays
from s4a.options import DECLARED
from s4a.schema import dataset
from s4a.study.progress import STAGES


@pytest.fixture(scope="module")
def folder(brain_files):
    """The folder of four small brains."""
    return brain_files[0].parent


@pytest.fixture(scope="module")
def ran(folder, tmp_path_factory):
    """The folder of a study, and what the run wrote."""
    study = tmp_path_factory.mktemp("out") / "study"
    arguments = [sys.executable, "-m", "s4a", "run", str(folder), "--out", str(study), *FLAGS]
    result = subprocess.run(arguments, capture_output=True, text=True, check=False)
    return study, result


def test_run_ends_well_and_says_what_it_found(ran):
    study, result = ran
    assert result.returncode == 0, result.stderr
    assert (study / "pca.nc").exists()
    for words in (
        "4 shapes: 4 ok, 0 repaired, 0 flagged, 0 excluded",
        "median shape: brain_",
        "variance explained:",
        " MiB",
    ):
        assert words in result.stdout
    assert f"s4a view {study}" in result.stdout


def test_run_again_does_nothing_again(ran, folder, capsys):
    study, _ = ran
    before = (study / "latent.nc").stat().st_mtime_ns
    assert cli.main(["run", str(folder), "--out", str(study), *FLAGS]) == 0
    assert (study / "latent.nc").stat().st_mtime_ns == before
    assert "4 ok" in capsys.readouterr().out


def test_a_script_can_ask_for_an_exit_code_where_shapes_are_not_ok(ran, folder, tmp_path, capsys):
    study = shutil.copytree(ran[0], tmp_path / "study")
    (tmp_path / "empty.ply").touch()
    command = ["run", str(folder), str(tmp_path / "empty.ply"), "--out", str(study), *FLAGS]
    for fail_on, code in (("none", 0), ("excluded", 3), ("flagged", 3)):
        assert cli.main([*command, "--fail-on", fail_on]) == code
    assert cli.main(["run", *command[1:2], *command[3:], "--fail-on", "flagged"]) == 0
    assert "1 excluded" in capsys.readouterr().out
    status = [dataset(status=["ok", "flagged"])["status"]]
    assert [exit_code(status, what, 1) for what in ("none", "excluded", "flagged")] == [1, 1, 3]


def test_run_writes_a_line_for_each_stage_where_there_is_no_terminal(ran):
    _, result = ran
    lines = [line for line in result.stderr.splitlines() if line.startswith("INFO: ")]
    stages = [line.split(": ")[1] for line in lines]
    assert [*dict.fromkeys(stages)] == list(STAGES)  # "align" has two groups of tasks
    assert re.fullmatch(r"INFO: registration: 4 of 4 tasks computed, [\d.]+ s, \d+ MiB", lines[-2])
    assert "it/s" not in result.stderr


def test_a_quiet_run_writes_no_stages_and_no_warnings(folder, tmp_path, capfd):
    words = ["run", str(folder), "--pattern", "*_0[12]", "-q", "-o", str(tmp_path / "study")]
    assert cli.main([*words, *FLAGS]) == 0
    assert capfd.readouterr().err == ""


def test_view_writes_a_page_into_the_study_or_where_it_is_told(ran, tmp_path, monkeypatch, capsys):
    study, _ = ran
    page = tmp_path / "page.html"
    monkeypatch.setattr(
        "s4a.write_page", lambda tree, file, **_: file.write_text(f"{len(tree['original'])} shapes")
    )
    assert cli.main(["view", str(study)]) == 0
    assert cli.main(["view", str(study), "--page", str(page)]) == 0
    assert (study / "study.html").read_text() == page.read_text() == "4 shapes"
    assert f"wrote {page}" in capsys.readouterr().out


def test_check_lists_every_shape_that_fits_and_ends_with_1_where_one_is_excluded(
    folder, tmp_path, capsys
):
    assert cli.main(["check", str(folder), "--pattern", "*_0[12]"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:3] == ["shape", "vertices", "components"]
    assert [line.split()[0] for line in lines[1:]] == ["brain_01", "brain_02"]
    assert all(" 1500 " in line and " ok" in line for line in lines[1:])
    bad = tmp_path / "bad.ply"
    bad.write_text("no mesh")
    assert cli.main(["check", str(folder), str(bad)]) == 1
    said = capsys.readouterr().out
    assert "excluded" in next(line for line in said.splitlines() if line.startswith("bad "))
    assert "cannot be read" in " ".join(said.split())


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["check", "nowhere"], "nowhere"),
        (["view", "nowhere"], "not a study folder"),
        (["run", "nowhere", "--out", "study"], "nowhere"),
        (["statistics", "nowhere", "--covariates", "age"], "give --group or --regress-on"),
        (
            ["run", "nowhere", "--out", "study", "--k", "3"],
            "s4a: --k must be an integer of at least 4; found 3",
        ),
    ],
)
def test_an_error_is_one_line_and_the_exit_code_2(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == 2
    caught = capsys.readouterr()
    assert caught.out == ""
    assert caught.err.startswith("s4a: ")
    assert caught.err.count("\n") == 1
    assert words in caught.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments", [[], ["dance"], ["run", "x"], ["run", "x", "--out", "y", "--init", "random"]]
)
def test_wrong_usage_ends_with_2_says_how_and_leaves_the_log_as_it_was(arguments, capsys, caplog):
    filters = list(caplog.handler.filters)
    with pytest.raises(SystemExit) as end:
        cli.main(arguments)
    assert end.value.code == 2
    assert caplog.handler.filters == filters
    assert "usage: s4a" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["rnu", "x"], "'rnu' is not a command; did you mean run?"),
        (["run", "x", "--ncoarse", "3"], "unknown flag --ncoarse; did you mean --n-coarse?"),
        (["run", "x", "--ot=y"], "unknown flag --ot; did you mean --out?"),
        (["run", "x", "-o", "y", "-z"], "unknown flag -z"),
    ],
)
def test_an_unknown_command_or_flag_gets_a_suggestion_and_one_line_of_usage(
    arguments, said, capsys
):
    with pytest.raises(SystemExit) as end:
        cli.main(arguments)
    assert end.value.code == 2
    usage, message = capsys.readouterr().err.splitlines()
    assert usage.startswith("usage: s4a")
    assert message == f"s4a: {said}"


def test_an_error_of_an_option_names_its_flag():
    flags = ["--k", "--k-init", "--lift", "--method", "--both", "--permutations"]
    for message, said in {
        "k must be at least k_init = 20; found 5": "--k must be at least --k-init 20; found 5",
        "method='scalable' has no mesh, and lift=True needs one": (
            "--method 'scalable' has no mesh, and --lift needs one"
        ),
        "preset sets both=False; a.k must stay": "preset sets --no-both; a.k must stay",
        "n_permutations must be 9": "--permutations must be 9",
    }.items():
        assert cli.as_flags(message, flags) == said


def test_help_of_a_run_has_groups_defaults_examples_and_a_link(capsys):
    with pytest.raises(SystemExit):
        cli.main(["run", "--help"])
    said = capsys.readouterr().out
    heads = ["input:", "network:", "registration:", "quality control:", "computing:", "examples:"]
    assert [line for line in said.splitlines() if line in heads] == heads
    assert said.count("  s4a run ") == 3
    assert "https://" in said
    text = " ".join(said.split())
    assert "-k N, --k N size of the refined functional maps (default: 100)" in text
    assert "close each hole with a fan of triangles (default: no)" in text


def test_a_flag_means_one_thing_in_all_commands():
    found = {}
    for name, one in (COMMANDS | extensions("s4a.commands")).items():

        def add(*names, name=name, **settings):
            kind = settings.get("metavar"), settings.get("choices"), names
            if names[-1].startswith("--"):
                found.setdefault(names[-1], {}).setdefault(kind, []).append(name)

        one.flags(add)
    # the methods that `compare` compares have no fast preset
    presets = {choices for _, choices, _ in found.pop("--preset")}
    assert presets == {("paper", "fast"), ("paper",)}
    assert {flag: kinds for flag, kinds in found.items() if len(kinds) > 1} == {}


def parsed(*flags):
    """The options of a run from flags, and its other arguments."""
    args = vars(cli.parser().parse_args(["run", "a", "--out", "study", *flags]))
    return {name: args.pop(name) for name in DECLARED}, args


def test_every_option_of_analyse_is_a_flag_of_run_with_the_same_default():
    found, others = parsed()
    assert Options(**found) == Options()
    assert others["n_jobs"] == -1  # on the command line all cores are taken


def test_flags_give_the_options_their_values():
    flags = "--n-coarse 500 -k 50 --n-latent 40 --init landmarks --remove-size --no-strict"
    flags += " --label 1,2 --components 2 --template None --seed 7"
    found, _ = parsed(*flags.split())
    given = {"n_coarse": 500, "k": 50, "n_latent": 40, "init": "landmarks", "remove_size": True}
    given |= {"label": "1,2", "components": 2, "template": "None", "seed": 7}
    assert Options(**found) == Options(**given)


def test_every_command_has_help(capsys):
    for name in COMMANDS:
        with pytest.raises(SystemExit) as end:
            cli.main([name, "--help"])
        assert end.value.code == 0
        assert f"usage: s4a {name}" in capsys.readouterr().out


def test_flags_and_their_help_follow_from_a_function():
    def double(
        numbers: list[int], *, minus: bool = False, to: str, n: int | str = 2, k: int
    ) -> int:
        """Twice.

        Parameters
        ----------
        numbers : N
            what is doubled
        n
            how often
        """
        return len(numbers) * n + k

    found = cli.command(double, ("k",))
    top = Parser(description=found.run.__doc__)
    found.flags(top)
    args = top.parse_args(["1", "2", "--to", "x", "--n", "3", "--k", "7"])
    assert vars(args) == {"numbers": [1, 2], "minus": False, "to": "x", "n": 3, "k": 7}
    assert found.run(args) == 13
    said = " ".join(top.format_help().split())
    assert "Twice." in said
    assert "N what is doubled" in said
    assert "how often (default: 2)" in said
    with pytest.raises(ValueError, match=r"options of s4a.Options.* expected; found \['sede'\]"):
        cli.command(double, ("k", "sede"))
    double.__annotations__ = dict.fromkeys(double.__annotations__, "bool")  # as by __future__
    given = {}
    cli.command(double).flags(lambda *names, **settings: given.update({names[-1]: settings}))
    assert given["--minus"]["action"] == "store_true"


def test_demo_finds_the_simulated_modes_and_writes_its_page(
    tmp_path, monkeypatch, capsys, no_pictures
):
    monkeypatch.setattr("s4a.write_page", lambda tree, file, **_: file.write_text("page"))
    out = tmp_path / "demo"
    small = "--shapes 4 --vertices 300 --n-jobs 1".split()
    assert cli.main(["demo", "--out", str(out), *small]) == 0
    said = capsys.readouterr().out
    assert "correlation of simulated and recovered scores" in said
    assert said.index("modes.png") < said.index("S4A, registered surface")  # a picture first
    assert (out / "study.html").exists()


def test_demo_of_two_shapes_ends_well_without_modes(tmp_path, capsys, no_pictures):
    small = "--shapes 2 --vertices 300 --n-jobs 1".split()
    assert cli.main(["demo", *small, "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "no modes: PCA needs at least 3 shapes" in out
    (seconds,) = re.findall(r"\d+ s of computing", out)
    assert seconds in (tmp_path / "study.html").read_text(encoding="utf-8")
    assert "study.html" in out
    assert "modes.png" not in out


def test_the_version_is_told(capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"s4a {version('s4a')}\n"


def test_numbers_are_aligned_to_the_right_and_words_to_the_left():
    lines = tables.table([["a", "1"], ["bcd", "200"]], ["name", "count"]).splitlines()
    assert lines == ["name  count", "a         1", "bcd     200"]


def test_a_mesh_written_by_the_library_passes_the_check(tmp_path, capsys):
    write_mesh(tmp_path / "ball.obj", *as_arrays(synthetic.sphere(200)))
    assert cli.main(["check", str(tmp_path)]) == 0
    assert np.isin(["ball", "200"], capsys.readouterr().out.split()).all()


@pytest.mark.parametrize(
    "flags, said",
    [
        (["--n-pairs", "10^22"], "a whole number of at most 18 digits needed, found '10^22'"),
        (["--n-pairs", "9" * 5000], "a whole number of at most 18 digits needed, found '999"),
        (["--n-pairs", "99999999999"], "--n-pairs must be an integer of at most 2147483647"),
        (["--k", "NaN"], "a whole number of at most 18 digits needed, found 'NaN'"),
        (["--seed", "1e3"], "a whole number of at most 18 digits needed, found '1e3'"),
        (["--seed", "-1"], "--seed must be an integer of at least 0; found -1"),
        (["--n-coarse", "²"], "a whole number of at most 18 digits needed, found '²'"),
        (["--components", "²"], "found '²'"),
        (["--n-jobs", "0"], "a number from 1 to 1000 needed, or -1 for all cores, found 0"),
        (["--n-jobs", "1000000"], "a number from 1 to 1000 needed"),
        (["--cluster", "local:²"], "local:N with N from 1 to 999; found 'local:²'"),
        (["--cluster", "local:99999"], "local:N with N from 1 to 999; found 'local:99999'"),
        (["--cluster", "tcp://host"], "--cluster needs tcp://host:port"),
    ],
)
def test_numbers_that_are_none_are_refused_in_a_sentence(tmp_path, capsys, flags, said):
    try:
        code = cli.main(["run", str(tmp_path), "--out", str(tmp_path / "study"), *flags])
    except SystemExit as error:
        code = error.code
    assert code == 2
    assert said in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "study").exists()


def test_letters_that_the_terminal_does_not_know_are_written_as_escapes(tmp_path):
    (tmp_path / "脳.ply").write_bytes(b"")
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    write_mesh(tmp_path / "good.ply", *as_arrays(synthetic.sphere(100)))
    command = [sys.executable, "-m", "s4a", "check", str(tmp_path)]
    ran = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert ran.returncode == 1
    assert ran.stderr == ""
    assert r"\u8133.ply cannot be" in re.sub(r"\s+", " ", ran.stdout)
