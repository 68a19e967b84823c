"""What is printed of values in a notebook: a line, not all their numbers."""

from dataclasses import dataclass, field

import numpy as np

from mjx_revolve import (
    build_robot,
    load_config,
    load_morphology,
    load_world,
    make_fitness,
    make_mixed_fitness,
)
from mjx_revolve.episodes.champion import Episode
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.inputs.short_repr import short_repr
from mjx_revolve.view.motion import analyse_motion


@dataclass(repr=False)
class Some:
    name: str
    rows: np.ndarray
    more: object = None
    hidden: int = field(default=3, repr=False)
    __repr__ = short_repr


def test_arrays_by_shape_and_nothing_by_nothing():
    assert repr(Some("a", np.zeros((200, 3)))) == "Some(name='a', rows [200, 3])"
    assert repr(Some("a", np.float64(2.0))) == "Some(name='a', rows=np.float64(2.0))"
    inner = Some("b" * 500, np.zeros(2))
    assert len(repr(Some("a", np.zeros(1), inner))) < 200


def test_what_a_user_prints_is_short():
    """Bodies, worlds, robots, configurations, fitnesses, trajectories, episodes and motions."""
    body, water = load_morphology("spider"), load_world("lake")
    robot = build_robot(body, water)
    nq, nv, nu = robot.mj_model.nq, robot.mj_model.nv, robot.mj_model.nu
    time = 0.005 * np.arange(1, 2001)
    qpos = np.zeros((2000, nq))
    qpos[:, 3] = 1.0
    trajectory = Trajectory(
        time, qpos, np.zeros((2000, nv)), np.zeros((2000, 10, 3)), np.zeros((2000, nu)), 0 * time
    )
    assert repr(trajectory).startswith(f"Trajectory(time [2000], qpos [2000, {nq}], qvel [2000, ")
    episode = Episode("spider", robot, trajectory)
    config = load_config("lake_swim")
    things = (body, water, robot, config, trajectory, episode, analyse_motion(robot, trajectory))
    assert {type(x).__name__: len(repr(x)) for x in things if len(repr(x)) > 900} == {}
    assert len(repr(robot.fluid)) < 2000 and len(repr(robot.assembly)) < 2500
    assert len(repr(body)) < 100 and len(repr(trajectory)) < 200
    fitness = repr(make_fitness(config))
    assert fitness.startswith("Fitness(directed_swim in lake, Morphology('spider'")
    assert fitness.endswith(", 195 genes)")
    mixed = repr(make_mixed_fitness("smoke", [body]))
    assert mixed.startswith("MixedFitness(") and len(mixed) < 100
