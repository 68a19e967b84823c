"""What a champion felt, over time: what its brain was told, and the picture of it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import elbow_robot, world
from mjx_revolve.control.controller import make_controller
from mjx_revolve.episodes.config import make_config
from mjx_revolve.episodes.fitness import make_fitness
from mjx_revolve.view.sensor_log import trace_sensors

SENSORS = [
    {"type": "depth", "range": [0, 4], "noise": 0.05, "rate": 20, "delay": 0.06},
    {"type": "accelerometer", "at": "upper", "range": 30}, {"type": "gyro", "noise": 0.1},
    {"type": "battery", "range": [0, 1]}, {"type": "speed", "noise": 0.2},
    {"type": "load", "delay": 0.02}, {"type": "flow", "each": "FixedBrick", "noise": 0.01},
    {"type": "climb", "each": "Fin"}, {"type": "contact"},
]  # fmt: skip
KEY = jax.random.key(7)


def echo(fitness):
    """The same with a brain whose targets are what it is told, all numbers in two sums."""
    plain = fitness.controller

    def init(parameters):
        return plain.observer.init(jnp.zeros_like(parameters[0]))

    def step(parameters, state, time, sense):
        zero, number = parameters
        state, told = plain.observer.observe(state, time, sense, number)
        robot = sum((k + 1) * x for k, x in enumerate(told.robot)) / 30
        joint = sum((k + 1) * x for k, x in enumerate(told.joint)) / 30
        return state, 0.3 * jnp.tanh(zero + robot + joint)

    def decode(genes, plant):
        return jnp.zeros((plant.num_rows, *genes.shape[1:])), plant.source

    found = make_controller(fitness.engine.plant, (), decode, init, step)
    found = found._replace(signals=plain.signals, observer=plain.observer)
    return replace(fitness, controller=found)


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A fitness, an episode of it, and what was felt."""
    robot = tmp_path_factory.mktemp("felt") / "elbow.yaml"
    elbow_robot(world()).morphology.save(robot)
    config = make_config({
        "morphology": str(robot), "world": {"name": "lake", "current": [0.1, 0.0, 0.0]},
        "controller": {"type": "mlp", "hidden": 2, "messages": 0, "sensors": SENSORS},
        "task": {"type": "directed_swim", "duration": 0.5, "settle": 0.0, "trials": 2,
                 "start_yaw": 1.0},
    })  # fmt: skip
    fitness = echo(make_fitness(config))
    trajectory = jax.tree.map(np.asarray, fitness.replay(np.zeros(0), KEY, trial=1))
    return fitness, trajectory, trace_sensors(fitness, trajectory, KEY, trial=1)


@pytest.mark.long
def test_what_is_true_is_the_trajectorys(seen):
    fitness, trajectory, felt = seen
    found = {one.sensor.label: one for one in felt}
    assert "Fin climb" not in found  # the elbow has none
    assert found["FixedBrick flow"].rows == ("shoulder", "wrist")
    assert found["contact"].rows == ("core", "shoulder", "wrist")
    depth, speed = found["depth"], found["speed"]
    surface = fitness.robot.world.surface_height
    assert depth.true[1:, 0, 0] == pytest.approx(surface - trajectory.qpos[:-1, 2], abs=1e-6)
    assert speed.true[1:, 0] == pytest.approx(trajectory.qvel[:-1, 6:], abs=1e-6)
    work = np.cumsum(trajectory.power) * fitness.robot.world.timestep
    assert found["battery"].true[1:, 0, 0] == pytest.approx(work[:-1], rel=1e-4)
    # At 20 Hz and at least 60 ms late, each value is told for ten steps, and noise is on it.
    assert len(np.unique(depth.given)) == 1 + (len(trajectory.time) - 13) // 10
    assert 0.02 < np.std(speed.given - np.clip(speed.true, *speed.sensor.limits)) < 0.4
    assert [one.is_exact for one in felt] == [
        not {"noise", "rate", "delay"} & set(x) for x in SENSORS if x.get("each") != "Fin"
    ]
