"""JSON Schemas: those of the shipped files are the code's, and tell right files from wrong ones."""

import json
import re
import shutil
import subprocess

import pytest

from laboratory import ROOT
from mjx_revolve.completion import make_script
from mjx_revolve.inputs.yaml_reader import load_yaml
from mjx_revolve.schema import FOLDER, KINDS, make_schema, show_schema

jsonschema = pytest.importorskip("jsonschema", reason="it checks files against schemas")

FOLDERS = ("configs", "morphologies", "experiments", "mjx_revolve/water/worlds")
FILES = [path for folder in FOLDERS for path in (ROOT / folder).glob("*.yaml")]


@pytest.fixture(scope="module")
def schemas():
    return {kind: make_schema(kind) for kind in KINDS}


def problems(schema, data):
    jsonschema.Draft202012Validator.check_schema(schema)
    plain = json.loads(json.dumps(data))  # keys are texts
    return [e.message for e in jsonschema.Draft202012Validator(schema).iter_errors(plain)]


@pytest.mark.parametrize("kind", KINDS)
def test_written_schemas_are_the_codes(kind):
    text = (FOLDER / f"{kind}.json").read_text("utf-8")
    assert text == show_schema(kind), f"run: python -m mjx_revolve schema {kind}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_shipped_files_name_their_schema_and_fit_it(path, schemas):
    (named,) = re.findall(r"^# yaml-language-server: \$schema=(\S+)$", path.read_text(), re.M)
    found = (path.parent / named).resolve()
    assert found.parent == FOLDER
    assert problems(schemas[found.stem], load_yaml(path)) == []


@pytest.mark.parametrize(("kind", "data"), [
    ("config", {"world": "lake"}),
    ("config", {"world": "lake", "task": {"type": "speed", "duratoin": 3}}),
    ("world", {"density": "heavy"}),
    ("world", {"waves": {"amplitude": "high"}}),
    ("morphology", {"body": {"type": "Core", "children": {0: {"orientation": 0}}}}),
    ("morphology", {"body": {"type": "Core", "params": {"mass": -1}}}),
    ("modules", {"modules": {"A": {"mount": "up", "parts": [{"size": [1, 1, 1], "mass": 1}]}}}),
    ("sweep", {"config": "x.yaml", "seeds": 0}),
])  # fmt: skip
def test_wrong_files_do_not_fit(kind, data, schemas):
    assert problems(schemas[kind], data)


def test_completion_has_the_shipped_names():
    script = make_script("bash")
    assert "lake_swim" in script and "spider" in script and "schema completion" in script
    assert make_script("zsh").endswith(script)


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_completion_loads_in_a_shell_of_no_settings(shell):
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} on the path")
    plain = {"bash": "--norc", "zsh": "-f"}[shell]
    done = subprocess.run(
        [shell, plain, "-c", f"{make_script(shell)}\ncomplete -p mjx-revolve"],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0 and "_mjx_revolve" in done.stdout and not done.stderr


@pytest.mark.parametrize("words, expected", [
    (["ev"], "evolve"),
    (["report", "r"], "runs"),
    (["viewer", "r"], "revolve_snake runs"),
    (["viewer", "spider", "--world", "l"], "lake"),
    (["evolve", "--resume", "r"], "runs"),
    (["live", "lake_sw"], "lake_swim"),
    (["inspect", "my"], "my robot.yaml"),
    (["schema", "w"], "world"),
])  # fmt: skip
def test_completion_has_files_beside_names(words, expected, tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "my robot.yaml").touch()
    call = f"COMP_WORDS=(mjx-revolve {' '.join(words)}); COMP_CWORD={len(words)}; _mjx_revolve"
    done = subprocess.run(
        ["bash", "--norc", "-c", f'{make_script("bash")}\n{call}\necho "${{COMPREPLY[*]}}"'],
        capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert (done.stdout.strip(), done.stderr) == (expected, "")
