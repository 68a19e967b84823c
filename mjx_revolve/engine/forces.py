"""Forces by themselves: on whole robots for tasks, on bodies for sensors, on parts for pictures."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_revolve.engine.contact import bed_forces, bed_normal_force
from mjx_revolve.engine.hydrodynamics import PreviousStep, forces_on_parts, water_forces
from mjx_revolve.engine.kinematics import forward_kinematics
from mjx_revolve.engine.level import Level
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.servos import motor_torque, spring_damping
from mjx_revolve.engine.single_tree import SingleTree, make_single_tree
from mjx_revolve.engine.state import State, effective_gravity
from mjx_revolve.engine.step_constants import IMMOBILE_INERTIA
from mjx_revolve.engine.tree import Tree
from mjx_revolve.engine.variation import Variation
from mjx_revolve.numerics.inertia import BodyMotion
from mjx_revolve.numerics.spatial import (
    ZERO,
    Scalar,
    Vec,
    add,
    dot,
    mul,
    safe_norm,
    total,
    vadd,
    vsub,
)
from mjx_revolve.water.flow import Water


def _in_current(tree: Tree, state: State, water: Water) -> tuple[BodyMotion, Any]:
    """Motion of the root and of the bodies below it, relative to the uniform current."""
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    return forward_kinematics(tree, relative, True)


def servo_torque(tree: Tree, state: State, targets: Any) -> Float[Array, "rows lanes"]:
    """Torque of the servos under targets, in the plant's order [N·m]."""

    def torque(level: Level, angle: Scalar, speed: Scalar, target: Scalar) -> Scalar:
        assert level.hinges is not None
        return motor_torque(level.hinges, angle, speed, target)

    found = tree.map(torque, state.angle, state.speed, targets)
    return tree.join_rows(found, state.position[0])


def motor_torques(
    robot: Robot, qpos: Any, qvel: Any, ctrl: Any, variation: Variation | None = None
) -> np.ndarray:
    """Torque of the motors along a trajectory, by the servos' law, without the joints' friction.

    That of the step which led to each row. It is taken at the angle that the step began with: at
    the new one, under a command that is a step old, a servo would lag by k_p dt q̇, which is more
    than its whole torque where limbs are light.

    Args:
        robot: from `build_robot`.
        qpos: `[S, nq]` configurations after steps.
        qvel: `[S, nv]` velocities after them.
        ctrl: `[S, nu]` commands in them.
        variation: factors on coefficients of the motors, a number each; None for none.

    Returns:
        `[S, nhinge]` in the order of the hinges [N·m].
    """
    tree = make_single_tree(robot, contact=False).with_variation(variation)
    hinges = (np.asarray(qpos)[:, 7:], np.asarray(qvel)[:, 6:], np.asarray(ctrl)[:, robot.servos])
    angle, speed, targets = (tree.joints_to_tree(jnp.asarray(x.T)) for x in hinges)
    dt, damped, like = tree.world.timestep, spring_damping(tree.world), jnp.zeros(len(hinges[0]))

    def torque(level: Level, angle: Scalar, speed: Scalar, target: Scalar) -> Scalar:
        assert level.hinges is not None
        # Semi-implicit Euler: a step turns a hinge by dt times its new speed.
        return motor_torque(level.hinges, angle - dt * speed, speed, target, dt, damped)

    rows = tree.join_rows(tree.map(torque, angle, speed, targets), like)
    return np.asarray(tree.tree_to_joints(tree.split_rows(rows), like)).T


def external_force(tree: Tree, state: State, water: Water, thrusts: Any) -> tuple[Vec, Vec]:
    """Force of the bed and of the water on whole robots.

    Weight is no force of the water's, and neither is the inertia of its added mass.

    Args:
        tree: the robots.
        state: the population.
        water: surface and current.
        thrusts: of the thrusters, `[nthruster, lanes]` [N].

    Returns:
        (force of the bed, force of the water), world frame, three of `[lanes]` each [N].
    """
    root, moved = _in_current(tree, state, water)
    world, still = tree.world, _without_gust(water)

    def forces(
        level: Level, children: Any, moved: tuple[BodyMotion, Any], *submerged: Any
    ) -> tuple[Any, Any, Any]:
        motion = moved[0]
        gravity = effective_gravity(world, water, motion)
        before = PreviousStep(submerged[0], 0.0) if submerged else None
        external = water_forces(world, level, motion, gravity, water, thrusts, before)
        bed: Vec = ZERO
        if level.points is not None:
            bed = bed_forces(world, level, motion, level.points, still, True)[1]
        wide = lambda x: add(x, jnp.zeros_like(motion.height))  # noqa: E731
        turned = tuple(
            tuple(wide(dot(axis, force)) for axis in motion.axes) for force in (bed, external.force)
        )
        return (), (), turned

    below = tree.backward_pass(forces, ((), (ZERO, ZERO)), moved, *state.submerged[1:])[2]
    whole = forces(tree.root, None, (root, None), *state.submerged[:1])[2]
    own = jax.tree.map(lambda x: x[0], whole)
    return jax.tree.map(add, own, below)


