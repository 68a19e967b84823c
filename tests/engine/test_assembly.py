"""What we work out of a body ourselves, against MuJoCo's compiled model of it.

In float64: sums run in another order, so numbers agree to 1e-12 of the largest beside them.
"""

import pickle
from functools import lru_cache

import jax
import mujoco
import numpy as np
import pytest

from experiments.random_bodies import random_body
from laboratory import OURS, ROOT, WILD, read
from mjx_revolve import build_robot, load_morphology, load_world, make_mixed_fitness
from mjx_revolve.body.morphology import trim_neutral
from mjx_revolve.engine.assembly import assemble
from mjx_revolve.engine.batch import fit_capacity, pack_bodies
from mjx_revolve.engine.mujoco_model import compile_model
from mjx_revolve.engine.step_constants import read_constants
from references import rotation

# Fins, thrusters before and behind hinges, a point ballast, a plate that is its own body.
ODD = """
id: odd
body:
  type: Core
  params: {ballast: 0.02, ballast_position: [0.01, 0.02, -0.01], ballast_volume: 1.0e-6}
  children:
    0: {type: Thruster}
    1:
      type: ActiveHinge
      orientation: 90
      params: {ballast: 0.003, ballast_position: [0.0, 0.004, 0.001]}
      children: {1: {type: Fin, orientation: 90, params: {drag: ellipsoid}}}
    2: {type: FixedBrick, children: {2: {type: ActiveHinge, children: {1: {type: LiftThruster}}}}}
    3: {type: ActiveHinge, orientation: 270, children: {1: {type: FixedBrick}}}
"""


def bodies():
    """Shipped ones, random ones, an odd one, one that is trimmed, and those of others."""
    found = [load_morphology(path, allow_overlap=True) for path in [*OURS, *WILD]]
    found += [random_body(seed, 6, 8) for seed in range(4)]
    return [*found, read(ODD), trim_neutral(random_body(7, 3, 3), 1000.0)]


@lru_cache(maxsize=4)
def robots(drag="faces"):
    tank = load_world("lake", drag=drag, added_mass=True)
    return tuple(build_robot(one, tank) for one in bodies())


def close(found, expected):
    """Equal to 1e-12 of the largest."""
    found, expected = np.asarray(found, float), np.asarray(expected, float)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max(initial=0) <= 1e-12 * np.abs(expected).max(initial=1e-9)


def test_numbers_are_those_of_mujocos_model():
    assert len(robots()) >= 10
    for robot in robots():
        ours, m = robot.assembly, robot.mj_model
        hinges, moved = robot.num_hinges, ours.moved
        assert [m.body(k).name for k in range(m.nbody)] == list(ours.names)
        assert m.body_parentid.tolist() == ours.parent.tolist()
        assert moved.tolist() == list(range(2, m.nbody))
        assert (m.jnt_bodyid[1:] == moved).all() and m.njnt == 1 + hinges
        assert (m.jnt_qposadr[1:] == 7 + np.arange(hinges)).all()
        assert not m.jnt_pos.any() and not m.dof_armature.any()
        close(ours.mass, m.body_mass)
        close(ours.center, m.body_ipos)
        axes = rotation(m.body_iquat)
        inertia = axes * m.body_inertia[:, None] @ axes.swapaxes(1, 2)
        for found, expected in zip(ours.inertia, inertia, strict=True):
            close(found, expected)
        position, turn = ours.from_parents()
        close(position, m.body_pos)
        close(turn, rotation(m.body_quat))
        data = mujoco.MjData(m)
        mujoco.mj_kinematics(m, data)
        close(ours.position, data.xpos)
        close(ours.rotation, data.xmat.reshape(-1, 3, 3))
        close(ours.axis[moved], m.jnt_axis[1:])
        close(ours.stops[moved], m.jnt_range[1:])
        close(ours.damping[moved], m.dof_damping[6:])
        close(ours.speed[moved], m.jnt_user[1:, 0])
        servos = list(robot.servos)
        assert m.actuator_trnid[servos, 0].tolist() == list(range(1, m.njnt))
        assert sorted([*servos, *robot.thrusters]) == list(range(m.nu))
        close(ours.stiffness[moved], m.actuator_gainprm[servos, 0])
        close(-ours.stiffness[moved], m.actuator_biasprm[servos, 1])
        close(ours.effort[moved], m.actuator_forcerange[servos, 1])
        assert robot.qpos0.tolist() == m.qpos0.tolist()
        for k, end in enumerate(ours.end[1:], 1):  # a subtree is a run of bodies
            inside = [c for c in range(m.nbody) if _descends(m, c, k)]
            assert inside == list(range(k, end))


