"""Contact between robots: a penalty law between spheres, equal and opposite on both.

Side by side in one batch stand one or several worlds with equally many places for robots. Which
robots are near each other follows from where their cores are; only those are looked at closely, a
few pairs at a time, however many there are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.engine.dynamics import move_bodies
from mjx_revolve.engine.rows import Rows
from mjx_revolve.engine.spheres import Spheres
from mjx_revolve.engine.state import State
from mjx_revolve.numerics.spatial import (
    Scalar,
    Vec,
    cross,
    dot,
    matTvec,
    matvec,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.numerics.xla import share_once, small_call

# Pairs of robots that are looked at together: enough for vector registers, few enough that two
# robots that meet do not pay for a crowd. A choice.
_PAIRS = 4
# The damper fades in over this depth [m], so that touching is no jump in force; as for the bed.
_FADE = 5e-4
# Below this speed [m/s] friction is viscous, as Coulomb's law has no value at rest; likewise.
_CREEP = 0.001
# Share of the mass that a contact may stop in a step, so that a body between several others does
# not get more than it takes: stable up to four at a time. A choice.
_SHARE = 0.5
# Below this distance [m] two centres have no direction from one to the other.
_TINY = 1e-6


@dataclass(frozen=True)
class Touch:
    """How robots' surfaces answer each other; choices, as for a soft ground.

    Attributes:
        stiffness: of a pair of spheres [N/m].
        damping: as a share of the critical one [-].
        friction: Coulomb's coefficient [-].
    """

    stiffness: float = 2000.0
    damping: float = 1.0
    friction: float = 0.4


class Frames(NamedTuple):
    """Where rigid bodies are and how they move, `[rows + 1, lanes]` each; the root is the first.

    Attributes:
        axes: the world's x, y and z in the body's frame, three times three.
        place: of the origin, world frame [m].
        velocity: of the origin, world frame [m/s].
        spin: world frame [rad/s].
    """

    axes: tuple[Vec, Vec, Vec]
    place: Vec
    velocity: Vec
    spin: Vec


def frames_of(rows: Rows, state: State) -> Frames:
    """Where the rigid bodies of robots are and how they move.

    Args:
        rows: the robots.
        state: of the population.

    Returns:
        The frames.
    """

    def find(position: Vec, quat: Any, velocity: Vec, spin: Vec, angle: Any, speed: Any) -> Any:
        moving = State(position, quat, velocity, spin, angle, speed)
        root, moved, _ = move_bodies(rows, moving, True, 0.0)
        below = rows.unfold(moved)[0].motion

        def join(first: Any, rest: Any) -> jax.Array:
            wide = jnp.broadcast_to(first, (1, rows.lanes))
            return jnp.concatenate([wide, rest])

        motion = jax.tree.map(join, root.motion, below)
        axes = (motion.x_axis, motion.y_axis, motion.up)
        place = (*motion.place, motion.height)
        return axes, place, matvec(axes, motion.velocity), matvec(axes, motion.spin)

    given = state.position, state.quat, state.velocity, state.spin, state.angle, state.speed
    return Frames(*small_call(share_once(find))(*given))


def contact_force(
    touch: Touch,
    depth: Scalar,
    normal: Vec,
    velocity: Vec,
    mass: Scalar,
    slip_mass: Scalar,
    dt: float,
) -> Vec:
    """Force on a sphere that another one touches.

    Normal, with d > 0 the depth and v the speed inwards at the end of the step: F = k d + c v, c
    critical damping of the reduced mass m of the two bodies where they touch; as F slows them
    within the step,

        F = (k d + (dt k + c) v) / (1 + (dt² k + dt c) / m) ≥ 0,

    a spring and a damper as dt goes to 0, and at any dt no more than what stops m. m is a lower
    bound, that of the two rigid bodies without those that hang on them, so that it is stable.
    Tangential: Coulomb's, -μ F v_t / √(v_t² + v_c²) with v_c = 1 mm/s, likewise bounded.

    Args:
        touch: stiffness, damping and friction.
        depth: of one in the other [m], negative apart.
        normal: unit vector from the other one's centre to that of the sphere that is pushed.
        velocity: of the one relative to the other where they touch [m/s].
        mass: reduced mass of the two along the normal [kg].
        slip_mass: a lower bound of it across the normal [kg].
        dt: of the step [s].

    Returns:
        The force, in the frame of the arguments [N].
    """
    k = touch.stiffness
    inwards = -dot(velocity, normal)
    fade = jnp.clip(depth / _FADE, 0, 1)
    damper = (dt * k + 2 * touch.damping * jnp.sqrt(k * mass)) * fade
    force = (k * depth + damper * inwards) / (1 + dt * damper / mass)
    force = jnp.where((depth > 0) & (force > 0), force, 0)
    slip = tuple(v + inwards * n for v, n in zip(velocity, normal, strict=True))
    grip = touch.friction * force / jnp.sqrt(dot(slip, slip) + _CREEP**2)
    grip = grip / (1 + dt * grip / slip_mass)
    return tuple(force * n - grip * s for n, s in zip(normal, slip, strict=True))


class _Side(NamedTuple):
    """The spheres of one robot of each pair: `[B, S]` each, world frame.

    Attributes:
        place: of the centre [m].
        origin: of the body's frame [m].
        middle: of the body's mass [m].
        velocity: of the body's origin [m/s].
        spin: [rad/s].
        axes: of the world in the body's frame.
        radius: [m].
        inverse_mass: [1/kg].
        inverse_inertia: [1/(kg m²)].
    """

    place: Vec
    origin: Vec
    middle: Vec
    velocity: Vec
    spin: Vec
    axes: tuple[Vec, Vec, Vec]
    radius: jax.Array
    inverse_mass: jax.Array
    inverse_inertia: jax.Array

    def along(self, axis: int) -> _Side:
        """The same with a further axis, for the other robot's spheres."""
        return jax.tree.map(lambda x: jnp.expand_dims(x, axis), self)

    def velocity_at(self, point: Vec) -> Vec:
        """Of the body where it touches [m/s]."""
        return vadd(self.velocity, cross(self.spin, vsub(point, self.origin)))

    def inverse_at(self, point: Vec, normal: Vec) -> tuple[Scalar, Scalar]:
        """Upper bounds of the inverse mass along the normal, and across it [1/kg]."""
        arm = vsub(point, self.middle)
        lever = cross(arm, normal)
        along = self.inverse_mass + dot(lever, lever) * self.inverse_inertia
        return along, self.inverse_mass + dot(arm, arm) * self.inverse_inertia


