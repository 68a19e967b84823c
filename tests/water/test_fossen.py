"""Added mass and damping that modules state themselves, and coefficients per axis."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import ROOT, accelerate, at_rest, box_robot, face_drag, march, read, world
from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.module_types import Fossen
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.engine.batch import fit_capacity, pack_bodies
from mjx_revolve.engine.batched_trees import make_batched_trees
from mjx_revolve.engine.population import acceleration
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.engine.step_constants import read_constants
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.flow import water_of

SIZE, MASS = (0.2, 0.1, 0.06), 1.2
ADDED = np.diag([1.0, 2.0, 3.0, 0.02, 0.03, 0.04])
ADDED[0, 4] = ADDED[4, 0] = 0.05
ADDED[1, 5] = ADDED[5, 1] = -0.06
LINEAR = np.diag([1.0, 0.5, 2.0, 0.01, 0.02, 0.03])
LINEAR[1, 3] = LINEAR[3, 1] = 0.02
SQUARE = np.array([3.0, 4.0, 5.0, 0.1, 0.1, 0.1])
STATED = Fossen(added_mass=ADDED, linear_damping=LINEAR, quadratic_damping=SQUARE)
WATER = {"drag": "faces", "added_mass": True}


@pytest.fixture(scope="module")
def stated():
    return box_robot(SIZE, MASS, world(**WATER), fossen=STATED)


def moving(robot, seed=0):
    qpos, qvel = at_rest(robot, 1, -5.0)
    qvel[:6, 0] = np.random.default_rng(seed).normal(size=6) * 0.4
    return qpos, qvel


def by_hand(robot, nu):
    """(M + A) ν̇ + C(ν) ν + D(ν) ν = 0, as MuJoCo has accelerations."""
    inertia = np.diag([MASS] * 3 + [*robot.mj_model.body_inertia[1]]) + ADDED
    momentum = inertia @ nu
    turning = np.concatenate([
        np.cross(nu[3:], momentum[:3]),
        np.cross(nu[3:], momentum[3:]) + np.cross(nu[:3], momentum[:3]),
    ])  # fmt: skip
    found = np.linalg.solve(inertia, -turning - (LINEAR + np.diag(SQUARE * np.abs(nu))) @ nu)
    found[:3] += np.cross(nu[3:], nu[:3])
    return found


def test_a_stated_added_mass_couples_and_damping_is_linear_and_quadratic(stated):
    assert stated.fluid.drag == ("fossen",) and stated.fluid.coupled.all()
    qpos, qvel = moving(stated)
    found = accelerate(stated, qpos, qvel)[:, 0]
    assert found == pytest.approx(by_hand(stated, qvel[:, 0]), rel=1e-9)


@pytest.mark.slow
def test_mjx_has_the_same(stated):
    qpos, qvel = moving(stated)
    each = [march(stated, 0.2, qpos, qvel, every=40, engine=e)[2] for e in ("population", "mjx")]
    assert each[1] == pytest.approx(each[0], rel=1e-6)


def test_a_speed_decays_as_under_linear_and_quadratic_damping():
    mass, a, b, speed = MASS + 1.0, 1.5, 4.0, 0.8
    own = Fossen(added_mass=[1.0] * 6, linear_damping=[a] * 6, quadratic_damping=[b] * 6)
    robot = box_robot(SIZE, MASS, world(**WATER, timestep=0.001), fossen=own)
    qpos, qvel = at_rest(robot, 1, -5.0)
    qvel[0] = speed
    time, _, after, _ = march(robot, 2.0, qpos, qvel, every=100)
    decay = np.exp(-a / mass * time)
    exact = a * speed * decay / (a + b * speed * (1 - decay))
    assert after[:, 0, 0] == pytest.approx(exact, rel=2e-3)


def test_what_goes_in_and_out_of_the_water_gains_no_energy(stated):
    """Its slam has the whole 6×6, too."""
    tank = world(**WATER, gravity=9.81, buoyancy="partial")
    robot = box_robot(SIZE, 0.6, tank, fossen=STATED)
    qpos, qvel = moving(robot)
    qpos[2], qvel[2] = 0.1, -1.0
    _, q, v, _ = march(robot, 4.0, qpos, qvel, every=10)
    assert np.isfinite(v).all()
    assert np.abs(v[-20:]).max() < 0.5 and q[:, 2].max() < 0.15


def test_no_world_has_more_of_them_than_it_has_water():
    for fields, drag, carries in (
        ({"drag": "off"}, "off", True),
        ({"drag": "ellipsoid"}, "ellipsoid", True),
        ({"added_mass": False}, "fossen", False),
        ({"density": 0.0}, "fossen", False),
    ):
        robot = box_robot(SIZE, MASS, world(**WATER | fields), fossen=STATED)
        assert robot.fluid.drag == (drag,) and robot.fluid.carries == carries
        assert robot.fluid.coupled.any() == carries


def test_coefficients_may_differ_from_axis_to_axis():
    ones = box_robot(SIZE, MASS, world(**WATER))
    own = {"drag_coefficient": (1.0, 2.0, 3.0), "added_mass_coefficient": (0.5, 1.0, 2.0)}
    robot = box_robot(SIZE, MASS, world(**WATER), **own)
    factor = np.array(own["added_mass_coefficient"])
    assert robot.fluid.carried_mass[0] == pytest.approx(factor * ones.fluid.carried_mass[0])
    beside = (factor[[1, 2, 0]] + factor[[2, 0, 1]]) / 2
    assert robot.fluid.carried_inertia[0] == pytest.approx(beside * ones.fluid.carried_inertia[0])
    still = world(drag="faces")
    qpos, qvel = at_rest(robot, 3, -5.0)
    qvel[:3] = 0.5 * np.eye(3)
    push = -MASS * accelerate(box_robot(SIZE, MASS, still, **own), qpos, qvel)[:3]
    area = np.prod(SIZE) / np.array(SIZE)
    expected = 0.5 * still.density * np.array([1, 2, 3]) * area * 0.25
    assert np.diag(push) == pytest.approx(expected, rel=1e-9)
    # However large they are, and with factors, what drags only brakes.
    for drag, tank in ((40.0, world(**WATER)), (8.0, world(drag="faces"))):
        braked = box_robot(SIZE, MASS, tank, drag_coefficient=drag, factors=(("drag", 5.0),))
        qpos, qvel = at_rest(braked, 3, -5.0)
        qvel[:3] = 0.8 * np.eye(3)
        after = march(braked, 0.1, qpos, qvel)[2][:, :3]
        assert (np.diff(np.linalg.norm(after, axis=1), axis=0) < 0).all()
    idle = box_robot(SIZE, MASS, world(drag="off"), drag_coefficient=40.0)
    assert not read_constants(idle.assembly).bounds.steep.any()
    # Params take them, too; one number is three of the same, bit for bit.
    same, one = (box_robot(SIZE, MASS, still, drag_coefficient=x) for x in ((1.7,) * 3, 1.7))
    assert all(map(np.array_equal, *(jax.tree.leaves(face_drag(x)) for x in (same, one))))
    given = read("body: {type: Core, params: {drag_coefficient: [1, 2, '3;']}}")
    assert given.modules[0].kind.parts[0].drag_coefficient == (1.0, 2.0, 3.0)


def test_near_the_surface_stated_water_keeps_its_submerged_share_under_any_drag_law():
    tank = world(gravity=9.81, buoyancy="partial", near_surface=True, **WATER)
    found = []
    for law in (None, "faces"):
        robot = box_robot(SIZE, MASS, tank, fossen=Fossen(added_mass=[1.0] * 6), drag=law)
        qpos, qvel = at_rest(robot, 1, -0.03)
        qvel[0] = 1e-9
        found.append(accelerate(robot, qpos, qvel))
    assert found[0] == pytest.approx(found[1], abs=1e-6)


def test_where_they_may_stand():
    whole = "body: {type: Core, params: {fossen: {whole: true}}, children: {1: {type: %s}}}"
    body = read(whole % "FixedBrick")
    robot = build_robot(body, world(**WATER))
    assert robot.fluid.drag == ("fossen", "off") and not robot.fluid.carries
    # Nor does a brick that states a coupling of its own keep that.
    own = np.diag([0.5] * 3 + [0.001] * 3) + 0.01 * np.eye(6)[::-1]
    stated = f"FixedBrick, params: {{fossen: {{added_mass: {own.tolist()}}}}}"
    assert not build_robot(read(whole % stated), world(**WATER)).fluid.coupling[1].any()
    assert set(build_robot(body, world(drag="ellipsoid")).fluid.drag) == {"ellipsoid"}
    with pytest.raises(InputError, match=r"expected no hinges, as the core's fossen\.whole"):
        read(whole % "ActiveHinge")
    brick = "body: {type: Core, children: {1: {type: %s, params: {fossen: {%s}}}}}"
    with pytest.raises(InputError, match="a module with one part; found type ActiveHinge with 2"):
        read(brick % ("ActiveHinge", "whole: false"))
    with pytest.raises(InputError, match="first part of a core only"):
        read(brick % ("FixedBrick", "whole: true"))


@pytest.mark.slow
def test_different_bodies_side_by_side_and_gradients():
    tank = world(**WATER)
    damped = f"{{added_mass: {ADDED.tolist()}, quadratic_damping: [3, 4, 5, .1, .1, .1]}}"
    limb = read(
        f"body: {{type: Core, children: {{1: {{type: FixedBrick, params: {{fossen: {damped}}}}}}}}}"
    )
    boxes = [box_robot(SIZE, MASS, tank, **more) for more in ({}, {"fossen": STATED})]
    robots = [build_robot(limb, tank), *boxes]
    capacity = fit_capacity(robots)
    qpos, qvel = at_rest(robots[0], 3, -5.0)
    qvel[:6] = np.random.default_rng(0).normal(size=(6, 3))
    with jax.enable_x64(True):
        packed = jax.tree.map(jnp.asarray, pack_bodies(robots, capacity, np.float64))
        tree = make_batched_trees(tank, capacity, packed, 3)
        ctrl = packed.plant.arrange(jnp.zeros((capacity.hinges, 3)))

        @jax.jit
        def run(v):
            fall = lambda v: acceleration(tree, jnp.asarray(qpos), v, ctrl, water_of(tank))  # noqa: E731
            found, pull = jax.vjp(fall, v)
            return found, pull(jnp.ones_like(found))[0]

        found, slope = run(qvel)
        _, at_standstill = run(np.zeros_like(qvel))
    assert np.isfinite(slope).all() and np.isfinite(at_standstill).all() and np.any(slope)
    for k, robot in enumerate(robots):
        alone = accelerate(robot, qpos[:, k : k + 1], qvel[:, k : k + 1])
        assert np.asarray(found)[:6, k] == pytest.approx(alone[:, 0], rel=1e-9)
    # A chunk without such parts has the same tables.
    pack_bodies(robots[1:2], capacity)


def test_a_bluerov2_is_the_published_one():
    robot = build_robot(load_morphology(ROOT / "morphologies" / "bluerov2.yaml"), world(**WATER))
    body, model = robot.morphology, robot.mj_model
    assert body.mass == pytest.approx(13.5, rel=1e-4)
    assert body.volume == pytest.approx(0.0134, rel=1e-4)
    assert body.center_of_mass == pytest.approx([0, 0, 0], abs=1e-6)
    assert body.center_of_volume == pytest.approx([0, 0, 0.01], abs=1e-5)
    assert sorted(model.body_inertia[1]) == pytest.approx([0.23, 0.26, 0.37], rel=1e-4)
    carried = robot.world.density * robot.fluid.carried_mass.sum(0)
    assert carried == pytest.approx([6.3567, 7.1206, 18.6863])
    curve = MODULES["T200"].parts[0].thruster
    assert [curve.thrust_at(x) for x in (-1, 0, 1)] == [-39.92, 0, 51.45]
    # Ahead: bow thrusters push, stern ones pull; below the centre of mass, so it noses up.
    ctrl = np.array([[1.0, 1.0, -1.0, -1.0, 0, 0, 0, 0]] * 2).T
    push = np.sqrt(0.5) * 2 * (51.45 + 39.92)
    qpos, qvel = at_rest(robot, 2, -5.0)
    qvel[0, 1] = (-13.7 + np.sqrt(13.7**2 + 4 * 141.0 * push)) / (2 * 141.0)
    assert qvel[0, 1] == pytest.approx(0.91, abs=0.01)  # its top speed [m/s]
    found = accelerate(robot, qpos, qvel, ctrl)
    assert found[0] == pytest.approx([push / (13.5 + 6.3567), 0.0], rel=1e-4, abs=1e-3)
    nose = -0.085 * push / (0.23 + 0.1348)
    assert found[[3, 4, 5], 0] == pytest.approx([0.0, nose, 0.0], rel=1e-3, abs=1e-6)
