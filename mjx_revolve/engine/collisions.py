"""Contact between robots: a penalty law between spheres, equal and opposite on both.

Side by side in one batch stand one or several worlds with equally many places for robots. A list of
pairs of spheres that are nearer than a skin is made now and then, and is good until something may
have moved by half of that (Verlet 1967, Physical Review 159); in between, only those are looked at.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.engine.contact import CREEP, FADE
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

# How far apart spheres may be that are watched [m], and balls around robots. What swims moves half
# the one way in some tens of milliseconds. Choices, measured to be about the best for a crowd.
_SKIN, _AURA = 0.08, 0.3
# By how much faster something may become while nobody looks: within a step. A choice.
_HASTE = 1.2
# Pairs of robots that are looked at together, pairs of spheres that they may add to the list, and
# pairs of spheres that are pushed together: enough for vector registers, few enough that two robots
# that meet do not pay for a crowd. Choices.
_PAIRS, _FOUND, _PUSHED = 4, 512, 64
# Room in the list for so many pairs of spheres to a robot; more than heaps have. A choice.
_ROOM = 64
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
    fade = jnp.clip(depth / FADE, 0, 1)
    damper = (dt * k + 2 * touch.damping * jnp.sqrt(k * mass)) * fade
    force = (k * depth + damper * inwards) / (1 + dt * damper / mass)
    force = jnp.where((depth > 0) & (force > 0), force, 0)
    slip = tuple(v + inwards * n for v, n in zip(velocity, normal, strict=True))
    grip = touch.friction * force / jnp.sqrt(dot(slip, slip) + CREEP**2)
    grip = grip / (1 + dt * grip / slip_mass)
    return tuple(force * n - grip * s for n, s in zip(normal, slip, strict=True))


class _Side(NamedTuple):
    """One sphere of each pair, `[n]` each, world frame.

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

    def velocity_at(self, point: Vec) -> Vec:
        """Of the body where it touches [m/s]."""
        return vadd(self.velocity, cross(self.spin, vsub(point, self.origin)))

    def inverse_at(self, point: Vec, normal: Vec) -> tuple[Scalar, Scalar]:
        """Upper bounds of the inverse mass along the normal, and across it [1/kg]."""
        arm = vsub(point, self.middle)
        lever = cross(arm, normal)
        along = self.inverse_mass + dot(lever, lever) * self.inverse_inertia
        return along, self.inverse_mass + dot(arm, arm) * self.inverse_inertia


def _depth(one: _Side, other: _Side) -> jax.Array:
    """How deep spheres are in each other [m]."""
    apart = vsub(one.place, other.place)
    return one.radius + other.radius - jnp.sqrt(dot(apart, apart) + _TINY**2)


def _collide(touch: Touch, one: _Side, other: _Side, share: jax.Array, dt: float) -> Any:
    """Wrenches of spheres on the bodies of both, as `contact_force` has them.

    `share` is that of the reduced mass which each contact may stop. Returns torque and force about
    the bodies' origins, their frames, six of `[n]` for each side.
    """
    apart = vsub(one.place, other.place)
    normal = vscale(1 / jnp.sqrt(dot(apart, apart) + _TINY**2), apart)
    depth = _depth(one, other)
    # Amid what both share; the same point for both, so that angular momentum is kept.
    point = vadd(other.place, vscale(other.radius - 0.5 * depth, normal))
    velocity = vsub(one.velocity_at(point), other.velocity_at(point))
    inverse = vadd(one.inverse_at(point, normal), other.inverse_at(point, normal))
    mass, slip_mass = (share / x for x in inverse)
    force = contact_force(touch, depth, normal, velocity, mass, slip_mass, dt)

    def wrench(side: _Side, force: Vec) -> tuple[Scalar, ...]:
        torque = cross(vsub(point, side.origin), force)
        return (*matTvec(side.axes, torque), *matTvec(side.axes, force))

    return wrench(one, force), wrench(other, tuple(-x for x in force))


class Watch(NamedTuple):
    """Pairs of spheres that are near each other.

    Attributes:
        first: `[n]` int32 the one of each pair: its robot's place times S and its number.
        second: `[n]` the other one.
        many: how many there are, int32.
        gap: least distance between two of them then [m].
        close: `[lanes]` robots that others are near to.
        moved: how far anything of those may have moved since then [m]; infinite before.
        strayed: likewise of all robots.
    """

    first: jax.Array
    second: jax.Array
    many: jax.Array
    gap: jax.Array
    close: jax.Array
    moved: jax.Array
    strayed: jax.Array


