"""The state of a population, how it advances, and what a rollout asks of a simulator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.engine.plant import Plant
from mjx_revolve.numerics.inertia import (
    Motion,
)
from mjx_revolve.numerics.spatial import (
    Scalar,
    Vec,
    cross,
    dot,
    matTvec,
    matvec,
    quat_mul,
    quat_to_rows,
    total,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import World


class State(NamedTuple):
    """State of a population, component by component.

    Attributes:
        position: of the root, world frame [m], three of `[lanes]`.
        quat: of the root, world from body (w, x, y, z), four of `[lanes]`.
        velocity: of the root's origin, world frame [m/s], three of `[lanes]`.
        spin: angular velocity of the root, body frame [rad/s], three of `[lanes]`.
        angle: of the hinges, as `bodies.spread` has them: `[nbody, lanes]` for each level below
            the root, or `[rows, 1, lanes]` [rad].
        speed: of the hinges, likewise [rad/s].
        pace: accelerations of the step before, (linear, angular, hinges); the root's as rates of
            its body-frame velocities; empty where nothing needs them.
        command: of the thrusters, behind their lag, `[nthruster, lanes]` [-]; empty without.
        wet: submerged shares of the parts that carry water at the step before, by groups: (the
            root's `[npart, 1, lanes]`, those of the bodies below it: `[npart, nbody, lanes]` for
            each level, or `[rows, npart, 1, lanes]`) [-]; empty where no water is carried.
    """

    position: Vec
    quat: tuple[Scalar, Scalar, Scalar, Scalar]
    velocity: Vec
    spin: Vec
    angle: Any
    speed: Any
    pace: Any = ()
    command: Any = ()
    wet: Any = ()


class Root(NamedTuple):
    """Where the core is and how it moves, component by component, `[lanes]` each.

    Attributes:
        position: of its origin, world frame [m].
        quat: world from body (w, x, y, z).
        velocity: of its origin, world frame [m/s].
        spin: angular velocity, body frame [rad/s].
    """

    position: Vec
    quat: tuple[Scalar, Scalar, Scalar, Scalar]
    velocity: Vec
    spin: Vec


class Engine(NamedTuple):
    """What a rollout needs of a simulator; the population step and MJX's give the same.

    Attributes:
        init: (qpos `[nq, lanes]`, qvel `[nv, lanes]`) → state.
        step: (state, ctrl `[n, lanes]` in the plant's order, water) → (state, power `[lanes]` that
            the servos deliver or take up, summed without sign [W]).
        observe: state → (qpos `[nq, lanes]`, qvel `[nv, lanes]`).
        root: state → where the core is and how it moves; cheaper than observe.
        joints: state → (angles [rad], speeds [rad/s]) of the hinges, `[hinge rows, lanes]` each in
            the plant's order; cheaper than observe.
        load: (state, ctrl) → torque of the servos that are told this, likewise [N·m].
        touch: (state, water) → how hard the bed pushes the core's rigid body, then what each hinge
            carries, `[1 + hinge rows, lanes]` [N]; a sweep over the body, so not for nothing.
        motions: state → where the core's rigid body is and how it moves, then what each hinge
            carries: a `Motion` of `[1 + hinge rows, lanes]` each, velocities over ground, each
            body's frame at its hinge; likewise a sweep.
        cells: (state, water) → how hard the bed pushes the left and the right half of each module,
            along its normal, `[lanes]` [N]; likewise. None for many different robots.
        command: state → the thrusters' commands behind their lag, `[nthruster, lanes]` [-].
        push: (state, ctrl, water) → (force of the bed, force of the water) on the whole robot,
            world frame, three of `[lanes]` each [N]; weight and carried water's inertia apart.
        plant: the actuators in the order of `step`'s ctrl.
        fuses: whether a step is element-wise, so that it may be compiled as one function.
        varied: a `variation.Variation` → the same engine with those coefficients; None where it
            cannot.
        meet: a `collisions.Meet`, what robots of one world do to each other; the `push` of a
            meeting is a fourth argument of `step`. None where each has a world to itself. It is no
            element-wise function.
    """

    init: Callable[[jax.Array, jax.Array], Any]
    step: Callable[..., tuple[Any, jax.Array]]
    observe: Callable[[Any], tuple[jax.Array, jax.Array]]
    root: Callable[[Any], Root]
    joints: Callable[[Any], tuple[jax.Array, jax.Array]]
    load: Callable[[Any, jax.Array], jax.Array]
    touch: Callable[[Any, Water], jax.Array]
    motions: Callable[[Any], Motion]
    cells: Callable[[Any, Water], tuple[tuple[jax.Array, jax.Array], ...]] | None
    command: Callable[[Any], jax.Array]
    push: Callable[[Any, jax.Array, Water], tuple[Vec, Vec]]
    plant: Plant
    fuses: bool
    varied: Callable[[Any], Engine] | None = None
    meet: Any = None


def root_of(state: State) -> Root:
    """Where the core is and how it moves."""
    return Root(state.position, state.quat, state.velocity, state.spin)


def turn_quat(quat: tuple[Scalar, ...], spin: Vec, dt: float) -> tuple[Scalar, ...]:
    """Turns a quaternion by a body-frame rotation of spin · dt, and normalises it."""
    half = vscale(0.5 * dt, spin)
    square = dot(half, half)
    if square.dtype == jnp.float32:
        # sin(x)/x and cos(x) as series: below half a turn per step they are exact to float32.
        sine = 1 + square * (-1 / 6 + square * (1 / 120 + square * (-1 / 5040)))
        cosine = 1 + square * (-1 / 2 + square * (1 / 24 + square * (-1 / 720)))
    else:
        angle = jnp.sqrt(square + 1e-300)
        sine, cosine = jnp.sin(angle) / angle, jnp.cos(angle)
    turned = quat_mul(quat, (cosine, *vscale(sine, half)))
    scale = 1 / jnp.sqrt(total(*[x * x for x in turned]))
    return tuple(x * scale for x in turned)


def advance(
    state: State, water: Water, pace: Any, dt: float, carries: bool, wet: Any = ()
) -> State:
    """The state after a step: semi-implicit Euler, velocities before positions.

    Args:
        state: before it.
        water: its uniform current, in which the step is seen.
        pace: accelerations, (linear, angular, hinges); the root's as rates of its body-frame
            velocities [m/s², rad/s²].
        dt: [s].
        carries: whether water is carried along.
        wet: submerged shares of this step.

    Returns:
        The state; thrusters' commands as they were.
    """
    linear, angular, hinges = pace
    spin = tuple(w + dt * a for w, a in zip(state.spin, angular, strict=True))
    forward = lambda x, rate: x + dt * rate  # noqa: E731
    speed = jax.tree.map(forward, state.speed, hinges)
    turn, quat = quat_to_rows(state.quat), turn_quat(state.quat, spin, dt)
    relative = vsub(state.velocity, water.current)
    seen = matTvec(turn, relative)
    if carries:
        # Momentum is kept in the body's frame, so velocity turns with it.
        ahead = tuple(v + dt * a for v, a in zip(seen, linear, strict=True))
        velocity = vadd(matvec(quat_to_rows(quat), ahead), water.current)
    else:
        # As MuJoCo: the body-frame rate and the frame's turning make the world's acceleration.
        push = matvec(turn, vadd(linear, cross(state.spin, seen)))
        velocity = vadd(state.velocity, vscale(dt, push))
    if is_pulled(water):
        velocity = vadd(velocity, vscale(dt, water.acceleration))
    return State(
        position=tuple(x + dt * v for x, v in zip(state.position, velocity, strict=True)),
        quat=quat,
        velocity=velocity,
        spin=spin,
        angle=jax.tree.map(forward, state.angle, speed),
        speed=speed,
        pace=pace if carries else (),
        command=state.command,
        wet=wet,
    )


def is_pulled(water: Water) -> bool:
    """Whether the uniform current has an acceleration; a traced one counts."""
    return any(not isinstance(x, int | float) or x != 0 for x in water.acceleration)


def felt_gravity(world: World, water: Water, motion: Motion) -> Vec:
    """Gravity upwards in the bodies' frames, with the acceleration of a gusty current [m/s²].

    In a frame that goes with the current, its acceleration is felt as weight is.
    """
    gravity = vscale(world.gravity, motion.up)
    if is_pulled(water):
        axes = (motion.x_axis, motion.y_axis, motion.up)
        for push, axis in zip(water.acceleration, axes, strict=True):
            gravity = vadd(gravity, vscale(push, axis))
    return gravity