def contact_force(
    tree: Tree, state: State, water: Water, wrench: Any = ()
) -> Float[Array, "bodies lanes"]:
    """Magnitude of the contact forces on each moving body.

    Args:
        tree: the robots.
        state: the population.
        water: surface and current.
        wrench: of other robots, `InteractionForces.wrench`; () for none.

    Returns:
        `[1 + nhinge, lanes]` on the core's rigid body, then on what each hinge carries, in the
        order of `Tree.join_rows`: of the sum of the forces of the bed and of other robots, and to
        that the sum of those of own modules along their normals, see `State.pressed` [N].
    """
    like, count = state.position[0], len(tree.join_rows(state.angle, state.position[0]))
    pressed = state.pressed[: 1 + count]
    if not (tree.touches or wrench or len(pressed)):
        return jnp.zeros((1 + count, *like.shape), like.dtype)
    root, moved = _in_current(tree, state, water)
    still = _without_gust(water)

    def forces(level: Level, children: Any, moved: tuple[BodyMotion, Any], *xs: Any) -> Any:
        given, size = list(xs), jnp.zeros((level.count, *like.shape), like.dtype)
        push = given.pop(0)[1] if wrench else ZERO
        press = add(given.pop() if given else 0.0, children[3] if children else 0.0)
        if level.points is not None:
            bed = bed_forces(tree.world, level, moved[0], level.points, still, True)
            push = vadd(push, bed[1])
        push = vadd(push, children[:3]) if children else push
        force = safe_norm(tuple(add(x, size) for x in push)) + press
        # An overflow row of `BatchedTrees` is part of the body that it is fixed to.
        share: Any = 0.0
        if level.hinges is not None and isinstance(level.hinges.armature, jax.Array):
            share = jnp.where(level.hinges.armature > IMMOBILE_INERTIA / 2, 1, 0).astype(like.dtype)
        return tuple(mul(share, x) for x in (*push, press)), force, ()

    rows = (tree.split_rows(pressed[1:]),) if len(pressed) else ()
    start = ((0.0,) * 4, ())
    children, below, _ = tree.backward_pass(forces, start, moved, *wrench[1:], *rows)
    core = forces(tree.root, children, (root, None), *wrench[:1], *([pressed[:1]] if rows else []))
    return jnp.concatenate([core[1], tree.join_rows(below, like)])


def _without_gust(water: Water) -> Water:
    """Water for the bed's force as it is, without what the step foresees of a gust."""
    return water._replace(acceleration=ZERO)


def contact_by_half(
    tree: SingleTree, state: State, water: Water
) -> tuple[tuple[jax.Array, jax.Array], ...]:
    """Force of contacts on the two halves of each module.

    As the two cells of Revolve's touch sensor: left and right of the direction in which the module
    is attached, its z up.

    Args:
        tree: the robot.
        state: of the population.
        water: surface and current.

    Returns:
        Of each module (left, right), the force along the bed's normal, without friction, and of own
        modules along theirs, see `State.pressed`, `[lanes]` each [N].
    """
    like, assembly = state.position[0], tree.robot.assembly
    root, below = _in_current(tree, state, water)
    part, right = assembly.point_part, assembly.point_right
    found: list[tuple[list[Any], list[Any]]]
    found = [([], []) for _ in range(tree.robot.morphology.num_modules)]
    motions = (root, *(motion for motion, _ in below))
    for level, motion, rows in zip(tree.all, motions, tree.point_rows, strict=True):
        if level.points is None:
            continue
        push = bed_normal_force(tree.world, level, motion, level.points, water)
        for slot, body in zip(*np.nonzero(rows >= 0), strict=True):
            point = rows[slot, body]
            module = assembly.layout.module[part[point]]
            found[module][int(right[point])].append(push[slot, body])
    own = len(state.pressed) - 2 * len(found)
    for k, sides in enumerate(found if own > 0 else ()):
        for side, forces in enumerate(sides):
            forces.append(state.pressed[own + 2 * k + side])
    none = jnp.zeros_like(like)
    return tuple((total(none, *left), total(none, *right)) for left, right in found)


def part_forces(
    tree: SingleTree, state: State, water: Water, thrusts: Any
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Forces of the water on a robot's parts one by one: the terms that the step adds up.

    Args:
        tree: the robot.
        state: of the population.
        water: surface and current.
        thrusts: of the thrusters, `[nthruster, lanes]` [N].

    Returns:
        Buoyancy, drag and thrust, world frame, `[lanes, npart, 3]` each [N]; parts in the order of
        the fluid table.
    """
    root, below = _in_current(tree, state, water)
    lanes, count = state.position[0].shape[0], len(tree.robot.fluid.volume)
    found = [jnp.zeros((lanes, count, 3), state.position[0].dtype) for _ in range(3)]
    motions = (root, *(motion for motion, _ in below))
    for level, motion, groups in zip(tree.all, motions, tree.part_rows, strict=True):
        gravity = effective_gravity(tree.world, water, motion)
        terms = forces_on_parts(tree.world, level, motion, gravity, water, thrusts)
        for rows, forces in zip(groups, terms, strict=True):
            for k, force in enumerate(forces):
                turned = [dot(axis, force) * jnp.ones(lanes) for axis in motion.axes]
                stacked = jnp.stack(turned, -1)
                for slot, body in zip(*np.nonzero(rows >= 0), strict=True):
                    found[k] = found[k].at[:, rows[slot, body]].set(stacked[slot, body])
    return found[0], found[1], found[2]
