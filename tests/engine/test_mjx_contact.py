"""MJX's own contacts: MuJoCo's solver on top of our step, with the carried water in its matrix."""

import copy

import mujoco
import numpy as np
import pytest

from laboratory import ROOT, WATER, at_rest, body, box_robot, elbow_robot, march, refusal, world
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.fitness import make_fitness
from mjx_revolve.episodes.simulate import simulate
from mjx_revolve.water.bed import Bed, bed_height
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import load_world
from references import Lagrangian, check_mujocos_steps, clearance, each_lane

RHO, G, MU = 999.1026, 9.81, 0.4
FLAT = {"kind": "flat", "height": -2.0, "friction": MU, "contact": "mjx"}
SIZE = (0.1, 0.08, 0.05)
VOLUME = float(np.prod(SIZE))
MASS = 1.25 * RHO * VOLUME
WEIGHT = (MASS - RHO * VOLUME) * G  # under water
FLOOR = FLAT["height"] + SIZE[2] / 2  # where the box's centre is when it just touches


def block(**fields):
    """A box a quarter heavier than water, in water without drag, above a flat bed."""
    return box_robot(SIZE, MASS, world(**WATER | {"drag": "off", "bed": FLAT} | fields))


def sunk(robot, weight):
    """Depth at which MuJoCo's four soft contacts carry a weight: no more than its documentation.

    Force of a contact at rest, f = k d(r) r / R, with k = 1 / (d_max τ)², R = (1 - d) / d times
    the inverse weight, and the impedance d = .9 + .1 (r / mm)² for small depths r.
    """
    inverse = robot.mj_model.body_invweight0[1, 0]
    depth = 0.0
    for _ in range(50):
        d = 0.9 + 0.05 * 2 * (depth / 1e-3) ** 2
        depth = weight / 4 * inverse * (1 - d) / d / (d / (0.95 * 0.02) ** 2)
    return depth


REFUSED = (
    "bed.contact: expected 'penalty' with engine: population; found 'mjx' "
    "(choose engine: mjx, or contact: penalty)"
)


def test_the_population_step_refuses():
    robot = block()
    for ask in (
        lambda: make_engine(robot),
        lambda: make_engine(robot, contact=False),
        lambda: simulate(robot, duration=0.1),
        lambda: make_fitness(
            ROOT / "configs" / "lake_swim.yaml", **{"world.bed": {"contact": "mjx"}}
        ),
    ):
        assert refusal(ask) == REFUSED


@pytest.mark.slow
def test_modules_meet_the_bed_only():
    """MuJoCo's filter lets through pairs with the bed; its friction is the bed's."""
    tank = {"surface_height": -9.0, "gravity": G}
    model = elbow_robot(world(bed=FLAT, **tank)).mj_model
    bed = model.geom("bed").id
    for a in range(model.ngeom):
        for b in range(a):
            meet = (model.geom_contype[a] & model.geom_conaffinity[b]) | (
                model.geom_contype[b] & model.geom_conaffinity[a]
            )
            assert bool(meet) == (bed in (a, b))
    data = mujoco.MjData(model)
    data.qpos[2] = FLAT["height"]
    mujoco.mj_forward(model, data)
    assert data.ncon > 0
    assert np.all(data.contact.friction[:, :2] == MU)
    # Without it, no geom meets any other, and the options are MuJoCo's.
    plain = elbow_robot(world(bed=FLAT | {"contact": "penalty"}, **tank)).mj_model
    assert not plain.geom_contype.any()
    assert not plain.geom_conaffinity.any()
    assert (plain.opt.cone, plain.nnumeric) == (mujoco.mjtCone.mjCONE_PYRAMIDAL, 0)


@pytest.fixture(scope="module")
def slid():
    """The box set down, pushed along x, pushed along y, and set down above the water."""
    robot = block()
    qpos, qvel = at_rest(robot, 4, FLOOR - sunk(robot, WEIGHT))
    qpos[2, 0] = qpos[2, 3] = FLOOR + 0.002
    qvel[0, 1] = qvel[1, 2] = 0.3
    still = (np.zeros(4),) * 3
    water = Water(np.array([0.0, 0.0, 0.0, -50.0]), still)
    return robot, qpos, *march(robot, 0.6, qpos, qvel, water=water, engine="mjx")[:3]


