"""A film of many robots: who is there when, what the camera sees, and the command."""

from __future__ import annotations

import math

import av
import numpy as np
import pytest
import yaml

from laboratory import ROOT, body
from mjx_revolve import replay
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.colony import Actor, Mark
from mjx_revolve.view.film import crowd_draw, opengl
from mjx_revolve.view.film.camera import plan_circle
from mjx_revolve.view.film.crowd import make_crowd
from mjx_revolve.water.world import load_world

SIZE = (160, 120)
SETTINGS = {
    "trim": "neutral",
    "world": {"name": "empty_underwater", "bed": False, "drag": "ellipsoid", "timestep": 0.0125},
    "controller": {"type": "sine"},
    "task": {"type": "speed", "duration": 1.0, "settle": 0.2, "trials": 1, "depth": 1.0},
    "bodies": {"max_modules": 4, "max_hinges": 1, "brains": {"inheritance": "darwinian"}},
    "colony": {
        "interval": 1.0,
        "look": 0.5,
        "arena": {"size": 2.5, "depth": 3.0},
        "birth": {"radius": 1.0, "initial": 3, "least": 3},
        "life": {"window": 1.0},
    },
    "evolution": {"population_size": 4, "generations": 1, "checkpoint_every": 1, "seed": 3},
}


@pytest.fixture(scope="module")
def actors():
    """One stays; one is put to the other side at 1 s; one is born at 1 s and dies at 2 s."""
    robot = build_robot(body("spider"), load_world("lake"))

    def actor(name, begin, until, x, y, **more):
        time = np.arange(begin, until, 0.05)
        qpos = np.zeros((len(time), 7 + robot.num_hinges))
        qpos[:, 0], qpos[:, 1], qpos[:, 2], qpos[:, 3] = x, y, -0.5, 1.0
        return Actor(name, robot, time, qpos, **more)

    leaper = actor("leaps", 0.0, 3.0, 2.0, 0.0)
    leaper.qpos[leaper.time >= 1.0 - 1e-9, 0] = -2.0
    return [
        actor("stays", 0.0, 3.0, 0.0, 1.5, start=0.0),
        leaper,
        actor("lives", 1.05, 2.0, 0.0, -1.5, start=1.0, end=2.0),
    ]


def film(actors, **more):
    return make_crowd(actors, "three", span=(0.0, 3.0), leap=2.5, size=SIZE, **more)


def test_who_is_there_when(actors):
    found = film(actors, fps=30)
    assert len(found.time) == 90
    assert found.alive[:2].all()
    assert found.alive[2].tolist() == [30 <= k < 60 for k in range(90)]
    assert [x.tolist() for x in found.births] == [[1.0], [2]]
    assert [x.tolist() for x in found.deaths] == [[2.0], [2]]
    # Never between the two sides, though frames lie between poses.
    assert set(found.qpos[1][:, 0].tolist()) == {2.0, -2.0}
    words = [crowd_draw._count(found, frame) for frame in (0, 30, 89)]
    assert words == [
        "2 robots   0 births   0 deaths",
        "3 robots   1 birth   0 deaths",
        "2 robots   1 birth   1 death",
    ]


@pytest.mark.parametrize(("depth", "above"), [(0.2, True), (60.0, False)])
def test_the_camera_circles_and_sees_most(depth, above):
    random, time = np.random.default_rng(0), np.arange(60) / 2
    places = np.tile(random.uniform(-5, 5, (40, 1, 3)), (1, 60, 1)) * (1, 1, 0) - (0, 0, depth)
    alive = np.ones((40, 60), bool)
    shots = plan_circle(time, places, alive, reach=0.2, aspect=4 / 3, surface=0.0)
    assert shots.above is above
    middle = np.median(places[:, 0], axis=0)
    off = shots.position - middle
    assert np.arctan2(off[:, 2], np.hypot(off[:, 0], off[:, 1])) == pytest.approx(math.pi / 4)
    turned = np.unwrap(np.arctan2(off[:, 1], off[:, 0]))
    assert np.degrees(turned[-1] - turned[0]) == pytest.approx(3.0 * time[-1])
    for frame in range(0, 60, 10):
        flat, away = shots.project(frame, places[:, frame])
        inside = (np.abs(flat) < (4 / 3, 1)).all(1) & (away > 0)
        assert inside.mean() >= 0.75


