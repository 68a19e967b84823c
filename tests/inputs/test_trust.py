"""A stranger's run folder: what is run and read because of it, and what its names can do."""

import json
import os
import shutil
import sys

import numpy as np
import pytest

import toys
from laboratory import ELBOW, check_error
from mjx_revolve import evolve, export, replay, report, viewer
from mjx_revolve.episodes.config import load_config
from mjx_revolve.evolution import run_folder as runs
from mjx_revolve.inputs import trust
from mjx_revolve.inputs import user_code as own_code
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.yaml_reader import load_yaml

MINE = "import pathlib\npathlib.Path({mark!r}).touch()\ndef rise(track, settings): return 0.0\n"
SECRET = "hunter2: s3cr3t-token\n"
COMMANDS = {
    "viewer": (viewer.main, ["run"]),
    "replay": (replay.main, ["run", "--html"]),
    "export": (export.main, ["run", "--out", "out"]),
    "evolve": (evolve.main, ["--resume", "run", "--workers", "1"]),
    "again": (evolve.main, ["run/config.yaml", "--out", "out", "--workers", "1"]),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A run folder that came from elsewhere, with a task in Python, and a private file."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(MINE.format(mark=str(tmp_path / "was run")))
    (tmp_path / "elbow.yaml").write_text(ELBOW)
    settings = {
        "morphology": "elbow.yaml", "world": "lake", "task": {"type": "own.py:rise"},
        "evolution": {"strategy": "SNES", "population_size": 4, "generations": 1},
    }  # fmt: skip
    (tmp_path / "swim.yaml").write_text(json.dumps(settings))
    run, _ = runs.create_run_folder("run", load_config("swim.yaml"), settings=[])
    run.save_champion(np.zeros(3, np.float32), final=False, origin="<b>x</b>\x1b[2J")
    run.close()
    (tmp_path / "private.yaml").write_text(SECRET)
    return tmp_path


def change(folder, **settings):
    """Edits the run's configuration as its owner might have."""
    path = folder / "run" / "config.yaml"
    path.write_text(json.dumps(load_yaml(path) | settings))


@pytest.mark.parametrize("name", COMMANDS)
def test_nothing_of_a_strangers_is_run_unless_allowed(folder, name, capsys):
    main, argv = COMMANDS[name]
    assert run_command(main, argv) == 2
    message = "run/inputs/own.py: expected a Python file that you have used before, or --trust"
    check_error(capsys.readouterr(), message)
    assert not (folder / "was run").exists()
    assert not (folder / "out").exists()


def test_a_report_shows_the_rest(folder, capsys):
    assert run_command(report.main, ["run"]) == 0
    assert "expected a Python file that you have used before, or --trust" in capsys.readouterr().err
    assert not (folder / "was run").exists()
    page = (folder / "run" / "report.html").read_text()
    assert "inputs/own.py" in page and "not shown in full" in page


@pytest.mark.slow
def test_what_one_has_evolved_oneself_is_known(folder):
    toy = toys.make_toy
    main = lambda argv: evolve.main(argv, toy)  # noqa: E731
    assert run_command(main, ["swim.yaml", "--out", "mine"]) == 0
    assert trust.record_path().stat().st_mode & 0o077 == 0
    shutil.move("mine", "moved")
    name = f"{folder / 'moved' / 'inputs' / 'own.py'}:rise"
    with trust.opening("moved", trust=False):
        own_code.load_user_function(name, "task.type")
    (folder / "moved" / "inputs" / "own.py").write_text("rise = print\n")
    with trust.opening("moved", trust=False), pytest.raises(trust.UntrustedError):
        own_code.load_user_function(name, "task.type")
    with trust.opening("moved", trust=True):  # allowed, and known from now on
        own_code.load_user_function(name, "task.type")
    (folder / "copy.py").write_text("rise = print\n")
    with trust.opening("moved", trust=False):
        own_code.load_user_function(f"{folder / 'copy.py'}:rise", "task.type")


@pytest.mark.slow
@pytest.mark.parametrize("argv", [["--resume", "run"], ["run/config.yaml", "--out", "out"]])
def test_a_command_runs_what_is_trusted_and_remembers(folder, argv, capsys):
    shutil.rmtree("run")

    def make(config):
        own_code.load_user_function(config.task.type, "task.type")
        return toys.Toy()

    def run(*argv):
        return run_command(lambda argv: evolve.main(argv, make), [*argv, "--workers", "1"])

    assert run("swim.yaml", "--out", "run") == 0
    shutil.rmtree(folder / "state")  # it has become somebody else's
    code = folder / "run" / "inputs" / "own.py"
    sys.modules.pop(own_code.load_user_function(f"{code}:rise", "task.type").__module__)
    (folder / "was run").unlink()
    assert run(*argv) == 2
    assert "own.py: expected a Python file that you have used" in capsys.readouterr().err
    assert not (folder / "was run").exists()
    assert run(*argv, "--trust") == 0
    assert (folder / "was run").exists()
    if "--out" in argv:
        shutil.rmtree("out")
    assert run(*argv) == 0


def test_what_was_read_is_not_thereby_allowed_to_run(folder):
    text = "id: robot\nbody: {id: core, type: Core}\n"
    (folder / "both.py").write_text(text)
    with trust.remembering():
        load_yaml("both.py")
    with trust.opening("run", trust=False):
        load_yaml("both.py")
        with pytest.raises(trust.UntrustedError):
            own_code.load_user_function(f"{folder / 'both.py'}:body", "task.type")


def test_genes_elsewhere_may_name_a_runs_configuration(folder, capsys):
    (folder / "mine").mkdir()
    genes = folder / "mine" / "genes.yaml"
    genes.write_text(json.dumps({"config": "../run/config.yaml", "genes": [0, 0, 0]}))
    with trust.opening(genes, trust=False):
        load_yaml(folder / "run" / "config.yaml")
        load_yaml(folder / "run" / "inputs" / "elbow.yaml")
        with pytest.raises(trust.UntrustedError):
            load_yaml(folder / "private.yaml")
    assert run_command(viewer.main, ["mine/genes.yaml", "--out", "page.html"]) == 2
    assert "own.py: expected a Python file that you have used" in capsys.readouterr().err
    assert not (folder / "was run").exists()


@pytest.mark.parametrize("place", ["stranger", "stranger/champion/genes.yaml"])
@pytest.mark.parametrize("whole", [True, False])
def test_a_champion_names_no_run_of_the_readers_own(folder, place, whole, capsys):
    change(folder, task={"type": "speed"})
    (folder / "stranger" / "champion").mkdir(parents=True)
    if whole:
        shutil.copy("run/config.yaml", "stranger/config.yaml")
        shutil.copy("run/run.json", "stranger/run.json")
    genes = json.dumps({"config": "../../run/config.yaml", "genes": [0, 0, 0]})
    (folder / "stranger" / "champion" / "genes.yaml").write_text(genes)
    assert run_command(viewer.main, [place, "--out", "page.html"]) == 2
    assert "expected a file inside the run folder" in capsys.readouterr().err


@pytest.mark.parametrize("how", ["named", "link", "config", "body"])
def test_private_files_are_not_shown(folder, how, capsys):
    private = folder / "private.yaml"
    change(folder, task={"type": "speed"})
    if how == "named":
        change(folder, morphology=str(private))
    elif how == "link":
        (folder / "run" / "inputs" / "elbow.yaml").unlink()
        (folder / "run" / "inputs" / "elbow.yaml").symlink_to(private)
    elif how == "config":
        (folder / "run" / "config.yaml").unlink()
        (folder / "run" / "config.yaml").symlink_to(private)
    else:
        genes = folder / "run" / "champion" / "genes.yaml"
        genes.write_text(json.dumps({"config": str(private), "genes": [0, 0, 0]}))
    code = run_command(viewer.main, ["run", "--out", "page.html"])
    code_of_report = 0
    if how != "body":  # nothing is wrong with the rest of that run, which takes a while
        code_of_report = run_command(report.main, ["run", "--out", "report.html"])
    out = "".join(capsys.readouterr())
    page = folder / "report.html"
    shown = out + (page.read_text() if page.exists() else "")
    assert code == 2 and code_of_report in (0, 2)
    assert "s3cr3t" not in shown and "hunter2" not in shown


def test_names_move_no_cursor_and_write_no_markup(folder, capsys):
    nasty = "<script>alert(1)</script>\x1b]0;x\x07\u202e"
    change(folder, **{nasty: 1, "task": {"type": "speed"}})
    body = folder / "run" / "inputs" / "elbow.yaml"
    (folder / "run" / "run.json").write_text("{}")  # no hashes, or the ones that suit
    body.write_text(body.read_text().replace("id:", f"id: {json.dumps(nasty)} # ", 1))
    assert run_command(report.main, ["run", "--out", "report.html"]) == 0
    assert run_command(viewer.main, ["run", "--out", "page.html"]) == 2
    assert "".join(capsys.readouterr()).replace("\n", "").isprintable()
    page = (folder / "report.html").read_text()
    assert "<script>alert" not in page and "<b>x</b>" not in page
    assert not any(c in page for c in "\x1b\x07\u202e")


def test_a_huge_yaml_is_refused_at_once(tmp_path):
    (tmp_path / "big.yaml").write_text("- [1, 2, 3]\n" * 900_000)
    with pytest.raises(InputError, match="expected at most 2 MB of YAML; found more"):
        load_yaml(tmp_path / "big.yaml")
    with pytest.raises(InputError, match="expected a file; found a pipe or a device"):
        load_yaml(os.devnull.replace("null", "zero"))
