"""What a robot feels: against MuJoCo's own sensors, for one body, for many, and in MJX."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from laboratory import (
    QUICK,
    WATER,
    arm_robot,
    batch_engine,
    box_robot,
    elbow_robot,
    random_states,
    sensed,
    world,
)
from mjx_revolve.control.courses import Course
from mjx_revolve.control.readings import (
    OPTIONAL_SIGNALS,
    EpisodeContext,
    init_memory,
    read_sensors,
    update_memory,
)
from mjx_revolve.engine.batch import fit_capacity
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.water.flow import water_of
from references import mujoco_sensors

LANES = 3
TANK = world(**WATER | {"current": (0.3, 0.0, 0.0), "bed": {"height": -9.0}})
CUES = EpisodeContext(
    target=(1.0, 2.0, -4.0), drift=(0.5, 0.0, 0.0), sight=100.0, course=Course(0.3, 0.1)
)


def senses(make, qpos, qvel, ctrl):
    """What is felt of robots that were told `ctrl`."""
    return sensed(make, TANK, (qpos, qvel), ctrl, OPTIONAL_SIGNALS, CUES, time=2.0)


def own_order(rows, source, count):
    """`[rows, lanes]` of the plant as `[count, lanes]` of the robot's hinges."""
    wide = np.broadcast_to(source[: len(rows)], rows.shape)
    lanes = range(rows.shape[1])
    return np.array(
        [[rows[wide[:, lane] == k, lane].item() for lane in lanes] for k in range(count)]
    )


@pytest.fixture(scope="module")
def robot():
    return arm_robot(TANK)


@pytest.fixture(scope="module")
def states(robot):
    """Any attitude, 6 m deep, and what the servos were told, in the robot's order."""
    qpos, qvel = random_states(robot, LANES, seed=3, speed=0.3, depth=6.0)
    ctrl = qpos[7:] + np.random.default_rng(0).uniform(-0.03, 0.03, qpos[7:].shape)
    return qpos, qvel, ctrl


@pytest.fixture(scope="module")
def felt(robot, states):
    """Of one body, by its own step."""
    return senses(lambda: make_engine(robot), *states)


@pytest.fixture(scope="module")
def hinges(robot):
    return [robot.morphology.modules[k].name for k in robot.morphology.hinges]


@pytest.fixture(scope="module")
def mujocos(robot, states, hinges):
    """What MuJoCo's sensors say of the same states, `[dim, lanes]` by (module, kind)."""
    qpos, qvel, ctrl = states
    found = mujoco_sensors(robot, ["core", *hinges], (qpos, qvel), 0 * qvel, ctrl)
    return {key: rows.T for key, rows in found.items()}


@pytest.mark.slow
def test_the_core_feels_what_mujocos_sensors_do(felt, mujocos, states):
    sense, _ = felt
    axes = np.stack([mujocos["core", f"frame{x}axis"] for x in "xyz"], 1)  # world from core
    assert np.stack(sense.up) == pytest.approx(axes[2], abs=1e-12)
    assert np.stack(sense.north) == pytest.approx(axes[0], abs=1e-12)
    assert np.stack(sense.angular_velocity) == pytest.approx(mujocos["core", "gyro"], abs=1e-12)
    # Water that flows with .3 m/s along x, less the core's own velocity.
    water = np.einsum("ijl,i->jl", axes, (0.3, 0.0, 0.0))
    assert np.stack(sense.flow) == pytest.approx(water - mujocos["core", "velocimeter"], abs=1e-12)
    assert sense.height == pytest.approx(states[0][2])
    assert sense.altitude == pytest.approx(states[0][2] + 9.0)
    # After 2 s the target is at (2, 2, -4).
    away = np.array([2.0, 2.0, -4.0])[:, None] - states[0][:3]
    assert np.stack(sense.target) == pytest.approx(np.einsum("ijl,il->jl", axes, away), abs=1e-12)
    assert sense.seen.all()
    # The course is 0.3 + 2 × 0.1 from x by then.
    ahead = [np.cos(0.5), np.sin(0.5), 0.0]
    assert np.stack(sense.course) == pytest.approx(np.einsum("ijl,i->jl", axes, ahead), abs=1e-12)
    # What stands still feels its weight, and nothing has been done yet.
    assert np.stack(sense.force) == pytest.approx(9.81 * axes[2], abs=1e-12)
    assert not sense.work.any()


def test_joints_feel_what_mujocos_sensors_do(hinges, felt, mujocos):
    sense, source = felt
    for name, kind in (("angle", "pos"), ("speed", "vel"), ("load", "actuatorfrc")):
        expected = np.concatenate([mujocos[hinge, f"joint{kind}"] for hinge in hinges])
        found = own_order(getattr(sense, name), source, len(hinges))
        assert found == pytest.approx(expected, abs=1e-9), name
        assert np.abs(expected).max() > 0.01


