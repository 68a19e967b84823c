"""The compiled robot: Revolve's geometry, masses, limits; tables that add up; MJCF that reloads."""

import copy
import pickle

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from laboratory import OURS, WILD, body, check_refused, face_drag, need_mjx, read, world
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.engine.batch import fit_capacity
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.plant import body_geometry
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.engine.single_tree import make_single_tree
from mjx_revolve.episodes.simulate import simulate
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.bed import Bed, bed_height
from mjx_revolve.water.flow import water_of
from mjx_revolve.water.lift_drag import LIFT_DRAG
from mjx_revolve.water.world import load_world
from references import rotation

EFFORT, SPEED = 0.17658, 5.235988


def forward(robot):
    data = mujoco.MjData(robot.mj_model)
    mujoco.mj_forward(robot.mj_model, data)
    return data


def test_inertia_of_a_link_by_hand(spider):
    """The foot: servo box and brick about their common centre of mass, by Steiner's rule."""
    size = {"servo": (0.0245, 0.02575, 0.015), "brick": (0.041, 0.041, 0.0355)}
    mass = {"servo": 0.009, "brick": 0.0102}
    # From the core's centre, by Revolve's own SDF; the servo's is 10.875 mm behind the second axis.
    along = {"servo": 0.136925 + 0.010875, "brick": 0.17905}
    center = sum(mass[k] * along[k] for k in mass) / 0.0192
    # About the vertical: servo and brick lie flat in the second hinge (turned by -90 and 0).
    expected = 0.0
    for k, edges in size.items():
        x, y, z = edges
        # In the foot's own frame the hinge's axis is y and the leg runs along x.
        across = {"servo": x * x + z * z, "brick": y * y + z * z}[k]
        expected += mass[k] * (across / 12 + (along[k] - center) ** 2)
    hip, knee = (spider.mj_model.body(f"front_{name}") for name in ("hip", "knee"))
    assert (hip.parentid[0], knee.parentid[0]) == (spider.mj_model.body("core").id, hip.id)
    body_id = knee.id
    axes = rotation(spider.mj_model.body_iquat[body_id])
    inertia = axes @ np.diag(spider.mj_model.body_inertia[body_id]) @ axes.T
    axis = spider.mj_model.jnt_axis[spider.mj_model.body_jntadr[body_id]]
    assert axis @ inertia @ axis == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("name", ["spider", "gecko", "snake", "centipede"])
def test_every_hinge_is_revolves(name):
    """Range, torque and speed limits; friction below the effort; servo from one to the other."""
    robot = build_robot(body(name), world())
    model = robot.mj_model
    assert model.nu == robot.morphology.num_hinges == model.njnt - 1
    for joint in range(1, model.njnt):
        assert model.jnt_range[joint] == pytest.approx([-np.pi / 4, np.pi / 4])
        assert model.jnt_limited[joint]
        assert model.jnt_user[joint, 0] == SPEED
    assert model.actuator_forcerange == pytest.approx(np.tile([-EFFORT, EFFORT], (model.nu, 1)))
    assert model.actuator_ctrlrange == pytest.approx(model.jnt_range[1:])
    assert model.actuator_trnid[:, 0].tolist() == list(range(1, model.njnt))
    assert np.all(model.dof_damping[6:] * SPEED < EFFORT)
    assert np.all(model.dof_damping[:6] == 0)
    # ctrl follows the morphology's order of hinges.
    hinges = [robot.morphology.modules[i].name for i in robot.morphology.hinges]
    assert [model.actuator(k).name for k in range(model.nu)] == hinges


