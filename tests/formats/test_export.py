"""The command that writes robots and rollouts for other programs."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from exports import ODD, odd_episode
from mjx_revolve.control.controller import Controller
from mjx_revolve.episodes import champion as episodes
from mjx_revolve.export import main
from mjx_revolve.formats.brain import make_brain
from mjx_revolve.inputs.commands import run_command

# Its commands are constant.
HELD = Controller(
    0, (), lambda genes, plant: (), lambda parameters: (),
    lambda parameters, state, time, sense: (state, jnp.full((3, 1), 0.1)),
)  # fmt: skip


@pytest.fixture(scope="module")
def episode():
    return odd_episode()


@pytest.mark.slow
def test_command_simulates_a_morphology(tmp_path, monkeypatch, capsys):
    pytest.importorskip("rosbags", reason="the package rosbags writes bags")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "odd.yaml").write_text(ODD)
    (tmp_path / "sea.yaml").write_text("bed: off\n")  # half as long to compile
    words = ("--world", "sea.yaml", "--duration", "0.2", "--out", "x", "--seed", "3")
    code, out, _ = run(capsys, "odd.yaml", *words)
    assert code == 0
    assert "ROS 2 bag: 0.2 s, 20 poses of 3 links" in out


@pytest.fixture
def quick(monkeypatch, episode, tmp_path):
    """The command without its seconds of compiling and drawing, in a folder of its own."""
    monkeypatch.setattr("mjx_revolve.view.build_page._draw", lambda *_: "data:,")
    monkeypatch.setattr(episodes, "load_episode", lambda *_: episode)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "odd.yaml").touch()
    (tmp_path / "run").mkdir()
    return tmp_path


def run(capsys, *arguments):
    code = run_command(main, [str(one) for one in arguments])
    out, err = capsys.readouterr()
    return code, out, err


@pytest.mark.slow
def test_command_writes_everything_once(quick, capsys):
    pytest.importorskip("rosbags", reason="the package rosbags writes bags")
    code, out, err = run(capsys, "odd.yaml")
    assert code == 0
    assert err == (
        "no controller: --controller: expected a champion; found a morphology, which has no genes\n"
    )
    folder = quick / "odd <one>_export"
    names = {path.name for path in folder.iterdir()}
    files = {"robot.xml", "robot.urdf", "robot.sdf", "rollout.mcap", "build.html"}
    assert names == {*files, "meshes"}
    assert len(out.splitlines()) == len(names)
    mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    mujoco.MjModel.from_xml_path(str(folder / "robot.urdf"))  # finds its meshes
    code, _, err = run(capsys, "odd.yaml")
    assert code == 2 and err.startswith("error: odd <one>_export: expected no such folder yet")
    assert run(capsys, "odd.yaml", "--out", folder)[0] == 0  # by name, it may


def test_command_writes_only_what_is_named(quick, capsys):
    code, _, err = run(capsys, "odd.yaml", "--mjcf", "new/a.xml")
    assert (code, err) == (2, "error: --mjcf new/a.xml: expected the folder new; found none\n")
    (quick / "new").mkdir()
    assert run(capsys, "odd.yaml", "--mjcf", "new/a.xml")[0] == 0
    assert [path.name for path in quick.rglob("*.xml")] == ["a.xml"]


def test_command_writes_a_champions_controller(quick, capsys, monkeypatch, episode):
    code, _, err = run(capsys, "odd.yaml", "--controller", "a.py")
    assert code == 2 and err.startswith("error: --controller: expected a champion; found a morph")
    brain = make_brain(episode.robot, HELD, np.zeros(0), 20.0)
    monkeypatch.setattr("mjx_revolve.formats.brain.champion_brain", lambda *_: brain)
    champion = dataclasses.replace(episode, fitness=object(), genes=np.zeros(0))
    monkeypatch.setattr(episodes, "load_episode", lambda *_: champion)
    code, out, err = run(capsys, "odd.yaml", "--controller", "my_brain.py")
    assert (code, err) == (0, "")
    names = ["my_brain.c", "my_brain.h", "my_brain.py", "my_brain_node.py"]
    assert sorted(path.name for path in quick.glob("my_brain*")) == names
    assert len(out.splitlines()) == len(names) and "20 Hz" in out
    first = {name: (quick / name).read_bytes() for name in names}
    assert b"from my_brain import" in first["my_brain_node.py"]
    assert b'#include "my_brain.h"' in first["my_brain.c"]
    assert run(capsys, "odd.yaml", "--controller", "my_brain.py")[0] == 0
    assert first == {name: (quick / name).read_bytes() for name in names}


WRONG = [
    (["a.yaml", "--mjcf", "a.txt"],
     "--mjcf a.txt: expected a name that ends in .xml; found '.txt'"),
    (["a.yaml", "--controller", "my-brain.py"],
     "--controller my-brain.py: expected a name that Python can import (letters, digits and _)"),
    (["a.yaml", "--mjcf", "dir.xml"], "--mjcf dir.xml: expected a file; found a folder"),
    (["a.yaml", "--out", "b", "--sdf", "a.sdf"], "--out: expected a folder or single files; found"),
    (["a.yaml", "--duration", "nan"], "--duration: expected a number > 0 and <= 86400 [s]; found"),
    (["a.yaml", "--mjcf", "file/a.xml"], "--mjcf file/a.xml: expected the folder file; found a"),
    (["a.yaml", "--mjcf", "a.xml", "--meshes", "x/"],
     "--meshes: expected --urdf, --sdf or all formats; found neither"),
    (["a.yaml", "--build", "a.html", "--duration", "3"],
     "--duration: expected --mcap or all formats; found neither"),
    (["a.yaml", "--urdf", "a.urdf", "--seed", "3"],
     "--seed: expected --mjcf, --sdf, --mcap or all formats; found neither"),
    (["a.yaml", "--urdf", "a.urdf", "--meshes", "package://a/meshes"],
     "--meshes: expected a prefix that ends in /; found 'package://a/meshes'"),
    (["run", "--world", "lake"], "world: expected none: a champion swims in the world it evolved"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), WRONG)
def test_command_refuses_in_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dir.xml").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "other.yaml").write_text("a: 1\n")
    (tmp_path / "run" / "champion").mkdir(parents=True)
    (tmp_path / "run" / "champion" / "genes.yaml").write_text("genes: [0]\n")
    code, _, err = run(capsys, *arguments)
    assert code == 2
    assert err.startswith(f"error: {message}")
    assert len(err.splitlines()) == 1