def _descends(m, body, above):
    while body > above:
        body = m.body_parentid[body]
    return body == above


@pytest.mark.long
def test_the_inertia_box_is_that_of_mujocos_principal_axes():
    plain = build_robot(read("body: {type: Core}"), load_world("lake", drag="inertia_box"))
    turned = plain.mj_spec
    root = turned.bodies[1]
    root.explicitinertial, root.mass, root.inertia = True, 0.1, (1e-4, 2e-4, 2.5e-4)
    root.ipos, root.iquat = (0.0, 0.0, 0.0), (0.98, 0.0, 0.199, 0.0)
    for robot in (*robots("inertia_box"), plain.with_model(turned)):
        m, columns = robot.mj_model, read_constants(robot.assembly)
        box = columns.bodies[3]
        i = m.body_inertia[1:]
        size = np.sqrt(6 * (i[:, [1, 0, 0]] + i[:, [2, 2, 1]] - i) / m.body_mass[1:, None])
        found = np.array(box.rotation).transpose(2, 0, 1)
        axes = columns.frame[1:].swapaxes(1, 2) @ rotation(m.body_iquat)[1:]
        assert np.stack(box.size, 1)[1:] == pytest.approx(size, rel=1e-9)
        # Which way along an axis does not matter.
        assert np.abs(found[1:].swapaxes(1, 2) @ axes) == pytest.approx(
            np.tile(np.eye(3), (len(i), 1, 1)), abs=1e-7
        )


def test_robots_side_by_side_have_the_bits_that_each_has_alone():
    """So that a score does not depend on whose body stands beside."""
    chosen = robots()
    together = assemble([robot.morphology for robot in chosen], chosen[0].world)
    capacity = fit_capacity(chosen)
    packed = pack_bodies(chosen, capacity, np.float64)
    assert (together.robot[together.roots] == np.arange(len(chosen))).all()
    for k, robot in enumerate(chosen):
        rows = np.flatnonzero(together.robot == k)
        for name in ("mass", "center", "inertia", "position", "rotation", "stiffness"):
            assert np.array_equal(getattr(together, name)[rows], getattr(robot.assembly, name)[1:])
        parts = together.layout.body == k
        for name in ("position", "exposed", "silhouette", "carried_mass"):
            assert np.array_equal(getattr(together.fluid, name)[parts], getattr(robot.fluid, name))
        alone = jax.tree.leaves(pack_bodies([robot], capacity, np.float64))
        for one, many in zip(alone, jax.tree.leaves(packed), strict=True):
            assert np.array_equal(one[..., 0], many[..., k])


def test_nothing_is_compiled_before_somebody_asks(monkeypatch):
    """Bodies are built, packed, sent and measured without MuJoCo's compiler."""
    mixed = make_mixed_fitness(ROOT / "configs" / "lake_swim.yaml", [random_body(2, 3, 3)])
    asked = []
    monkeypatch.setattr(
        "mjx_revolve.engine.robot.compile_model",
        lambda assembly: asked.append(assembly) or compile_model(assembly),
    )
    robot = mixed.build(random_body(2, 3, 3))
    mixed.pack([robot, robot, mixed.build(random_body(2, 3, 3))])
    assert (
        mixed.controller_of(robot).num_genes
        == mixed.pad_genes(np.zeros(mixed.controller_of(robot).num_genes), robot).size
    )
    assert robot.num_hinges == 3 and not asked
    size = len(pickle.dumps(robot))
    assert robot.mj_model.nbody == 5 and len(asked) == 1
    assert len(pickle.dumps(robot)) == size
    again = pickle.loads(pickle.dumps(robot))
    assert again.morphology == robot.morphology and again.world == robot.world
    assert np.array_equal(again.assembly.inertia, robot.assembly.inertia)
