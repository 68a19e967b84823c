"""Forces of bed and water by themselves: on whole robots for tasks, on parts for pictures."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.contact import bed_on_level
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
        motion = moved[0].motion
        size = jnp.zeros((level.count, *like.shape), like.dtype)
        if level.points is not None:
            size = size + safe_norm(
                bed_on_level(bodies.world, level, motion, level.points, water)[1]
            )
        return (), size, ()

    _, below, _ = bodies.up(pushes, ((), ()), moved)
    core = pushes(bodies.root, None, (root, None))[1]
    return jnp.concatenate([core, bodies.merge(below, like)])


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