class Meet(NamedTuple):
    """What robots of one world do to each other.

    Attributes:
        start: state → what is watched before the first step: nothing.
        look: (state, what is watched) → (`Meeting`, what is watched).
    """

    start: Callable[[State], Any]
    look: Callable[[State, Any], tuple[Meeting, Any]]


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
) -> Meet:
    """What robots of one world do to each other, as functions of their state.

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
        The functions. There are loops of unknown length in them: they have forward derivatives
        only.
    """
    contact = None if touch is None else _Contact(rows, spheres, present, worlds, touch)

    def start(state: State) -> Any:
        return () if contact is None else contact.start(state)

    def look(state: State, watch: Any) -> tuple[Meeting, Any]:
        push = ()
        if contact is not None:
            push, watch = contact.push(state, watch)
        if tag is None:
            return Meeting(push), watch
        return Meeting(push, *nearest_of(state.position, worlds, present, tag)), watch

    return Meet(start, look)


class _Contact:
    """Contact of robots; arguments as of `make_meeting`."""

    def __init__(
        self, rows: Rows, spheres: Spheres, present: jax.Array, worlds: int, touch: Touch
    ) -> None:
        lanes = rows.lanes
        own = jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], lanes)), spheres)
        self.rows, self.own, self.present, self.worlds = rows, own, present, worlds
        self.touch, self.dt, self.size = touch, rows.world.timestep, own.row.shape[0]
        self.room = _ROOM * lanes
        # Of each sphere, robot after robot: the row of its body's frame, and its numbers.
        lane = jnp.arange(lanes, dtype=jnp.int32)
        self.frame_of = (own.row * lanes + lane).T.reshape(-1)
        numbers = (*own.center, *own.mass_center, own.radius, own.inverse_mass, own.inverse_inertia)
        self.numbers = jnp.stack([x.T.reshape(-1) for x in numbers])
        far = jnp.sqrt(dot(own.center, own.center))
        count = rows.capacity.rows + 1
        # How far from its frame's origin any sphere of a body is.
        self.radius = jnp.zeros((count, lanes), far.dtype).at[own.row, lane].max(far)

    def start(self, state: State) -> Watch:
        """Nothing is known yet."""
        nothing = jnp.zeros(self.room + _FOUND, jnp.int32)
        moved = jnp.full((), jnp.inf, state.position[0].dtype)
        return Watch(nothing, nothing, jnp.int32(0), moved, self.present, moved, moved)

    def push(self, state: State, watch: Watch) -> tuple[Any, Watch]:
        """Pushes of all contacts, as `Meeting.push`, and what is watched."""
        frames = frames_of(self.rows, state)
        stale = (watch.moved > _SKIN / 2) | (watch.strayed > _AURA / 2)
        watch = jax.lax.cond(stale, lambda: self._find(frames, watch), lambda: watch)
        shape = self.radius.shape
        nothing = jnp.zeros((6, shape[0] * shape[1]), self.radius.dtype)
        total = jax.lax.cond(
            watch.gap < 2 * watch.moved,
            lambda: self._add_up(frames, watch, nothing),
            lambda: nothing,
        )
        parts = [total[k].reshape(shape) for k in range(6)]
        root, below = (tuple(x[:1] for x in parts), tuple(x[1:, None] for x in parts))
        pace = jnp.sqrt(dot(frames.velocity, frames.velocity))
        pace = jnp.max(pace + self.radius * jnp.sqrt(dot(frames.spin, frames.spin)), 0)
        # Robots that are no numbers move nobody.
        way = jnp.where(self.present & jnp.isfinite(pace), _HASTE * self.dt * pace, 0)
        watch = watch._replace(
            moved=watch.moved + jnp.max(jnp.where(watch.close, way, 0)),
            strayed=watch.strayed + jnp.max(way),
        )
        return ((root[:3], root[3:]), (below[:3], below[3:])), watch

    # --- which spheres are near each other

    def _find(self, frames: Frames, watch: Watch) -> Watch:
        """The list anew; where it has no room for what is near, of what touches, at every step."""
        place, near, close = self._balls(frames)
        skin = jnp.asarray(_SKIN, self.radius.dtype)
        found, whole = self._spheres(place, near, skin, watch)
        zero, never = jnp.zeros_like(watch.moved), jnp.full_like(watch.moved, jnp.inf)
        found = found._replace(close=close, moved=zero, strayed=zero)

        def only_touching() -> Watch:
            few, _ = self._spheres(place, near, jnp.zeros_like(skin), watch)
            return few._replace(close=close, moved=never, strayed=never)

        return jax.lax.cond(whole, lambda: found, only_touching)

    def _balls(self, frames: Frames) -> tuple[Vec, jax.Array, jax.Array]:
        """Where all spheres are, which robots may touch, and which have others near them.

        Returns:
            `[S, lanes]` each, `[worlds, n, n]` and `[lanes]`.
        """
        own, n = self.own, self.rows.lanes // self.worlds
        pick = lambda x: jnp.take_along_axis(x, own.row, 0)  # noqa: E731
        axes = jax.tree.map(pick, frames.axes)
        place = vadd(jax.tree.map(pick, frames.place), matvec(axes, own.center))
        real = own.radius > 0
        # A ball around each robot as it is bent now.
        count = jnp.maximum(jnp.sum(real, 0), 1)
        middle = tuple(jnp.sum(jnp.where(real, x, 0), 0) / count for x in place)
        away = vsub(place, middle)
        reach = jnp.max(jnp.where(real, jnp.sqrt(dot(away, away)) + own.radius, 0), 0)
        square, reach = distances(middle, self.worlds, self.present), reach.reshape(-1, n)
        both = reach[:, :, None] + reach[:, None, :]
        close = jnp.any(square < (both + _AURA) ** 2, 1).reshape(-1)
        return place, square < (both + _SKIN) ** 2, close

    def _spheres(
        self, place: Vec, near: jax.Array, skin: jax.Array, watch: Watch
    ) -> tuple[Watch, jax.Array]:
        """The pairs of spheres that are nearer than a skin, and whether these are all."""
        lanes, n = self.rows.lanes, near.shape[-1]
        near = (near & jnp.triu(jnp.ones((n, n), bool), 1)).reshape(-1)
        number, end = jnp.arange(near.size, dtype=jnp.int32), jnp.int32(near.size)
        # Robot after robot: what is picked of one lies side by side. Padding is far from touching.
        place = tuple(x.T for x in place)
        radius = jnp.where(self.own.radius > 0, self.own.radius, -1e3).T

        def after(last: jax.Array) -> jax.Array:
            return jnp.min(jnp.where(near & (number > last), number, end))

        def block(carry: Any) -> Any:
            start, first, second, total, whole, gap = carry
            some = [start]
            for _ in range(_PAIRS - 1):
                some.append(after(some[-1]))
            ids = jnp.stack(some)
            base = ids // (n * n) * n
            pair = base + ids // n % n, base + ids % n
            one, other = (jnp.minimum(x, lanes - 1) for x in pair)
            apart = tuple(x[one][:, :, None] - x[other][:, None, :] for x in place)
            least = radius[one][:, :, None] + radius[other][:, None, :] + skin
            square, real = dot(apart, apart), (ids < end)[:, None, None]
            close = (square < least * jnp.abs(least)) & real

            def nearest() -> jax.Array:
                found = jnp.where(close, jnp.sqrt(square) - (least - skin), jnp.inf)
                return jnp.minimum(gap, jnp.min(found))

            def append() -> Any:
                row, column, count = _list_true(close.reshape(-1, self.size), _FOUND)
                k = row // self.size
                a, b = one[k] * self.size + row % self.size, other[k] * self.size + column
                room = jnp.minimum(jnp.minimum(count, _FOUND), self.room - total)
                return (
                    jax.lax.dynamic_update_slice(first, a, (total,)),
                    jax.lax.dynamic_update_slice(second, b, (total,)),
                    total + room,
                    whole & (room == count),
                    nearest(),
                )

            kept = first, second, total, whole, gap
            kept = jax.lax.cond(jnp.any(close), append, lambda: kept)
            return after(some[-1]), *kept

        carry = (
            after(jnp.int32(-1)), watch.first, watch.second, jnp.int32(0), jnp.bool_(True),
            jnp.full_like(watch.gap, jnp.inf),
        )  # fmt: skip
        _, first, second, total, whole, gap = jax.lax.while_loop(lambda x: x[0] < end, block, carry)
        return watch._replace(first=first, second=second, many=total, gap=gap), whole

    # --- how they push each other

    def _add_up(self, frames: Frames, watch: Watch, nothing: jax.Array) -> jax.Array:
        """`[6, rows + 1 × lanes]` wrenches on all bodies.

        Sums are products with matrices of zeros and ones: XLA:CPU makes a slow loop of a scatter,
        and others add in any order.
        """
        values = (*frames.place, *frames.velocity, *frames.spin, *sum(frames.axes, ()))
        table = jnp.concatenate([x.reshape(-1) for x in values])
        each = jnp.arange(self.radius.size, dtype=jnp.int32)
        columns = self.radius.size * jnp.arange(len(values), dtype=jnp.int32)[:, None]

        def run(step: Callable[[jax.Array, Any], Any], carry: Any) -> Any:
            """Over the list, some at a time."""

            def body(state: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
                return state[0] + _PUSHED, step(*state)

            start = jnp.int32(0), carry
            return jax.lax.while_loop(lambda x: x[0] < watch.many, body, start)[1]

        def part(x: jax.Array, start: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice(x, (start,), (_PUSHED,))

        def sides(start: jax.Array) -> Any:
            which = [part(x, start) for x in (watch.first, watch.second)]
            own = [self.frame_of[x] for x in which]
            found = [
                _side(table[frame + columns], self.numbers[:, x])
                for frame, x in zip(own, which, strict=True)
            ]
            return found, own

        def feel(start: jax.Array, pairs: jax.Array) -> jax.Array:
            real = start + jnp.arange(_PUSHED, dtype=jnp.int32) < watch.many
            touching = real & (_depth(*sides(start)[0]) > 0)
            first, second = (part(x, start) // self.size for x in (watch.first, watch.second))
            pair = jnp.where(touching, first * self.rows.lanes + second, -1)
            return jax.lax.dynamic_update_slice(pairs, pair, (start,))

        # Which robots touch, for each pair of spheres that do; -1 where they do not.
        pairs = run(feel, jnp.full(watch.first.shape[0] + _PUSHED, -1, jnp.int32))

        def push(start: jax.Array, total: jax.Array) -> jax.Array:
            pair = part(pairs, start)

            def collide() -> jax.Array:
                (one, other), own = sides(start)

                def count(begin: jax.Array, total: jax.Array) -> jax.Array:
                    same = pair[:, None] == part(pairs, begin)[None]
                    return total + jnp.sum(same, 1, dtype=total.dtype)

                # Contacts of two robots share what may be stopped.
                share = _SHARE / jnp.maximum(run(count, jnp.zeros(_PUSHED, total.dtype)), 1)
                wrenches = _collide(self.touch, one, other, share, self.dt)
                wide = jnp.concatenate([jnp.stack(x) for x in wrenches], 1)
                wide = jnp.where(jnp.tile(pair >= 0, 2), wide, 0)
                on = (jnp.concatenate(own)[:, None] == each).astype(wide.dtype)
                return total + jnp.matmul(wide, on, precision="highest")

            return jax.lax.cond(jnp.any(pair >= 0), collide, lambda: total)

        return jax.lax.cond(jnp.any(pairs >= 0), lambda: run(push, nothing), lambda: nothing)


def _side(frame: jax.Array, numbers: jax.Array) -> _Side:
    """From `[18, n]` of frames and `[9, n]` of spheres."""
    f, x = frame, numbers
    axes = (tuple(f[9:12]), tuple(f[12:15]), tuple(f[15:18]))
    origin = tuple(f[:3])
    place = lambda local: vadd(origin, matvec(axes, tuple(local)))  # noqa: E731
    return _Side(
        place(x[:3]), origin, place(x[3:6]), tuple(f[3:6]), tuple(f[6:9]), axes, x[6], x[7], x[8]
    )


def _list_true(flags: jax.Array, most: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where flags `[n, m]` are true, row by row, at most so many places.

    Returns:
        `[most]` rows and columns, int32, of which as many as there are mean something; and how many
        are true in all.
    """
    counts = jnp.sum(flags, 1, dtype=jnp.int32)
    ends = jnp.cumsum(counts)
    slot = jnp.arange(most, dtype=jnp.int32)
    row = jnp.sum(ends[None] <= slot[:, None], 1, dtype=jnp.int32)
    row = jnp.minimum(row, len(counts) - 1)
    rank = slot - (ends[row] - counts[row])
    seen = jnp.cumsum(flags[row].astype(jnp.int32), 1)
    column = jnp.sum(seen <= rank[:, None], 1, dtype=jnp.int32)
    return row, jnp.minimum(column, flags.shape[1] - 1), ends[-1]
