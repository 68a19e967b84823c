"""Drag across chains: oblique flow, spinning rods, friction; a lone part has its faces' drag."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import accelerate, at_rest, box_robot, read, world
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.numerics.inertia import apply_inertia
from mjx_revolve.numerics.spatial import dot
from mjx_revolve.water.cross_flow import CROSS_FLOW
from mjx_revolve.water.laws import PartFlow, as_components

WATER = world(drag="cross_flow")
SIZE = np.array([0.2, 0.1, 0.06])  # [m]


@pytest.fixture(scope="module")
def inside():
    """Numbers of a part inside a chain along x, whose ends its neighbours cover."""
    parts = SimpleNamespace(
        half_size=SIZE[None] / 2,
        silhouette=(SIZE.prod() / SIZE)[None],
        exposed=np.array([[0.0, 1.0, 1.0]]),
        coefficients={"drag_coefficient": np.full((1, 3), 1.05)},
    )
    numbers = CROSS_FLOW.numbers(parts, WATER)
    return as_components(jax.tree.map(lambda x: x[0], numbers))


def drag_at(numbers, velocity, turning=(0.0, 0.0, 0.0)):
    with jax.enable_x64(True):
        flow = PartFlow(*(tuple(map(jnp.asarray, x)) for x in (velocity, turning)), 1.0)
        return jax.tree.map(np.asarray, CROSS_FLOW.force(flow, numbers, WATER))


def test_a_lone_part_has_the_drag_of_its_faces():
    robots = [box_robot((0.2, 0.1, 0.06), 1.2, world(drag=x)) for x in ("faces", "cross_flow")]
    qpos, qvel = at_rest(robots[0], 1, -5.0)
    qvel[:6, 0] = [0.3, -0.2, 0.1, 0.5, 0.2, -0.4]
    found = [accelerate(robot, qpos, qvel) for robot in robots]
    assert found[1] == pytest.approx(found[0], rel=1e-12)


def test_a_chain_in_oblique_flow_meets_all_of_the_velocity_across_it(inside):
    scale = 0.5 * WATER.density * 1.75 * SIZE[0] * 0.5
    for angle in np.radians([0, 30, 45, 90]):
        velocity = 0.5 * np.array([0, np.cos(angle), np.sin(angle)])
        expected = -scale * SIZE[[0, 2, 1]] * velocity  # each face by its height
        assert drag_at(inside, velocity).force == pytest.approx(expected, rel=1e-9)


def test_along_it_there_is_friction_only(inside):
    speed = 0.5
    reynolds = WATER.density * speed * SIZE[0] / WATER.viscosity
    friction = 0.455 / np.log10(reynolds) ** 2.58
    wet = 2 * SIZE[0] * (SIZE[1] + SIZE[2])
    expected = -0.5 * WATER.density * friction * wet * speed**2
    assert drag_at(inside, [speed, 0, 0]).force == pytest.approx([expected, 0, 0], rel=1e-9)


def test_a_spinning_rod_is_dragged_by_its_strips(inside):
    """Four points take ∫ |s| s² ds within 1 %."""
    drag = drag_at(inside, [0.0, 0, 0], [0, 5.0, 0])
    expected = -WATER.density * 1.75 * SIZE[1] * SIZE[0] ** 4 / 64 * 25.0
    assert drag.torque == pytest.approx([0, expected, 0], rel=0.01)
    assert drag.force == pytest.approx([0, 0, 0], abs=1e-12)


def test_its_work_is_never_positive_and_its_damping_is_all_of_it(inside):
    v, w = np.random.default_rng(0).normal(size=(2, 3, 100))
    drag = drag_at(inside, v, 5 * w)
    assert np.all(dot(drag.force, v) + dot(drag.torque, 5 * w) <= 0)
    torque, force = apply_inertia(drag.damping, tuple(5 * w), tuple(v))
    for found, taken in ((drag.force, force), (drag.torque, torque)):
        for x, y in zip(found, taken, strict=True):
            assert np.abs(np.asarray(x) + np.asarray(y)).max() < 1e-9


def test_fins_keep_their_lift_and_gradients_are_finite():
    fish = read("body: {type: Core, children: {1: {type: FixedBrick}, 0: {type: Fin}}}")
    robot = build_robot(fish, WATER)
    assert robot.fluid.drag == ("cross_flow", "cross_flow", "lift_drag")
    numbers = as_components(jax.tree.map(lambda x: x[1], CROSS_FLOW.numbers(robot.fluid, WATER)))

    def total(v):
        flow = PartFlow((v[0], v[1], v[2]), (v[3], v[4], v[5]), 1.0)
        return sum(x for part in CROSS_FLOW.force(flow, numbers, WATER)[:2] for x in part)

    for v in (jnp.zeros(6), jnp.arange(6.0)):
        assert np.isfinite(jax.grad(total)(v)).all()