@pytest.mark.long
def test_at_rest_it_carries_the_weight_under_water(slid):
    """And the whole weight where there is no water: by the depth that MuJoCo's softness makes."""
    robot, _, _, q, v = slid
    for lane, weight in ((0, WEIGHT), (3, MASS * G)):
        assert np.abs(v[-1, :, lane]).max() < 1e-5
        assert FLOOR - q[-1, 2, lane] == pytest.approx(sunk(robot, weight), rel=1e-3)
        assert q[-1, :2, lane] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.slow
def test_sliding_loses_what_coulomb_takes_from_mass_and_water(slid):
    """μ (W - B) / (m + m_a), m_a of either direction; it hops a little, so over 0.25 s."""
    robot, _, time, _, v = slid
    at = round(0.25 / robot.world.timestep) - 1
    for axis in (0, 1):
        mass = MASS + RHO * robot.fluid.carried_mass[0, axis]
        lost = 0.3 - v[at, axis, 1 + axis]
        assert lost / time[at] == pytest.approx(MU * WEIGHT / mass, rel=0.05)
        assert np.abs(v[:, 1 - axis, 1 + axis]).max() < 1e-6
        # It stops and does not come back.
        assert v[:, axis, 1 + axis].min() > -1e-2
        assert abs(v[-1, axis, 1 + axis]) < 1e-2


@pytest.mark.slow
def test_without_water_it_is_mujocos_step():
    """Box against MuJoCo C, step by step: falling, landing on a face, sliding, resting."""
    robot = box_robot(SIZE, MASS, world(gravity=G, bed=FLAT))
    qpos, qvel = at_rest(robot, 2, FLOOR + 0.003)
    qvel[:2, 1] = 0.3, 0.2
    _, *found, _ = march(robot, 0.3, qpos, qvel, engine="mjx")
    # C's solver stops at 1e-8 of its own scale, and a step remembers the one before.
    check_mujocos_steps(robot.mj_model, qpos, qvel, np.zeros((0, 2)), found, (1e-6, 1e-4))


@pytest.fixture(scope="module")
def wet():
    """The box with drag and everything: thrown about, and set down in currents."""
    robot = block(drag="faces")
    draw = np.random.default_rng(0)
    qpos, qvel = at_rest(robot, 8, FLOOR)
    qpos[3:7, :5] = draw.normal(size=(4, 5))
    qpos[3:7, :5] /= np.linalg.norm(qpos[3:7, :5], axis=0)
    qpos[2, :5] = FLAT["height"] + 0.1
    qvel[:, :5] = draw.normal(size=(6, 5)) * np.array([[1, 1, 1, 9, 9, 9]]).T
    qvel[2, :5] -= 1.0
    current = np.zeros((3, 8))
    current[0, 5:] = 0.0, 0.2, 1.0
    water = Water(np.zeros(8), tuple(current))
    return robot, qpos, qvel, march(robot, 2.0, qpos, qvel, water=water, engine="mjx")


@pytest.mark.slow
def test_nothing_falls_through(wet):
    """Thrown at some m/s and 9 rad/s, in five attitudes; no contact ever adds energy."""
    robot, qpos, qvel, (_, q, v, _) = wet
    lagrangian = Lagrangian(robot, RHO)
    energy = lambda a, b: each_lane(lagrangian.energy, a, b) + WEIGHT * a[2]  # noqa: E731
    for lane in range(5):
        clear = clearance(robot, q[:, :, lane])
        assert clear.min() > -0.015
        assert -1e-3 < clear[-1] < 0
        assert np.abs(v[-1, :, lane]).max() < 1e-3
        start = energy(qpos[:, lane, None], qvel[:, lane, None])
        assert max(energy(q[:, :, lane].T, v[:, :, lane].T)) < start