def _side(frames: Frames, spheres: Spheres, lane: jax.Array) -> _Side:
    own = jax.tree.map(lambda x: jnp.moveaxis(x[..., lane], -1, 0), spheres)
    pick = lambda x: jnp.take_along_axis(x[:, lane].T, own.row, 1)  # noqa: E731
    found = jax.tree.map(pick, frames)
    place = lambda x: vadd(found.place, matvec(found.axes, x))  # noqa: E731
    return _Side(
        place(own.center), found.place, place(own.mass_center), found.velocity, found.spin,
        found.axes, own.radius, own.inverse_mass, own.inverse_inertia,
    )  # fmt: skip


def _depth(one: _Side, other: _Side, real: jax.Array) -> jax.Array:
    """`[B, S, S]` how deep spheres are in each other [m]; -1 where a pair or a sphere is none."""
    a, b = one.along(2), other.along(1)
    apart = vsub(a.place, b.place)
    meet = real[:, None, None] & (a.radius > 0) & (b.radius > 0)
    return jnp.where(meet, a.radius + b.radius - jnp.sqrt(dot(apart, apart) + _TINY**2), -1.0)


def _collide(touch: Touch, one: _Side, other: _Side, depth: jax.Array, dt: float) -> jax.Array:
    """Wrenches of B pairs of robots on each other, from how deep their spheres are in each other.

    Returns:
        `[2, B, S, 6]` torque and force about the bodies' origins, their frames.
    """
    a, b = one.along(2), other.along(1)
    apart = vsub(a.place, b.place)
    normal = vscale(1 / jnp.sqrt(dot(apart, apart) + _TINY**2), apart)
    # Amid what both share; the same point for both, so that angular momentum is kept.
    point = vadd(b.place, vscale(b.radius - 0.5 * depth, normal))
    velocity = vsub(a.velocity_at(point), b.velocity_at(point))
    inverse = vadd(a.inverse_at(point, normal), b.inverse_at(point, normal))
    # Contacts of two robots share what may be stopped.
    share = _SHARE / jnp.maximum(jnp.sum(depth > 0, (1, 2), keepdims=True), 1)
    mass, slip_mass = (share / x for x in inverse)
    force = contact_force(touch, depth, normal, velocity, mass, slip_mass, dt)

    def wrench(side: _Side, origin: Vec, axis: int, sign: float) -> jax.Array:
        torque = cross(vsub(point, origin), force)
        summed = [sign * jnp.sum(x, axis) for x in (*torque, *force)]
        turned = matTvec(side.axes, tuple(summed[:3])), matTvec(side.axes, tuple(summed[3:]))
        return jnp.stack([*turned[0], *turned[1]], -1)

    return jnp.stack([wrench(one, a.origin, 2, 1.0), wrench(other, b.origin, 1, -1.0)])


