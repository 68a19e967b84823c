"""Forces of bed and water by themselves: on whole robots for tasks, on parts for pictures."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.columns import LOCKED
from mjx_revolve.engine.contact import bed_on_level, bed_pushes
from mjx_revolve.engine.dynamics import Bodies, Moving, move_bodies
from mjx_revolve.engine.hydrodynamics import forces_on_parts, water_on_level
from mjx_revolve.engine.level import Level
from mjx_revolve.engine.levels import Levels
from mjx_revolve.engine.state import State, felt_gravity
from mjx_revolve.numerics.spatial import (
    Vec,
    add,
    dot,
    safe_norm,
    total,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.flow import Water


def push_of(bodies: Bodies, state: State, water: Water, thrusts: Any) -> tuple[Vec, Vec]:
    """Force of the bed and of the water on whole robots, world frame, `[lanes]` each [N].

    Weight is no force of the water's, and the inertia of what it carries along is no force at all.

    Args:
        bodies: the robots.
        state: the population.
        water: surface and current.
        thrusts: of the thrusters, `[nthruster, lanes]` [N].

    Returns:
        (force of the bed, force of the water), three components each.
    """
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    root, moved, *_ = move_bodies(bodies, relative, True, 0.0)
    world = bodies.world

    def pushes(level: Level, gathered: Any, moved: tuple[Moving, Any]) -> tuple[Any, Any, Any]:
        moving, _ = moved
        motion = moving.motion
        gravity = felt_gravity(world, water, motion)
        outer = water_on_level(world, level, motion, moving.swirling, gravity, water, thrusts)
        bed: Vec = (0.0, 0.0, 0.0)
        if level.points is not None:
            bed = bed_on_level(world, level, motion, level.points, water)[1]
        axes = (motion.x_axis, motion.y_axis, motion.up)
        wide = lambda x: add(x, jnp.zeros_like(motion.height))  # noqa: E731
        turned = tuple(
            tuple(wide(dot(axis, force)) for axis in axes) for force in (bed, outer.force)
        )
        return (), (), turned

    nothing = ((0.0,) * 3, (0.0,) * 3)
    _, _, below = bodies.up(pushes, ((), nothing), moved)
    own = jax.tree.map(lambda x: x[0], pushes(bodies.root, None, (root, None))[2])
    bed, wet = jax.tree.map(add, own, below)
    return bed, wet


def touch_of(bodies: Bodies, state: State, water: Water) -> jax.Array:
    """How hard the bed pushes each moving body.

    Args:
        bodies: the robots.
        state: the population.
        water: surface and current.

    Returns:
        `[1 + nhinge, lanes]` length of its force on the core's rigid body, then on what each hinge
        carries, in the order of `bodies.merge` [N]; 0 where there is no bed within reach.
    """
    like = state.position[0]
    if not bodies.touches:
        hinges = bodies.merge(state.angle, like)
        return jnp.zeros((1 + hinges.shape[0], *like.shape), like.dtype)
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    root, moved, *_ = move_bodies(bodies, relative, True, 0.0)

    def pushes(level: Level, gathered: Any, moved: tuple[Moving, Any]) -> tuple[Any, Any, Any]:
        motion, force = moved[0].motion, gathered
        size = jnp.zeros((level.count, *like.shape), like.dtype)
        if level.points is not None:
            own = bed_on_level(bodies.world, level, motion, level.points, water)[1]
            force = own if force is None else vadd(own, force)
        if force is not None:
            size = size + safe_norm(tuple(add(x, jnp.zeros_like(size)) for x in force))
        # What rides on a body, rigidly, is a row of its own where robots differ, but no body.
        share: Any = 0.0
        if level.hinges is not None and isinstance(level.hinges.armature, jax.Array):
            share = jnp.where(level.hinges.armature > LOCKED / 2, 1, 0).astype(like.dtype)
        return vscale(share, force or (0.0, 0.0, 0.0)), size, ()

    gathered, below, _ = bodies.up(pushes, ((0.0, 0.0, 0.0), ()), moved)
    core = pushes(bodies.root, gathered, (root, None))[1]
    return jnp.concatenate([core, bodies.merge(below, like)])


def cells_of(levels: Levels, state: State, water: Water) -> tuple[tuple[jax.Array, jax.Array], ...]:
    """How hard the bed pushes the two halves of each module.

    Halves are told apart as Revolve's touch sensor has its two cells: left and right of the way in
    which the module is attached, its z up.

    Args:
        levels: the robot.
        state: of the population.
        water: surface and current.

    Returns:
        Of each module (left, right), the force along the bed's normal, friction apart, `[lanes]`
        each [N]; 0 where there is no bed within reach.
    """
    like, assembly = state.position[0], levels.robot.assembly
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    root, moved, *_ = move_bodies(levels, relative, True, 0.0)
    part, right = assembly.point_part, assembly.point_right
    modules = levels.robot.morphology.num_modules
    found: list[tuple[list[Any], list[Any]]] = [([], []) for _ in range(modules)]
    found_moving = (root, *(moving for moving, _ in moved))
    for level, moving, rows in zip(levels.all, found_moving, levels.point_rows, strict=True):
        if level.points is None:
            continue
        push = bed_pushes(levels.world, level, moving.motion, level.points, water)
        for slot, body in zip(*np.nonzero(rows >= 0), strict=True):
            point = rows[slot, body]
            module = assembly.layout.module[part[point]]
            found[module][int(right[point])].append(push[slot, body])
    none = jnp.zeros_like(like)
    return tuple((total(none, *left), total(none, *right)) for left, right in found)


def part_forces(
    levels: Levels, state: State, water: Water, thrusts: Any
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Forces of the water on a robot's parts one by one, by the terms that the step adds up.

    Args:
        levels: the robot.
        state: of the population.
        water: surface and current.
        thrusts: of the thrusters, `[nthruster, lanes]` [N].

    Returns:
        Buoyancy, drag and thrust, world frame, `[lanes, npart, 3]` each [N]; parts in the order of
        the fluid table.
    """
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    root, moved, *_ = move_bodies(levels, relative, True, 0.0)
    lanes, count = state.position[0].shape[0], len(levels.robot.fluid.volume)
    found = [jnp.zeros((lanes, count, 3), state.position[0].dtype) for _ in range(3)]
    found_moving = (root, *(moving for moving, _ in moved))
    for level, moving, groups in zip(levels.all, found_moving, levels.part_rows, strict=True):
        motion = moving.motion
        gravity = felt_gravity(levels.world, water, motion)
        terms = forces_on_parts(levels.world, level, motion, gravity, water, thrusts)
        axes = (motion.x_axis, motion.y_axis, motion.up)
        for rows, forces in zip(groups, terms, strict=True):
            for k, force in enumerate(forces):
                turned = jnp.stack([dot(axis, force) * jnp.ones(lanes) for axis in axes], -1)
                for slot, body in zip(*np.nonzero(rows >= 0), strict=True):
                    found[k] = found[k].at[:, rows[slot, body]].set(turned[slot, body])
    buoyancy, drag, thrust = found
    return buoyancy, drag, thrust
