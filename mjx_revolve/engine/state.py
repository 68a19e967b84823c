"""The state of a population and its time integration."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_revolve.numerics.inertia import BodyMotion
from mjx_revolve.numerics.spatial import (
    Scalar,
    Vec,
    cross,
    dot,
    matTvec,
    matvec,
    quat_mul,
    quat_to_mat,
    total,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import World

Lanes = tuple[Float[Array, " lanes"], ...]


class State(NamedTuple):
    """State of a population, component by component.

    Attributes:
        position: of the root, world frame, three of `[lanes]` [m].
        quat: of the root, world from body (w, x, y, z), four of `[lanes]`.
        velocity: of the root's origin, world frame, three of `[lanes]` [m/s].
        angular_velocity: of the root, body frame, three of `[lanes]` [rad/s].
        angle: of the hinges, as `Tree.joints_to_tree` returns: `[nbody, lanes]` for each level
            below the root, or `[rows, 1, lanes]` [rad].
        speed: of the hinges, as `angle` [rad/s].
        qacc_prev: accelerations of the step before, (linear, angular, hinges); the root's as rates
            of its body-frame velocities; empty outside of steps.
        command: of the thrusters, behind their lag, `[nthruster, lanes]` [-]; empty without.
        submerged: submerged fractions of the parts with added mass at the step before, by groups:
            (the root's `[npart, 1, lanes]`, those of the bodies below it: `[npart, nbody, lanes]`
            for each level, or `[rows, npart, 1, lanes]`) [-]. Near the surface
            (`World.near_surface`) shares of what they carry along x, then y, then z. Behind them,
            of parts under a drag law with memory, `PartDragLaw.memory` rows of all parts each;
            empty without added mass and memories.
        clearance: least distance by which boxes of a robot that can meet stay apart, `[lanes]` [m];
            not positive: unknown. Empty without such boxes.
        pressed: forces along the normals of contacts between the robot's own modules in the last
            step, `[1 + hinge rows, lanes]` on the rigid bodies, in the order of `Tree.join_rows`
            [N]; behind them, of one robot, on the left and the right half of each module. Empty
            where no sensor feels them, see `Engine.with_touch`.
    """

    position: Lanes
    quat: Lanes
    velocity: Lanes
    angular_velocity: Lanes
    angle: Any
    speed: Any
    qacc_prev: Any = ()
    command: Any = ()
    submerged: Any = ()
    clearance: Any = ()
    pressed: Any = ()


class RootState(NamedTuple):
    """Pose and velocity of the core, component by component, `[lanes]` each.

    Attributes:
        position: of its origin, world frame [m].
        quat: world from body (w, x, y, z).
        velocity: of its origin, world frame [m/s].
        angular_velocity: body frame [rad/s].
    """

    position: Lanes
    quat: Lanes
    velocity: Lanes
    angular_velocity: Lanes


def integrate_quat(quat: tuple[Scalar, ...], angular_velocity: Vec, dt: float) -> Lanes:
    """Turns a quaternion by a body-frame rotation of angular velocity · dt, and normalises it."""
    half = vscale(0.5 * dt, angular_velocity)
    square = dot(half, half)
    if square.dtype == jnp.float32:
        # sin(x)/x and cos(x) as series: exact below 1 rad a step, to 1e-3 at half a turn.
        sine = 1 + square * (-1 / 6 + square * (1 / 120 + square * (-1 / 5040)))
        cosine = 1 + square * (-1 / 2 + square * (1 / 24 + square * (-1 / 720)))
    else:
        angle = jnp.sqrt(square + 1e-300)
        sine, cosine = jnp.sin(angle) / angle, jnp.cos(angle)
    turned = quat_mul(quat, (cosine, *vscale(sine, half)))
    scale = 1 / jnp.sqrt(total(*[x * x for x in turned]))
    return tuple(x * scale for x in turned)


def integrate(
    state: State, water: Water, qacc: tuple[Vec, Vec, Any], dt: float, carries: bool
) -> State:
    """The state after a step of semi-implicit Euler: velocities before positions.

    Args:
        state: before it.
        water: its uniform current, relative to which the accelerations are.
        qacc: accelerations, (linear, angular, hinges); the root's as rates of its body-frame
            velocities [m/s², rad/s²].
        dt: [s].
        carries: whether any part has added mass.

    Returns:
        The state; thrusters' commands and submerged fractions as they were.
    """
    linear, angular, hinges = qacc
    angular_velocity = tuple(
        w + dt * a for w, a in zip(state.angular_velocity, angular, strict=True)
    )
    forward = lambda x, rate: x + dt * rate  # noqa: E731
    speed = jax.tree.map(forward, state.speed, hinges)
    rotation, quat = quat_to_mat(state.quat), integrate_quat(state.quat, angular_velocity, dt)
    seen = matTvec(rotation, vsub(state.velocity, water.current))
    if carries:
        # Momentum is kept in the body's frame, so velocity turns with it.
        ahead = tuple(v + dt * a for v, a in zip(seen, linear, strict=True))
        velocity = vadd(matvec(quat_to_mat(quat), ahead), water.current)
        # It moves by the mean of its directions before and after: second order.
        before = vadd(matvec(rotation, ahead), water.current)
        way = vscale(0.5, vadd(before, velocity))
    else:
        # As MuJoCo: the body-frame rate and the frame's turning make the world's acceleration.
        push = matvec(rotation, vadd(linear, cross(state.angular_velocity, seen)))
        way = velocity = vadd(state.velocity, vscale(dt, push))
    if has_acceleration(water):
        velocity, way = (vadd(v, vscale(dt, water.acceleration)) for v in (velocity, way))
    return state._replace(
        position=tuple(x + dt * v for x, v in zip(state.position, way, strict=True)),
        quat=quat,
        velocity=velocity,
        angular_velocity=angular_velocity,
        angle=jax.tree.map(forward, state.angle, speed),
        speed=speed,
        qacc_prev=qacc,
    )


def has_acceleration(water: Water) -> bool:
    """Whether the uniform current has an acceleration; a traced one counts."""
    return any(not isinstance(x, int | float) or x != 0 for x in water.acceleration)


def effective_gravity(world: World, water: Water, motion: BodyMotion) -> Vec:
    """Gravity upwards in the bodies' frames, with the acceleration of a gusty current [m/s²].

    In a frame that goes with the current, its acceleration acts as weight does.
    """
    gravity = vscale(world.gravity, motion.z_axis)
    if has_acceleration(water):
        for push, axis in zip(water.acceleration, motion.axes, strict=True):
            gravity = vadd(gravity, vscale(push, axis))
    return gravity
