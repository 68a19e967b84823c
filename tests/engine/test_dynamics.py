"""The population step against MuJoCo C, against MJX's step, and against itself."""

import copy
import dataclasses
from functools import partial

import mujoco
import numpy as np
import pytest

import laboratory as lab
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.bed import Bed
from mjx_revolve.water.face_drag import FACES
from mjx_revolve.water.flow import Water
from references import check_mujocos_steps, clip_box, rotation

NO_LIMITS = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
MUJOCO_LAWS = ["off", "inertia_box", "ellipsoid"]
CURRENT = (0.2, -0.1, 0.05)


# The BlueROV2 states its own drag, which MuJoCo lacks (`test_fossen`).
REAL = [path for path in lab.OURS + lab.WILD if path.stem != "bluerov2"]


def drawn(robot, lanes, seed=0, speed=1.0):
    """Random states far below the surface, and targets that saturate some servos."""
    qpos, qvel = lab.random_states(robot, lanes, seed=seed, speed=speed, depth=50.0)
    ctrl = np.random.default_rng(seed + 1).uniform(-1, 1, (robot.mj_model.nu, lanes))
    return qpos, qvel, ctrl


def stock(robot):
    """The robot with MuJoCo's own servos, which have no top speed."""
    return lab.with_motors(robot, np.inf)


def mujoco_model(robot, drag):
    """A copy of the model with MuJoCo's own fluid, and without its limit constraints."""
    model = copy.copy(robot.mj_model)
    model.opt.disableflags |= NO_LIMITS
    if drag != "off":
        model.opt.density, model.opt.viscosity = robot.world.density, robot.world.viscosity
        model.opt.wind = robot.world.current
    return model