@pytest.mark.parametrize("path", OURS + WILD, ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_every_morphology_builds(path):
    morphology = load_morphology(path, allow_overlap=True)
    robot = build_robot(morphology, load_world("lake"))
    model, fluid, data = robot.mj_model, robot.fluid, forward(robot)
    assert model.nbody - 1 == 1 + morphology.num_hinges
    assert model.nv == 6 + morphology.num_hinges
    assert model.opt.density == model.opt.viscosity == 0
    assert model.body_subtreemass[0] == pytest.approx(morphology.mass)
    assert fluid.mass.sum() == pytest.approx(morphology.mass)
    assert fluid.volume.sum() == pytest.approx(morphology.volume)
    # Axes, anchors and boxes lie where the morphology has them at rest.
    for module in morphology.modules:
        if (hinge := module.kind.hinge) is not None:
            joint, place = data.joint(module.name), module.position + module.rotation @ hinge.anchor
            assert joint.xanchor == pytest.approx(place, abs=1e-9)
            assert joint.xaxis == pytest.approx(module.rotation @ hinge.axis, abs=1e-9)
        named = [(part.name, k) for part in module.kind.parts for k in range(len(part.boxes))]
        for (name, k), (center, _) in zip(named, module.boxes(), strict=True):
            geom = data.geom(f"{module.name}/{name}" + (f"/{k}" if k else ""))
            assert geom.xpos == pytest.approx(center, abs=1e-9)
    turn = data.xmat[fluid.body].reshape(-1, 3, 3)
    place = data.xpos[fluid.body] + np.einsum("nij,nj->ni", turn, fluid.position)
    k = 0
    for index, module in enumerate(morphology.modules):
        for center, half in module.boxes(main=True):
            assert fluid.module[k] == index
            assert place[k] == pytest.approx(center, abs=1e-9)
            assert turn[k] @ fluid.rotation[k] == pytest.approx(module.rotation, abs=1e-9)
            assert fluid.half_size[k] == pytest.approx(half)
            k += 1
    assert k == len(fluid.volume)
    # Corners for the bed: eight of each part, and as wide as the robot.
    corners = data.xpos[robot.contact_body] + np.einsum(
        "nij,nj->ni", data.xmat[robot.contact_body].reshape(-1, 3, 3), robot.contact_position
    )
    low, high = morphology.bounds
    assert corners.min(0) == pytest.approx(low, abs=1e-9)
    assert corners.max(0) == pytest.approx(high, abs=1e-9)


def test_fluid_table_of_the_catalogue():
    """Drag of a lone core: all faces meet the water; of a hinge's joined faces, none do."""
    robot = build_robot(body("core"), world(drag="faces", added_mass=True))
    fluid = robot.fluid
    faces = np.array([0.089 * 0.045, 0.089 * 0.045, 0.089 * 0.089])
    assert fluid.exposed[0] == pytest.approx(1.0)
    assert face_drag(robot).linear[0] == pytest.approx(0.5 * 999.1026 * 1.05 * faces)
    assert fluid.center_of_volume[0] == pytest.approx(0.0)
    assert LIFT_DRAG.numbers(fluid, robot.world).area[0] == pytest.approx(0.089 * 0.089)
    # Of two bricks in a row, the outer carries less water along it: a face of it is joined.
    two = "body: {type: Core, children: {1: {type: FixedBrick, children: {1: {type: FixedBrick}}}}}"
    outer = build_robot(read(two), world()).fluid.added_mass[2]
    assert outer[1] < outer[0]


def test_the_bed_is_part_of_the_model():
    """A plane at the flat bed's height, a height field whose samples are the lake's heights."""
    flat = build_robot(body("core"), world(bed=Bed(kind="flat", height=-2.0))).mj_model
    assert flat.geom("bed").type[0] == mujoco.mjtGeom.mjGEOM_PLANE
    assert flat.geom("bed").pos[2] == -2.0
    lake = build_robot(body("core"), load_world("lake"))
    model = lake.mj_model
    assert model.hfield_nrow[0] == model.hfield_ncol[0] == 201
    grid = model.hfield_data.reshape(201, 201) * model.hfield_size[0, 2] + model.geom("bed").pos[2]
    line = np.linspace(-499, 499, 201)
    for i, j in ((100, 100), (0, 0), (150, 60), (60, 150)):
        expected = bed_height(lake.world.bed, np.float64(line[j]), np.float64(line[i]))
        assert grid[i, j] == pytest.approx(float(expected), abs=1e-4)
    assert model.geom("bed").contype[0] == model.geom("bed").conaffinity[0] == 0
    assert build_robot(body("core"), world()).mj_model.ngeom == 1


def test_world_options_reach_the_model():
    robot = build_robot(body("core"), world(gravity=3.7, timestep=0.002, surface_height=4.0))
    assert robot.mj_model.opt.gravity.tolist() == [0, 0, -3.7]
    assert robot.mj_model.opt.timestep == 0.002
    assert robot.start_qpos()[2] == 3.0
    assert robot.start_qpos(0.5)[2] == 3.5
    assert robot.qpos0.tolist() == [0, 0, 0, 1, 0, 0, 0]
    robot.qpos0[2] = 7.0  # a copy
    assert robot.qpos0[2] == 0.0


@pytest.mark.parametrize("kind", ["spec", "model"])
def test_an_edited_model_is_a_new_robot(kind):
    """Both engines have its masses, hinges and servos; the first robot stays as it is."""
    robot = build_robot(body("snake"), world(self_contact=False))
    if kind == "spec":
        edit = robot.mj_spec
        name = robot.mj_model.joint(4).name
        edit.joint(name).damping = [0.5, 0, 0]
        edit.joint(name).range = [-0.1, 0.2]
    else:
        edit = copy.copy(robot.mj_model)
        edit.dof_damping[9], edit.jnt_range[4] = 0.5, [-0.1, 0.2]
        edit.body_mass[5] *= 2
    other = robot.with_model(edit)
    before, after = (make_single_tree(x).below[3].hinges for x in (robot, other))
    assert np.max(after.damping) == 0.5 and np.max(before.damping) < 0.1
    assert -0.1 in np.ravel(after.range[0]) and 0.2 in np.ravel(after.range[1])
    assert np.allclose(after.gain, before.gain)
    doubled = 2 if kind == "model" else 1
    assert other.assembly.mass[5] == pytest.approx(doubled * robot.assembly.mass[5])
    edit = copy.copy(robot.mj_model)
    for stiff in (99.0, 0.0):  # a motor has no spring
        edit.actuator_biasprm[:, 1] = -stiff
        implicit = robot.with_model(edit).assembly.implicit_stiffness[2:]
        assert implicit.min() > 0 if stiff else not implicit.any()
    assert pickle.loads(pickle.dumps(other)).mj_model.dof_damping[9] == 0.5
    need_mjx()
    assert make_engine(other, "mjx").robot.mj_model.dof_damping[9] == 0.5


def test_a_servo_without_a_limit_has_a_gradient():
    robot = build_robot(body("fish"), world())
    edit = copy.copy(robot.mj_model)
    edit.actuator_forcelimited[:], edit.body_mass[:] = 0, 2 * edit.body_mass
    edited = robot.with_model(edit)
    assert body_geometry(edited).weight == pytest.approx(2 * body_geometry(robot).weight)
    engine = make_engine(edited)
    rest = engine.init(jnp.asarray(edit.qpos0)[:, None], jnp.zeros((edit.nv, 1)))
    after = lambda ctrl: engine.step(rest, ctrl, water_of(robot.world))[0]  # noqa: E731
    speed = lambda ctrl: jnp.sum(engine.observe(after(ctrl))[1] ** 2)  # noqa: E731
    slopes = jax.grad(speed)(jnp.full((robot.num_hinges, 1), 0.1))
    assert np.isfinite(slopes).all() and np.abs(slopes).max() > 0


def test_modules_that_meet_in_an_edited_range_are_found():
    robot = build_robot(body("spider"), world())
    edit = copy.copy(robot.mj_model)
    edit.jnt_range[1:] = [-2.6, 2.6]
    wide = robot.with_model(edit).assembly
    assert len(robot.assembly.meeting_pairs) == 0 < len(wide.meeting_pairs)
    assert wide.stops[2:].max() < 1.8 < wide.range[2:].max()


def test_what_an_edited_model_may_not_change():
    robot = build_robot(body("snake"), world())
    edit = copy.copy(robot.mj_model)
    edit.body_pos[3] += 0.1
    edit.opt.timestep = 0.1
    check_refused("servos only; found another body_pos, opt.timestep", robot.with_model, edit)
    edit = copy.copy(robot.mj_model)
    edit.jnt_stiffness[2] = 1.0
    edit.qpos0[8], edit.dof_damping[2], edit.actuator_biasprm[1, 0] = 0.1, 1.0, 0.1
    words = "another jnt_stiffness, qpos0, dof_damping of the core, actuator_biasprm"
    check_refused(words, robot.with_model, edit)
    for name, row, value, words in (
        ("actuator_gainprm", (0, 0), 9.0, "another .*actuator_gainprm of a thruster"),
        ("body_mass", 1, -1.0, "body_mass: expected finite numbers > 0; found"),
        ("dof_damping", 6, np.nan, "dof_damping: expected finite numbers >= 0"),
        ("jnt_range", (1, 1), -2.0, "jnt_range: expected the lowest below the highest"),
        ("jnt_user", (2, 0), 0.0, "jnt_user: expected top speeds > 0"),
    ):
        jet = build_robot(body("auv" if "gain" in name else "snake"), world())
        edit = copy.copy(jet.mj_model)
        getattr(edit, name)[row] = value
        with pytest.raises(InputError, match=words):
            jet.with_model(edit)
    spec = robot.mj_spec
    spec.geoms[0].size = [-1.0, 0.0, 0.0]
    check_refused("expected one that MuJoCo can compile", robot.with_model, spec)
    heavy = robot.with_model(copy.copy(robot.mj_model))
    check_refused("expected it as built", fit_capacity, [heavy])


def test_a_model_edited_in_place_counts_from_the_next_engine_on():
    """Before and after the first use of the robot; MuJoCo's own water may be set at will."""
    robot = build_robot(body("snake"), world())
    plain = make_engine(robot)
    robot.mj_model.opt.density = 1000.0
    assert make_engine(robot) is plain
    robot.mj_model.body_mass[2] *= 2
    with pytest.warns(DeprecationWarning, match="edited in place"):
        heavy = make_engine(robot)
    assert make_engine(robot) is heavy is not plain
    assert robot.as_edited().assembly.mass[2] == 2 * robot.assembly.mass[2]
    check_refused("expected it as built", fit_capacity, [robot])
    robot.mj_model.body_pos[3] += 0.1
    check_refused("found another body_pos", make_engine, robot)


@pytest.mark.slow
def test_mujocos_own_fluid_acts_in_no_engine():
    """Set in place, for a run of MuJoCo C beside ours; MJX stands behind the same call."""
    robot = build_robot(body("core"), world(drag="faces"))
    robot.mj_model.opt.density = 1000.0
    ours, mjx = (
        simulate(robot, None, 0.05, qvel=np.full(6, 0.5), engine=engine)
        for engine in ("population", "mjx")
    )
    assert np.asarray(mjx.qvel) == pytest.approx(np.asarray(ours.qvel), abs=1e-5)
    assert np.asarray(mjx.xpos) == pytest.approx(np.asarray(ours.xpos), abs=1e-5)
    # It would have been seen.
    data = mujoco.MjData(robot.mj_model)
    data.qvel[:] = 0.5
    mujoco.mj_forward(robot.mj_model, data)
    assert np.abs(0.05 * data.qfrc_passive[:3] / robot.mj_model.body_mass.sum()).max() > 1e-3