def test_nobody_is_left():
    """The camera stays where it was."""
    alive = np.zeros((1, 20), bool)
    alive[0, :5] = True
    places = np.ones((1, 20, 3)) * (1.0, 2.0, -1.0)
    shots = plan_circle(np.arange(20) / 10, places, alive, reach=0.2, aspect=1.0, surface=10.0)
    assert np.isfinite(shots.position).all()
    assert np.linalg.norm(shots.position - (1.0, 2.0, -1.0), axis=1) == pytest.approx(
        np.full(20, shots.distance)
    )


def test_the_dead_are_not_drawn(actors, monkeypatch):
    """Something is as far away as a robot, where it is in the frame, while it lives."""
    try:
        way = opengl.find_opengl()
    except InputError as error:
        pytest.skip(str(error))
    found = film(actors, fps=1, marks=[Mark("clinic", (0.0, 0.0, -1.0), 1.0)])
    depths, plan = [], crowd_draw.make_crowd_overlay

    def overlay(crowd):
        write = plan(crowd)

        def keep(picture, depth, frame):
            depths.append(depth)
            return write(picture, depth, frame)

        return keep

    monkeypatch.setattr(crowd_draw, "make_crowd_overlay", overlay)
    frames = list(crowd_draw.draw_crowd(found, way))
    assert [frame.shape for frame in frames] == [(120, 160, 3)] * 3
    seen = 0
    for frame in range(3):
        for k in range(3):
            (flat,), (away,) = found.shots.project(frame, found.qpos[k][frame, None, :3])
            row, column = 60 - 60 * flat[1], 80 + 60 * flat[0]
            if not (2 < row < 118 and 2 < column < 158):
                continue
            near = depths[frame][int(row) - 2 : int(row) + 3, int(column) - 2 : int(column) + 3]
            # Behind them is nothing but the bed, far below.
            drawn = abs(near.min() - away) < actors[0].robot.morphology.length
            assert drawn == found.alive[k, frame], (k, frame)
            seen += 1
    assert seen >= 6
    assert found.alive[2].tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([str(ROOT / "morphologies" / "fish.yaml"), "--colony"], "run folder of a colony"),
        (["run", "--colony", "--view"], "--colony: expected none of --view, --html, --ancestors"),
        (["run", "--colony", "--out", "a.html"], "ends in .mp4 or .gif, with a film of several"),
        ([str(ROOT / "morphologies" / "fish.yaml"), "--time", "3"], "--time: expected --colony"),
        ([str(ROOT), "--colony", "--seed", "1"], "--seed: expected none with --colony"),
    ],
)
def test_what_is_no_film_of_a_colony(arguments, words, capsys):
    assert run_command(replay.main, arguments) == 2
    assert words in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_films_a_run(tmp_path, capsys):
    try:
        opengl.find_opengl()
    except InputError as error:
        pytest.skip(str(error))
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").write_text(
        yaml.safe_dump(SETTINGS)
    )  # all that a colony's beginning needs
    arguments = [str(run), "--colony", "--time", "1", "--duration", "2"]
    arguments += ["--size", "160x120", "--fps", "5"]
    assert replay.main(arguments) == 0
    assert "robots, 160 x 120" in capsys.readouterr().out
    with av.open(str(run / "colony.mp4")) as file:
        stream = file.streams.video[0]
        assert sum(1 for _ in file.decode(stream)) == 10
        assert (stream.width, stream.height) == SIZE
    assert run_command(replay.main, arguments) == 2  # never over a film that is there
    assert "expected no such file yet" in capsys.readouterr().err