class Meeting(NamedTuple):
    """What robots do to each other at one moment.

    Attributes:
        push: torque [N·m] and force [N] about each body's origin, body frame, as
            `dynamics.accelerate` takes them: of the root, three of `[1, lanes]` each, and of the
            rows, three of `[rows, 1, lanes]` each; () without contact.
        nearest: from the core to that of the nearest other robot, world frame, three of `[lanes]`
            [m]; far away where there is none. None where nobody asks.
        tag: of that robot, `[lanes]`, likewise.
    """

    push: Any = ()
    nearest: Any = None
    tag: Any = None


# How far away the nearest robot is where there is none [m].
ALONE = 1e3


def distances(place: Vec, worlds: int, present: jax.Array) -> jax.Array:
    """How far robots are from the others of their worlds.

    Args:
        place: of the cores, world frame, three of `[lanes]` [m].
        worlds: how many stand side by side, with equally many places each.
        present: `[lanes]` whether a place is taken.

    Returns:
        `[worlds, n, n]` squared distances [m²], infinite to itself and where there is none.
    """
    own = tuple(x.reshape(worlds, -1) for x in place)
    there = present.reshape(worlds, -1)
    away = tuple(x[:, None, :] - x[:, :, None] for x in own)
    real = there[:, None, :] & there[:, :, None] & ~jnp.eye(there.shape[-1], dtype=bool)
    return jnp.where(real, dot(away, away), jnp.inf)


def nearest_of(
    place: Vec, worlds: int, present: jax.Array, tag: jax.Array
) -> tuple[Vec, jax.Array]:
    """The nearest other robot of the same world, as each robot might see it.

    Args:
        place: as for `distances`.
        worlds: likewise.
        present: likewise.
        tag: `[lanes]` by which robots can be told apart.

    Returns:
        Three of `[lanes]` from the core to the other core, world frame [m], `ALONE` upwards where
        there is none; and its tag, 0 likewise.
    """
    square = distances(place, worlds, present)
    n = square.shape[-1]
    # Distances are symmetric; over the first of the two indices, XLA:CPU has vectors.
    least = jnp.min(square, 1)
    number = jnp.arange(n, dtype=jnp.int32)[None, :, None]
    which = jnp.min(jnp.where(square == least[:, None], number, n - 1), 1)
    which = (which + n * jnp.arange(worlds, dtype=jnp.int32)[:, None]).reshape(-1)
    found = jnp.isfinite(least).reshape(-1)
    lone = (0.0, 0.0, ALONE)
    toward = tuple(jnp.where(found, x[which] - x, far) for x, far in zip(place, lone, strict=True))
    return toward, jnp.where(found, tag[which], 0)