@pytest.mark.slow
@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", ["different", "mjx", "alike"])
def test_one_body_many_bodies_and_mjx_feel_the_same(kind, robot, felt, states):
    if kind == "mjx":
        found, source = senses(partial(make_engine, robot, "mjx"), *states)
    else:
        robots = [robot] if kind == "alike" else [robot, robot, elbow_robot(TANK)]
        capacity = fit_capacity([*robots, elbow_robot(TANK)])
        found, source = senses(lambda: batch_engine(robots, capacity, LANES), *states)
    lanes = slice(0, 2 if kind == "different" else LANES)
    one, own = felt
    for name in one._fields:
        rows = name in ("angle", "speed", "load", "touch", "nearest")
        if not rows and getattr(one, name) is not None:
            a, b = np.stack(getattr(found, name)), np.stack(getattr(one, name))
            assert a[..., lanes] == pytest.approx(b[..., lanes], abs=1e-12), name
    for name in ("angle", "speed", "load"):
        a = own_order(getattr(found, name)[:, lanes], source[:, lanes], robot.num_hinges)
        b = own_order(getattr(one, name)[:, lanes], own, robot.num_hinges)
        assert a == pytest.approx(b, abs=1e-9), name


def test_an_accelerometer_in_a_spinning_vacuum_is_mujocos():
    """Off the centre of mass, so that it feels the turning; over a step of .01 ms."""
    tank = world(gravity=9.81, timestep=1e-5)
    off = {"ballast_mass": 0.5, "ballast_position": (0.05, 0.02, 0.0)}
    robot = box_robot((0.2, 0.1, 0.05), 1.0, tank, **off)
    qpos, qvel = random_states(robot, 1, seed=1, speed=3.0)
    spec = robot.mj_spec.copy()
    spec.bodies[1].add_site(name="core")
    site = mujoco.mjtObj.mjOBJ_SITE
    spec.add_sensor(type=mujoco.mjtSensor.mjSENS_ACCELEROMETER, objtype=site, objname="core")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos[:, 0], qvel[:, 0]
    mujoco.mj_forward(model, data)
    with jax.enable_x64(True):
        engine, water = make_engine(robot), water_of(tank)

        def run(qpos, qvel):
            state = engine.init(qpos, qvel)
            memory = init_memory(("force",), engine, state)
            ctrl = jnp.zeros((0, 1))
            new, _ = engine.step(state, ctrl, water)
            memory = update_memory(memory, engine.root(state), engine.root(new), ctrl, 0.0, 1e-5)
            return read_sensors(tank, engine, new, water, 0.0, EpisodeContext(), memory).force

        found = jax.jit(run, compiler_options=QUICK)(jnp.asarray(qpos), jnp.asarray(qvel))
    assert np.concatenate(found) == pytest.approx(data.sensordata, abs=1e-3)
    assert np.abs(data.sensordata).max() > 0.05


@pytest.mark.long
def test_touch_is_the_beds_force_on_each_body(robot):
    """At rest in still lanes above, in and on the bed: as `push` has it of the whole robot."""
    qpos, qvel = random_states(robot, LANES, seed=5, speed=0.0)
    qpos[3:7] = np.array([1.0, 0, 0, 0])[:, None]
    qpos[7:] = 0
    qpos[2] = -8.0, -8.98, -8.99
    ctrl = np.zeros((robot.num_hinges, LANES))
    found, _ = senses(lambda: make_engine(robot), qpos, qvel, ctrl)
    assert found.touch.shape == (1 + robot.num_hinges, LANES)
    assert not found.touch[:, 0].any() and np.sum(found.touch[:, 2] > 0) > 1
    # The core's four lower corners are 2.5 mm deep in a bed of 3 kN/m; nothing else reaches it.
    assert found.touch[:, 1] == pytest.approx([30, 0, 0, 0, 0], rel=1e-9)
    with jax.enable_x64(True):
        engine = make_engine(robot)

        def push(qpos, qvel, gust):
            state = engine.init(qpos, qvel)
            water = water_of(TANK)._replace(acceleration=(gust, 0.0, 0.0))
            return engine.external_force(
                state, engine.plant.arrange(jnp.zeros(ctrl.shape)), water
            ), engine.contact_force(state, water)

        push = jax.jit(push, compiler_options=QUICK)
        (bed, _), felt = push(jnp.asarray(qpos), jnp.asarray(qvel), 0.0)
        # What the step foresees of a gust is no force.
        (same, _), again = push(jnp.asarray(qpos), jnp.asarray(qvel), 0.3)
        np.testing.assert_array_equal(same, bed)
        np.testing.assert_array_equal(again, felt)
    # Nothing moves, so that no force has friction: all of them point up.
    assert found.touch.sum(0) == pytest.approx(np.asarray(bed[2]), rel=1e-9)