def mujoco_qacc(model, qpos, qvel, ctrl):
    data, found = mujoco.MjData(model), []
    for q, v, c in zip(qpos.T, qvel.T, ctrl.T, strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, c
        mujoco.mj_forward(model, data)
        found.append(data.qacc.copy())
    return np.array(found).T


def relative(found, expected):
    """Largest error of each lane over its largest acceleration."""
    return np.abs(found - expected).max(0) / np.abs(expected).max(0)


def check_acceleration(robot, drag="off", lanes=32, error=1e-10, x64=True):
    states = drawn(robot, lanes)
    expected = mujoco_qacc(mujoco_model(robot, drag), *states)
    assert relative(lab.accelerate(robot, *states, x64=x64), expected).max() < error


@pytest.mark.slow
@pytest.mark.parametrize("drag", MUJOCO_LAWS)
def test_acceleration_is_mujocos(drag):
    """To rounding of float64, with a current as MuJoCo's wind."""
    robot = stock(lab.arm_robot(lab.world(gravity=9.81, drag=drag, current=CURRENT)))
    check_acceleration(robot, drag)


@pytest.mark.slow
@pytest.mark.sampled(3)
@pytest.mark.parametrize("path", REAL, ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_acceleration_of_real_bodies(path):
    """Every shipped and wild morphology in MuJoCo's inertia box, float32."""
    morphology = load_morphology(path, allow_overlap=True)
    robot = stock(build_robot(morphology, lab.world(gravity=9.81, drag="inertia_box")))
    check_acceleration(robot, "inertia_box", lanes=16, error=2e-5, x64=False)


LIMB = """
body:
  type: Core
  children:
    0: {type: FixedBrick}
    1: {type: ActiveHinge, children: {1: {type: FixedBrick, children: {2: {type: FixedBrick}}}}}
"""


def slanted(text):
    """A morphology whose modules are each turned by 20° more than the one before, any way round."""
    morphology = lab.read(text)
    modules = []
    for k, module in enumerate(morphology.modules):
        quat = np.zeros(4)
        axis = np.array([1.0, 2.0, -2.0]) / 3
        mujoco.mju_axisAngle2Quat(quat, axis, np.radians(20.0 * k))
        modules.append(dataclasses.replace(module, rotation=module.rotation @ rotation(quat)))
    return dataclasses.replace(morphology, modules=tuple(modules))


def test_slanted_modules_have_mujocos_water():
    """Boxes that do not stand square on their bodies, and hinges that point anywhere."""
    robot = stock(build_robot(slanted(LIMB), lab.world(drag="ellipsoid", current=CURRENT)))
    qpos, qvel, ctrl = drawn(robot, 8)
    expected = mujoco_qacc(mujoco_model(robot, "ellipsoid"), qpos, qvel, ctrl)
    assert np.all(relative(lab.accelerate(robot, qpos, qvel, ctrl), expected) < 1e-10)


def test_slanted_modules_have_our_water():
    """A rigid body at the surface, its acceleration from the sum over its parts, in NumPy."""
    rigid = LIMB.replace("ActiveHinge", "FixedBrick")
    robot = build_robot(slanted(rigid), lab.world(**lab.WATER | {"added_mass": False}))
    model, table, density = robot.mj_model, robot.fluid, robot.world.density
    faces = FACES.numbers(table, robot.world)
    qpos, qvel = lab.random_states(robot, 6)
    qpos[2] = np.linspace(-0.06, 0.06, 6)
    found, data = lab.accelerate(robot, qpos, qvel), mujoco.MjData(model)
    for lane in range(6):
        data.qpos[:], data.qvel[:] = qpos[:, lane], qvel[:, lane]
        mujoco.mj_forward(model, data)
        force, mass = -data.qfrc_bias, np.zeros((6, 6))
        mujoco.mj_fullM(model, data, mass)
        for p, half in enumerate(table.half_size):
            turn = data.xmat[1].reshape(3, 3)
            place = data.xpos[1] + turn @ table.position[p]
            axes = turn @ table.rotation[p]
            jacobians = np.zeros((3, 6)), np.zeros((3, 6))
            mujoco.mj_jac(model, data, *jacobians, place, 1)
            v, w = (axes.T @ j @ qvel[:, lane] for j in jacobians)
            center = table.center_of_volume[p]
            share, moment = clip_box(axes[2], -place[2], half)
            lift = density * 9.81 * table.volume[p] * axes[2]
            push = share * (lift - faces.linear[p] * np.abs(v) * v)
            twist = -share * faces.angular[p] * np.abs(w) * w
            twist += np.cross(moment + share * center, lift)
            force = force + jacobians[0].T @ axes @ push + jacobians[1].T @ axes @ twist
        expected = np.linalg.solve(mass, force)
        assert found[:, lane] == pytest.approx(expected, rel=1e-9, abs=1e-9 * abs(expected).max())


def test_several_children_upon_one_of_several_equal_links():
    """Two links alike, one with two children and one with none."""
    text = """
id: tree
body:
  id: core
  type: Core
  children:
    0: {id: left, type: ActiveHinge, children: {1: {id: a, type: FixedBrick}}}
    1: {id: right, type: ActiveHinge, children: {1: {id: b, type: FixedBrick, children: {
      1: {id: c, type: ActiveHinge}, 2: {id: d, type: ActiveHinge}, 3: {id: e, type: ActiveHinge},
    }}}}
"""
    robot = stock(build_robot(lab.read(text), lab.world(gravity=9.81)))
    check_acceleration(robot, lanes=16)


@pytest.mark.parametrize("drag", ["off", pytest.param("inertia_box", marks=pytest.mark.slow)])
def test_trajectory_is_mujocos(drag):
    """300 steps of `mj_step`, joints within their limits: Euler with implicit joint damping."""
    robot = stock(lab.elbow_robot(lab.world(gravity=9.81, drag=drag)))
    qpos, qvel, ctrl = drawn(robot, 6, speed=0.5)
    ctrl *= 0.4
    _, q, v, _ = lab.march(robot, 1.5, qpos, qvel, ctrl)
    check_mujocos_steps(mujoco_model(robot, drag), qpos, qvel, ctrl, (q, v), (1e-6, 1e-5))
    assert np.all(np.abs(q[:, 7:]) < np.pi / 4)


# With all that WATER has. One hinge will do, but in the last, as a servo moves those below it, too.
BEDDED = {"bed": Bed(kind="flat", height=-0.3), "current": (0.1, 0.0, 0.0)}
FIN = "body: {type: Core, children: {0: {type: ActiveHinge, children: {1: {type: Fin}}}}}"
FULL = {
    "core": (partial(build_robot, lab.body("core")), {"current": CURRENT}),
    "bed": (lab.oar_robot, BEDDED),
    "auv": (partial(build_robot, lab.body("auv")), {"current": CURRENT}),
    "fin": (partial(build_robot, lab.read(FIN)), {"current": CURRENT}),
    "ellipsoid": (lab.oar_robot, {"drag": "ellipsoid"}),
    "plates": (lab.oar_robot, {"drag": "lift_drag", "buoyancy": "mask", "current": CURRENT}),
    "two hinges": (lab.elbow_robot, BEDDED),
}


@pytest.mark.slow
@pytest.mark.sampled(3)
@pytest.mark.parametrize("case", FULL)
def test_the_two_engines_agree(case):
    """Through the surface, half a second in float64; beyond its range a servo stops."""
    make, fields = FULL[case]
    robot = make(lab.world(**lab.WATER | fields))
    qpos, qvel, ctrl = drawn(robot, 4, speed=0.3)
    qpos[2] = [-0.2, -0.05, 0.0, 0.1]
    ctrl[:, 1] *= 3.0
    _, q, v, work = lab.march(robot, 0.5, qpos, qvel, ctrl)
    _, other_q, other_v, other_work = lab.march(robot, 0.5, qpos, qvel, ctrl, engine="mjx")
    assert np.abs(q[-1] - qpos).max() > 0.05
    assert other_q == pytest.approx(q, abs=1e-9)
    assert other_v == pytest.approx(v, abs=1e-7)
    assert other_work == pytest.approx(work, abs=1e-9)


@pytest.mark.slow
def test_joints_stop_at_their_limits():
    """Neither target nor swing takes a hinge past its end by more than a fraction of a degree."""
    robot = lab.elbow_robot(lab.world())
    qpos, qvel = lab.at_rest(robot, 2)
    qvel[6:, 0], qvel[6:, 1] = 8.0, -8.0
    ctrl = np.tile([[2.0, -2.0]], (robot.num_hinges, 1))
    _, q, v, _ = lab.march(robot, 2.0, qpos, qvel, ctrl)
    assert np.abs(q[:, 7:]).max() < np.pi / 4 + np.radians(0.5)
    assert np.abs(q[-1, 7:]) == pytest.approx(np.pi / 4, abs=1e-3)
    assert np.abs(v[-1, 6:]).max() < 1e-3


def test_power_is_what_the_servos_deliver():
    """|torque × speed| summed over the hinges, the torque within the servo's effort."""
    robot = stock(lab.elbow_robot(lab.world()))
    qpos, qvel = lab.at_rest(robot, 2)
    ctrl = np.array([[0.5, -0.05], [-0.03, 0.7]])
    time, q, v, worked = lab.march(robot, 0.3, qpos, qvel, ctrl)
    model = robot.mj_model
    angle = np.concatenate([qpos[None, 7:], q[:-1, 7:]])
    speed = np.concatenate([qvel[None, 6:], v[:-1, 6:]])
    torque = np.clip(model.actuator_gainprm[:, :1] * (ctrl - angle), -0.17658, 0.17658)
    assert worked == pytest.approx(np.abs(torque * speed).sum(1) * time[0], rel=1e-9)
    assert worked.sum(0).min() > 0


@pytest.mark.slow
def test_lanes_do_not_know_of_each_other(elbow):
    """A lane's bits depend neither on where it stands nor on a neighbour that blew up."""
    qpos, qvel, ctrl = drawn(elbow, 8)
    _, q, v, _ = lab.march(elbow, 0.5, qpos, qvel, ctrl)
    assert np.all(np.isfinite(v))
    sick = qvel.copy()
    sick[3, 5] = np.nan
    _, sick_q, sick_v, _ = lab.march(elbow, 0.5, qpos, sick, ctrl)
    others = np.arange(8) != 5
    assert np.all(np.isnan(sick_v[-1, :6, 5]))
    assert np.array_equal(sick_q[..., others], q[..., others])
    assert np.array_equal(sick_v[..., others], v[..., others])
    turned = np.roll(np.arange(8), 3)
    _, rolled, _, _ = lab.march(elbow, 0.5, qpos[:, turned], qvel[:, turned], ctrl[:, turned])
    assert np.array_equal(rolled, q[..., turned])


def test_the_water_may_differ_between_lanes():
    """Each lane's surface and current are its own."""
    robot = build_robot(lab.body("core"), lab.world(gravity=9.81, buoyancy="partial", drag="faces"))
    qpos, qvel = lab.at_rest(robot, 3, -1.0)
    water = Water(np.array([0.0, -9.0, 0.0]), (np.array([0.0, 0.0, 0.3]), 0.0, 0.0))
    qacc = lab.accelerate(robot, qpos, qvel, water=water)
    sunk = -9.81 * (1 - 999.1026 * 5.054e-5 / 0.09)
    assert qacc[2] == pytest.approx([sunk, -9.81, sunk])
    drag = 0.5 * 999.1026 * 1.05 * 0.089 * 0.045 * 0.3**2 / 0.09
    assert qacc[0] == pytest.approx([0.0, 0.0, drag])


@pytest.mark.slow
def test_convergence_in_the_time_step():
    """After half a second: what changes when the step halves, halves too, or better."""
    ends = []
    for dt in (0.004, 0.002, 0.001):
        robot = build_robot(lab.body("core"), lab.world(**lab.WATER, timestep=dt))
        qpos, qvel = lab.at_rest(robot, 2, -0.5)
        qpos[2, 1], qvel[:6] = 0.0, 0.2
        ends.append(lab.march(robot, 0.5, qpos, qvel, every=round(0.1 / dt))[1][-1])
    ratio = np.linalg.norm(ends[1] - ends[0]) / np.linalg.norm(ends[2] - ends[1])
    assert ratio > 1.7


@pytest.mark.slow
def test_an_unknown_engine_is_refused(elbow):
    with pytest.raises(InputError, match=r"^engine: expected one of population, mjx; found 'c'$"):
        make_engine(elbow, "c")