def make_meeting(
    rows: Rows,
    spheres: Spheres,
    present: jax.Array,
    worlds: int = 1,
    touch: Touch | None = None,
    tag: jax.Array | None = None,
) -> Callable[[State], Meeting]:
    """What robots of one world do to each other, as a function of their state.

    Under `jax.jit`, let the robots' tables and spheres be arguments, not constants: XLA:CPU aborts
    over constants here (see `numerics.xla`).

    Args:
        rows: the robots of all worlds, those of one behind those of another.
        spheres: of them, `[S, lanes]`.
        present: `[lanes]` whether a place is taken: others are not felt.
        worlds: how many stand side by side.
        touch: how surfaces answer; None for robots that pass through each other.
        tag: `[lanes]` by which robots may tell each other apart; None where nobody asks who is
            near.

    Returns:
        state → `Meeting`. A loop of unknown length: it has forward derivatives only.
    """
    dt = rows.world.timestep

    def meet(state: State) -> Meeting:
        push = _push(state) if touch is not None else ()
        if tag is None:
            return Meeting(push)
        return Meeting(push, *nearest_of(state.position, worlds, present, tag))

    def _push(state: State) -> Any:
        assert touch is not None
        lanes, dtype = rows.lanes, state.position[0].dtype
        own = jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], lanes)), spheres)
        square, reach = distances(state.position, worlds, present), own.reach.reshape(worlds, -1)
        near = square < (reach[:, :, None] + reach[:, None, :]) ** 2
        n = near.shape[-1]
        near = (near & jnp.triu(jnp.ones((n, n), bool), 1)).reshape(-1)
        number = jnp.arange(near.size, dtype=jnp.int32)
        end = jnp.int32(near.size)

        def after(last: jax.Array) -> jax.Array:
            return jnp.min(jnp.where(near & (number > last), number, end))

        def close(state: State) -> jax.Array:
            frames = frames_of(rows, state)

            def block(carry: tuple[jax.Array, jax.Array]) -> Any:
                found, total = [carry[0]], carry[1]
                for _ in range(_PAIRS - 1):
                    found.append(after(found[-1]))
                ids = jnp.stack(found)
                real = ids < end
                ids = jnp.where(real, ids, 0)
                base = ids // (n * n) * n
                pair = jnp.stack([base + ids // n % n, base + ids % n])
                one, other = (_side(frames, own, lane) for lane in pair)
                depth = _depth(one, other, real)

                def collide(total: jax.Array) -> jax.Array:
                    row = jnp.moveaxis(own.row, -1, 0)[pair]
                    lane = jnp.broadcast_to(pair[..., None], row.shape)
                    return total.at[row, lane].add(_collide(touch, one, other, depth, dt))

                # Most robots that are near each other do not touch.
                total = jax.lax.cond(jnp.any(depth > 0), collide, lambda x: x, total)
                return after(found[-1]), total

            start = after(jnp.int32(-1)), nothing
            return jax.lax.while_loop(lambda x: x[0] < end, block, start)[1]

        nothing = jnp.zeros((rows.capacity.rows + 1, lanes, 6), dtype)
        total = jax.lax.cond(jnp.any(near), close, lambda _: nothing, state)
        parts = [total[..., k] for k in range(6)]
        root = tuple(x[:1] for x in parts)
        below = tuple(x[1:, None] for x in parts)
        return (root[:3], root[3:]), (below[:3], below[3:])

    return meet
