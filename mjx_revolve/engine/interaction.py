"""Interaction of robots: contact between spheres, equal and opposite on both, and sight.

A batch holds one or several worlds with equal numbers of slots for robots. A neighbour list, the
pairs of spheres nearer than a skin, is made now and then and is valid until a sphere may have moved
by half of the skin (Verlet 1967, Physical Review 159); in between, only these pairs are tested.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.engine.batched_trees import BatchedTrees
from mjx_revolve.engine.contact import CREEP_SPEED, DAMPER_DEPTH
from mjx_revolve.engine.kinematics import body_motions
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
from mjx_revolve.numerics.xla import fuse

# Gap [m] within which pairs of spheres are listed, and within which robots count as close. A
# swimmer moves half of the first in some tens of milliseconds. Choices, measured to be about the
# best for a crowd.
_SKIN, _ROBOT_SKIN = 0.08, 0.3
# Factor by which a speed may grow within a step. A choice.
_SPEED_MARGIN = 1.2
# Pairs of robots tested together, pairs of spheres that they may add to the list, and pairs of
# spheres with forces computed together: enough for vector registers, few enough that two
# robots in contact do not cost as much as a crowd. Choices.
_PAIRS, _FOUND, _PUSHED = 4, 512, 64
# Room in the list for so many pairs of spheres per robot; more than heaps have. A choice.
_ROOM = 64
# Share of the mass that a contact may stop in a step, so that a body between several others does
# not get more than it takes: stable up to four at a time. A choice.
_SHARE = 0.5
# Below this distance [m] two centres have no direction from one to the other.
_TINY = 1e-6


@dataclass(frozen=True)
class ContactParameters:
    """Parameters of the contact between robots; choices, as for a soft ground.

    Attributes:
        stiffness: of a pair of spheres [N/m].
        damping: as a share of the critical one [-].
        friction: Coulomb's coefficient [-].
    """

    stiffness: float = 2000.0
    damping: float = 1.0
    friction: float = 0.4


class Frames(NamedTuple):
    """Poses and velocities of rigid bodies, `[rows + 1, lanes]` each; the root is the first.

    Attributes:
        axes: the world's x, y and z in the body's frame, three times three.
        position: of the origin, world frame [m].
        velocity: of the origin, world frame [m/s].
        angular_velocity: world frame [rad/s].
    """

    axes: tuple[Vec, Vec, Vec]
    position: Vec
    velocity: Vec
    angular_velocity: Vec


def frames_of(trees: BatchedTrees, state: State) -> Frames:
    """Poses and velocities of the rigid bodies of robots."""

    def find(state: State) -> Frames:
        motion = body_motions(trees, state)
        axes = motion.axes
        velocity, angular = matvec(axes, motion.velocity), matvec(axes, motion.angular_velocity)
        return Frames(axes, (*motion.xy, motion.height), velocity, angular)

    found: Frames = fuse(find)(state._replace(qacc_prev=(), command=(), submerged=()))
    return found


def penalty_force(
    parameters: ContactParameters,
    depth: Scalar,
    normal: Vec,
    velocity: Vec,
    mass: Scalar,
    slip_mass: Scalar,
    dt: float,
) -> Vec:
    """Force on a sphere in contact with another.

    Normal, with d > 0 the depth and v the speed inwards at the end of the step: F = k d + c v, c
    critical damping of the reduced mass m of the two bodies where they touch; as F slows them
    within the step,

        F = (k d + (dt k + c) v) / (1 + (dt² k + dt c) / m) ≥ 0,

    a spring and a damper as dt goes to 0, and at any dt no more than what stops m. m is a lower
    bound, that of the two rigid bodies without those that hang on them, so that it is stable.
    Tangential: Coulomb's, -μ F v_t / √(v_t² + v_c²) with v_c = 1 mm/s, bounded in the same way.

    Args:
        parameters: stiffness, damping and friction.
        depth: of one sphere in the other [m], negative apart.
        normal: unit vector from the other sphere's centre to that of this one.
        velocity: of this one relative to the other at the contact [m/s].
        mass: reduced mass of the two along the normal [kg].
        slip_mass: a lower bound of it across the normal [kg].
        dt: of the step [s].

    Returns:
        The force, in the frame of the arguments [N].
    """
    k = parameters.stiffness
    inwards = -dot(velocity, normal)
    fade = jnp.clip(depth / DAMPER_DEPTH, 0, 1)
    damper = (dt * k + 2 * parameters.damping * jnp.sqrt(k * mass)) * fade
    force = (k * depth + damper * inwards) / (1 + dt * damper / mass)
    force = jnp.where((depth > 0) & (force > 0), force, 0)
    slip = tuple(v + inwards * n for v, n in zip(velocity, normal, strict=True))
    grip = parameters.friction * force / jnp.sqrt(dot(slip, slip) + CREEP_SPEED**2)
    grip = grip / (1 + dt * grip / slip_mass)
    return tuple(force * n - grip * s for n, s in zip(normal, slip, strict=True))


class _Side(NamedTuple):
    """One sphere of each pair, `[n]` each, world frame.

    Attributes:
        center: of the sphere [m].
        origin: of the body's frame [m].
        mass_center: of the body [m].
        velocity: of the body's origin [m/s].
        angular_velocity: of the body [rad/s].
        axes: of the world in the body's frame.
        radius: [m].
        inverse_mass: [1/kg].
        inverse_inertia: [1/(kg m²)].
    """

    center: Vec
    origin: Vec
    mass_center: Vec
    velocity: Vec
    angular_velocity: Vec
    axes: tuple[Vec, Vec, Vec]
    radius: jax.Array
    inverse_mass: jax.Array
    inverse_inertia: jax.Array

    def velocity_at(self, point: Vec) -> Vec:
        """Velocity of the body at a point [m/s]."""
        return vadd(self.velocity, cross(self.angular_velocity, vsub(point, self.origin)))

    def inverse_at(self, point: Vec, normal: Vec) -> tuple[Scalar, Scalar]:
        """Upper bounds of the inverse mass along the normal, and across it [1/kg]."""
        arm = vsub(point, self.mass_center)
        lever = cross(arm, normal)
        along = self.inverse_mass + dot(lever, lever) * self.inverse_inertia
        return along, self.inverse_mass + dot(arm, arm) * self.inverse_inertia


def _depth(one: _Side, other: _Side) -> jax.Array:
    """Depth of spheres in each other [m]."""
    apart = vsub(one.center, other.center)
    return one.radius + other.radius - jnp.sqrt(dot(apart, apart) + _TINY**2)


def _collide(
    parameters: ContactParameters, one: _Side, other: _Side, share: jax.Array, dt: float
) -> Any:
    """Wrenches of spheres on the bodies of both, as `penalty_force` has them.

    `share` is that of the reduced mass which each contact may stop. Returns torque and force about
    the bodies' origins, their frames, six of `[n]` for each side.
    """
    apart = vsub(one.center, other.center)
    normal = vscale(1 / jnp.sqrt(dot(apart, apart) + _TINY**2), apart)
    depth = _depth(one, other)
    # The middle of the overlap, the same point for both, so that angular momentum is kept.
    point = vadd(other.center, vscale(other.radius - 0.5 * depth, normal))
    velocity = vsub(one.velocity_at(point), other.velocity_at(point))
    inverse = vadd(one.inverse_at(point, normal), other.inverse_at(point, normal))
    mass, slip_mass = (share / x for x in inverse)
    force = penalty_force(parameters, depth, normal, velocity, mass, slip_mass, dt)

    def wrench(side: _Side, force: Vec) -> tuple[Scalar, ...]:
        torque = cross(vsub(point, side.origin), force)
        return (*matTvec(side.axes, torque), *matTvec(side.axes, force))

    return wrench(one, force), wrench(other, tuple(-x for x in force))


class NeighbourList(NamedTuple):
    """Pairs of spheres that are near each other.

    Attributes:
        first: `[n]` int32 one sphere of each pair: its robot's slot times S and its number.
        second: `[n]` int32 the other one.
        pairs: number of pairs, int32.
        gap: least distance between the spheres of a pair when the list was made [m].
        close: `[lanes]` robots that have others close to them.
        moved: bound of how far any sphere of those has moved since then [m]; infinite before.
        strayed: the same bound for all robots.
    """

    first: jax.Array
    second: jax.Array
    pairs: jax.Array
    gap: jax.Array
    close: jax.Array
    moved: jax.Array
    strayed: jax.Array


class RobotInteraction(NamedTuple):
    """Interaction of the robots of one world, as functions of their state.

    Attributes:
        init: state → neighbours before the first step.
        detect: (state, neighbours) → (`InteractionForces`, neighbours).
    """

    init: Callable[[State], Any]
    detect: Callable[[State, Any], tuple[InteractionForces, Any]]


class InteractionForces(NamedTuple):
    """Forces between robots, and their nearest neighbours, at one moment.

    Attributes:
        wrench: torque [N·m] and force [N] about each body's origin, body frame: of the root, three
            of `[1, lanes]` each, and of the rows, three of `[rows, 1, lanes]` each; () without
            contact.
        nearest: from the core to that of the nearest other robot, world frame, three of `[lanes]`
            [m]; `NO_NEIGHBOUR` far without one. None where it is not needed.
        tag: of that robot, `[lanes]`; None where it is not needed.
    """

    wrench: Any = ()
    nearest: Any = None
    tag: Any = None


# Distance of the nearest robot where there is none [m].
NO_NEIGHBOUR = 1e3


def squared_distances(position: Vec, worlds: int, present: jax.Array) -> jax.Array:
    """Squared distances between the robots of each world.

    Args:
        position: of the cores, world frame, three of `[lanes]` [m].
        worlds: number of worlds, with equal numbers of slots.
        present: `[lanes]` whether a slot is taken.

    Returns:
        `[worlds, n, n]` [m²], infinite to itself and to empty slots.
    """
    own = tuple(x.reshape(worlds, -1) for x in position)
    there = present.reshape(worlds, -1)
    away = tuple(x[:, None, :] - x[:, :, None] for x in own)
    real = there[:, None, :] & there[:, :, None] & ~jnp.eye(there.shape[-1], dtype=bool)
    return jnp.where(real, dot(away, away), jnp.inf)


def nearest_robot(
    position: Vec, worlds: int, present: jax.Array, tag: jax.Array
) -> tuple[Vec, jax.Array]:
    """The nearest other robot of the same world, as a sensor of each robot sees it.

    Args:
        position: of the cores, world frame, three of `[lanes]` [m].
        worlds: number of worlds, with equal numbers of slots.
        present: `[lanes]` whether a slot is taken.
        tag: `[lanes]` of each robot.

    Returns:
        Three of `[lanes]` from the core to the other core, world frame [m], `NO_NEIGHBOUR` upwards
        without one; and its tag, 0 without one.
    """
    square = squared_distances(position, worlds, present)
    n = square.shape[-1]
    # Distances are symmetric; over the first of the two indices, XLA:CPU has vectors.
    least = jnp.min(square, 1)
    number = jnp.arange(n, dtype=jnp.int32)[None, :, None]
    which = jnp.min(jnp.where(square == least[:, None], number, n - 1), 1)
    which = (which + n * jnp.arange(worlds, dtype=jnp.int32)[:, None]).reshape(-1)
    found = jnp.isfinite(least).reshape(-1)
    lone = (0.0, 0.0, NO_NEIGHBOUR)
    toward = tuple(
        jnp.where(found, x[which] - x, far) for x, far in zip(position, lone, strict=True)
    )
    return toward, jnp.where(found, tag[which], 0)


def make_interaction(
    trees: BatchedTrees,
    spheres: Spheres,
    present: jax.Array,
    worlds: int = 1,
    contact: ContactParameters | None = None,
    tag: jax.Array | None = None,
) -> RobotInteraction:
    """The interaction of robots, as functions of their state.

    Under `jax.jit`, let the robots' tables and spheres be arguments, not constants: XLA:CPU aborts
    over constants here (see `numerics.xla`).

    Args:
        trees: the robots of all worlds, those of one behind those of another.
        spheres: of them, `[S, lanes]`.
        present: `[lanes]` whether a slot is taken; robots in empty slots have no effect.
        worlds: number of worlds, with equal numbers of slots.
        contact: parameters; None for robots that pass through each other.
        tag: `[lanes]` number that identifies the robot; None if no sensor reads the nearest one's.

    Returns:
        The functions. There are loops of unknown length in them: they have forward derivatives
        only.
    """
    found = None if contact is None else _Contact(trees, spheres, present, worlds, contact)

    def init(state: State) -> Any:
        return () if found is None else found.init(state)

    def detect(state: State, neighbours: Any) -> tuple[InteractionForces, Any]:
        wrench: Any = ()
        if found is not None:
            wrench, neighbours = found.wrench(state, neighbours)
        if tag is None:
            return InteractionForces(wrench), neighbours
        nearest = nearest_robot(state.position, worlds, present, tag)
        return InteractionForces(wrench, *nearest), neighbours

    return RobotInteraction(init, detect)


class _Contact:
    """Contact of robots; arguments as of `make_interaction`."""

    def __init__(
        self,
        trees: BatchedTrees,
        spheres: Spheres,
        present: jax.Array,
        worlds: int,
        parameters: ContactParameters,
    ) -> None:
        lanes = trees.lanes
        own = jax.tree.map(lambda x: jnp.broadcast_to(x, (*x.shape[:-1], lanes)), spheres)
        self.trees, self.own, self.present, self.worlds = trees, own, present, worlds
        self.parameters, self.dt, self.size = parameters, trees.world.timestep, own.row.shape[0]
        self.room = _ROOM * lanes
        # Of each sphere, robot after robot: the row of its body's frame, and its constants.
        lane = jnp.arange(lanes, dtype=jnp.int32)
        self.frame_of = (own.row * lanes + lane).T.reshape(-1)
        numbers = (*own.center, *own.mass_center, own.radius, own.inverse_mass, own.inverse_inertia)
        self.numbers = jnp.stack([x.T.reshape(-1) for x in numbers])
        far = jnp.sqrt(dot(own.center, own.center))
        count = trees.capacity.rows + 1
        # Largest distance of a body's spheres from its frame's origin.
        self.radius = jnp.zeros((count, lanes), far.dtype).at[own.row, lane].max(far)

    def init(self, state: State) -> NeighbourList:
        """No pairs, and infinite movement, so that the first step makes the list."""
        nothing = jnp.zeros(self.room + _FOUND, jnp.int32)
        moved = jnp.full((), jnp.inf, state.position[0].dtype)
        return NeighbourList(nothing, nothing, jnp.int32(0), moved, self.present, moved, moved)

    def wrench(self, state: State, neighbours: NeighbourList) -> tuple[Any, NeighbourList]:
        """Sum of all contacts, as `InteractionForces.wrench`, and the neighbours."""
        frames = frames_of(self.trees, state)
        stale = (neighbours.moved > _SKIN / 2) | (neighbours.strayed > _ROBOT_SKIN / 2)
        neighbours = jax.lax.cond(stale, lambda: self._find(frames, neighbours), lambda: neighbours)
        shape = self.radius.shape
        nothing = jnp.zeros((6, shape[0] * shape[1]), self.radius.dtype)
        total = jax.lax.cond(
            neighbours.gap < 2 * neighbours.moved,
            lambda: self._add_up(frames, neighbours, nothing),
            lambda: nothing,
        )
        parts = [total[k].reshape(shape) for k in range(6)]
        root, below = (tuple(x[:1] for x in parts), tuple(x[1:, None] for x in parts))
        speed = jnp.sqrt(dot(frames.velocity, frames.velocity))
        turning = jnp.sqrt(dot(frames.angular_velocity, frames.angular_velocity))
        speed = jnp.max(speed + self.radius * turning, 0)
        # Robots with a state that is not finite have no contact.
        way = jnp.where(self.present & jnp.isfinite(speed), _SPEED_MARGIN * self.dt * speed, 0)
        neighbours = neighbours._replace(
            moved=neighbours.moved + jnp.max(jnp.where(neighbours.close, way, 0)),
            strayed=neighbours.strayed + jnp.max(way),
        )
        return ((root[:3], root[3:]), (below[:3], below[3:])), neighbours

    # --- the neighbour list

    def _find(self, frames: Frames, neighbours: NeighbourList) -> NeighbourList:
        """A new list; where it has no room, one of spheres in contact, made at every step."""
        place, near, close = self._balls(frames)
        skin = jnp.asarray(_SKIN, self.radius.dtype)
        found, whole = self._spheres(place, near, skin, neighbours)
        zero, never = jnp.zeros_like(neighbours.moved), jnp.full_like(neighbours.moved, jnp.inf)
        found = found._replace(close=close, moved=zero, strayed=zero)

        def only_touching() -> NeighbourList:
            few, _ = self._spheres(place, near, jnp.zeros_like(skin), neighbours)
            return few._replace(close=close, moved=never, strayed=never)

        return jax.lax.cond(whole, lambda: found, only_touching)

    def _balls(self, frames: Frames) -> tuple[Vec, jax.Array, jax.Array]:
        """Positions of all spheres, pairs of robots that may touch, and robots with others close.

        Returns:
            `[S, lanes]` each, `[worlds, n, n]` and `[lanes]`.
        """
        own, n = self.own, self.trees.lanes // self.worlds
        pick = lambda x: jnp.take_along_axis(x, own.row, 0)  # noqa: E731
        axes = jax.tree.map(pick, frames.axes)
        place = vadd(jax.tree.map(pick, frames.position), matvec(axes, own.center))
        real = own.radius > 0
        # A ball around each robot in its present shape.
        count = jnp.maximum(jnp.sum(real, 0), 1)
        middle = tuple(jnp.sum(jnp.where(real, x, 0), 0) / count for x in place)
        away = vsub(place, middle)
        reach = jnp.max(jnp.where(real, jnp.sqrt(dot(away, away)) + own.radius, 0), 0)
        square, reach = squared_distances(middle, self.worlds, self.present), reach.reshape(-1, n)
        both = reach[:, :, None] + reach[:, None, :]
        close = jnp.any(square < (both + _ROBOT_SKIN) ** 2, 1).reshape(-1)
        return place, square < (both + _SKIN) ** 2, close

    def _spheres(
        self, place: Vec, near: jax.Array, skin: jax.Array, neighbours: NeighbourList
    ) -> tuple[NeighbourList, jax.Array]:
        """The pairs of spheres that are nearer than `skin`, and whether the list holds all."""
        lanes, n = self.trees.lanes, near.shape[-1]
        near = (near & jnp.triu(jnp.ones((n, n), bool), 1)).reshape(-1)
        number, end = jnp.arange(near.size, dtype=jnp.int32), jnp.int32(near.size)
        # Robot after robot, so that the spheres of one lie side by side. Padding never touches.
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
            after(jnp.int32(-1)), neighbours.first, neighbours.second, jnp.int32(0),
            jnp.bool_(True), jnp.full_like(neighbours.gap, jnp.inf),
        )  # fmt: skip
        _, first, second, total, whole, gap = jax.lax.while_loop(lambda x: x[0] < end, block, carry)
        return neighbours._replace(first=first, second=second, pairs=total, gap=gap), whole

    # --- forces

    def _add_up(self, frames: Frames, neighbours: NeighbourList, nothing: jax.Array) -> jax.Array:
        """`[6, rows + 1 × lanes]` wrenches on all bodies.

        Sums are products with matrices of zeros and ones: XLA:CPU makes a slow loop of a scatter,
        and other backends add in any order.
        """
        values = (
            *frames.position,
            *frames.velocity,
            *frames.angular_velocity,
            *sum(frames.axes, ()),
        )
        table = jnp.concatenate([x.reshape(-1) for x in values])
        each = jnp.arange(self.radius.size, dtype=jnp.int32)
        columns = self.radius.size * jnp.arange(len(values), dtype=jnp.int32)[:, None]

        def run(step: Callable[[jax.Array, Any], Any], carry: Any) -> Any:
            """Over the list, some at a time."""

            def body(state: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
                return state[0] + _PUSHED, step(*state)

            start = jnp.int32(0), carry
            return jax.lax.while_loop(lambda x: x[0] < neighbours.pairs, body, start)[1]

        def part(x: jax.Array, start: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice(x, (start,), (_PUSHED,))

        def sides(start: jax.Array) -> Any:
            which = [part(x, start) for x in (neighbours.first, neighbours.second)]
            own = [self.frame_of[x] for x in which]
            found = [
                _side(table[frame + columns], self.numbers[:, x])
                for frame, x in zip(own, which, strict=True)
            ]
            return found, own

        def touching_pairs(start: jax.Array, pairs: jax.Array) -> jax.Array:
            real = start + jnp.arange(_PUSHED, dtype=jnp.int32) < neighbours.pairs
            touching = real & (_depth(*sides(start)[0]) > 0)
            first, second = (
                part(x, start) // self.size for x in (neighbours.first, neighbours.second)
            )
            pair = jnp.where(touching, first * self.trees.lanes + second, -1)
            return jax.lax.dynamic_update_slice(pairs, pair, (start,))

        # The pair of robots of each pair of spheres in contact; -1 for others.
        pairs = run(touching_pairs, jnp.full(neighbours.first.shape[0] + _PUSHED, -1, jnp.int32))

        def push(start: jax.Array, total: jax.Array) -> jax.Array:
            pair = part(pairs, start)

            def collide() -> jax.Array:
                (one, other), own = sides(start)

                def count(begin: jax.Array, total: jax.Array) -> jax.Array:
                    same = pair[:, None] == part(pairs, begin)[None]
                    return total + jnp.sum(same, 1, dtype=total.dtype)

                # The contacts of two robots share the mass that may be stopped.
                share = _SHARE / jnp.maximum(run(count, jnp.zeros(_PUSHED, total.dtype)), 1)
                wrenches = _collide(self.parameters, one, other, share, self.dt)
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
    """The places of true flags `[n, m]`, row by row, at most so many.

    Returns:
        `[most]` rows and columns, int32, of which the first ones are valid; and the number of true
        flags.
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