@pytest.mark.long
def test_jointed_without_water_it_is_mujocos_step():
    """An elbow tips, until MJX leaves a corner out: it has those within 1 mm of the deepest."""
    robot = elbow_robot(world(gravity=G, bed=FLAT))
    model = copy.copy(robot.mj_model)
    # MuJoCo knows no top speed, and its solver does not see the hinges' friction, as ours does.
    model.jnt_user[:], model.dof_damping[:] = np.inf, 0.0
    model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1] = 0.3, -0.3
    robot = robot.with_model(model)
    qpos, qvel = at_rest(robot, 1, FLAT["height"] + 0.1)
    qpos[3:7, 0] = np.array([9, 2, 1, 0]) / np.sqrt(86)
    time, q, v, _ = march(robot, 0.125, qpos, qvel, engine="mjx")
    data = mujoco.MjData(model)
    data.qpos[:] = qpos[:, 0]
    touched = 0
    for k in range(len(time)):
        mujoco.mj_step(model, data)
        touched += data.ncon > 0
        assert q[k, :, 0] == pytest.approx(data.qpos, abs=1e-6)
        assert v[k, :, 0] == pytest.approx(data.qvel, abs=1e-4)
    assert touched == 6
    assert np.abs(q[:, 7:]).max() > 0.1


@pytest.mark.long
def test_a_slope_is_slid_down_as_coulomb_has_it():
    """On one triangle of a height field: (W - B) (sin - μ cos) / (m + m_a)."""
    bed = Bed("lake", -60.0, 10.0, 200.0, friction=0.3, contact="mjx")
    robot = block(bed=bed)
    # Corners of the triangle: cells are 1 m wide and cut from their lowest x and y.
    x, y = np.array([50.0, 51.0, 51.0]), np.array([3.0, 3.0, 4.0])
    corner = np.stack([x, y, np.asarray(bed_height(bed, x, y))])
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal = across / np.linalg.norm(across)
    down = np.array([0, 0, -1]) + normal[2] * normal
    slope = np.linalg.norm(down)  # sine
    turn = np.stack([down / slope, np.cross(normal, down / slope), normal], 1)
    qpos, qvel = at_rest(robot, 1)
    place = corner @ [0.2, 0.5, 0.3]
    qpos[:3, 0] = place + normal * (SIZE[2] / 2 - sunk(robot, WEIGHT * normal[2]))
    mujoco.mju_mat2Quat(qpos[3:7, 0], turn.ravel())
    time, _, v, _ = march(robot, 0.4, qpos, qvel, engine="mjx")
    mass = MASS + RHO * robot.fluid.carried_mass[0, 0]
    expected = WEIGHT * (slope - 0.3 * normal[2]) / mass
    assert v[-1, :3, 0] @ turn == pytest.approx([expected * time[-1], 0, 0], abs=0.02)


@pytest.mark.long
def test_a_core_lands_in_the_lake():
    """On the height field's triangles, that are within 4 mm of the lake's shape."""
    robot = build_robot(body("core"), load_world("lake", bed={"contact": "mjx"}))
    places = np.array([(0.0, 0.0), (200.3, 50.6), (201.0, -37.0), (-150.1, 250.7)]).T
    draw = np.random.default_rng(2)
    qpos, qvel = at_rest(robot, 4)
    qpos[:2] = places
    qpos[2] = np.asarray(bed_height(robot.world.bed, *places)) + 0.1
    qpos[3:7] = draw.normal(size=(4, 4))
    qpos[3:7] /= np.linalg.norm(qpos[3:7], axis=0)
    _, q, v, _ = march(robot, 2.5, qpos, qvel, engine="mjx", every=4, x64=False)
    for lane in range(4):
        clear = clearance(robot, q[:, :, lane])
        assert clear.min() > -0.01
        assert abs(clear[-1]) < 5e-3
    assert np.abs(v[-1, :3, :3]).max() < 2e-3
    # Landed after 1.5 s, they stay; but the last place is steeper than friction can hold. How far
    # that one slides, from dune to dune, depends on how it tumbled.
    slid = np.linalg.norm(q[-1, :2] - q[75, :2], axis=0)
    assert np.all(slid[:3] < 1e-3)
    assert slid[3] > 0.02
