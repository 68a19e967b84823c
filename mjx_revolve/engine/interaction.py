"""Interaction of robots: contact between spheres, equal and opposite on both, and sight.

A batch holds one or several worlds with equal numbers of slots for robots. A neighbour list, the
pairs of spheres nearer than a skin, is made now and then and is valid until a sphere may have moved
by half of the skin (Verlet 1967, Physical Review 159); in between, only these pairs are tested.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.engine.batched_trees import BatchedTrees
from mjx_revolve.engine.contact import CREEP_SPEED, DAMPER_DEPTH
from mjx_revolve.engine.kinematics import body_motions
from mjx_revolve.engine.self_contact import append_true
from mjx_revolve.engine.spheres import Spheres
from mjx_revolve.engine.state import State
from mjx_revolve.numerics.spatial import (
    Scalar,
    Sym,
    Vec,
    cross,
    dot,
    matTvec,
    matvec,
    symvec,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.numerics.xla import fuse, take_lanes

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
# Room in the list for so many pairs of spheres per robot; more than most heaps have. A choice: four
# times as many cost a crowd a fifth to a third more, and a full list looks ahead by the step.
_ROOM = 64
# At most so many sweeps over all contacts, and what the last one may still change in the speed of
# any [m/s]. Choices: two plates that meet flat need six.
_SWEEPS, _ENOUGH = 16, 1e-3
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
        return Frames(axes, motion.position, velocity, angular)

    return fuse(find)(state._replace(qacc_prev=(), command=(), submerged=()))


def penalty_force(
    parameters: ContactParameters,
    depth: Scalar,
    normal: Vec,
    before: Vec,
    velocity: Vec,
    inverse: Callable[[Vec], tuple[Scalar, Scalar]],
    old: tuple[Scalar, Vec],
    dt: float,
) -> tuple[Scalar, Vec]:
    """Force on a sphere in contact with another, brought nearer to what the law asks for.

    Normal, with d the depth at the beginning of the step and v the speed inwards at its end:
    F = k d + (dt k + c) v ≥ 0, a spring at the end of the step and a damper, c critical damping of
    the reduced mass of the two rigid bodies, by themselves, along the normal. d may be negative:
    what would meet within the step is met. Tangential: Coulomb's, -μ F v_t / √(v_t² + v_c²) with
    v_c = 1 mm/s and the slip v_t at the end of the step, and never more than μ F.

    v follows from the forces of all contacts; each comes nearer to its own by what its bodies
    need, each of them split into equal pieces, one for each of its contacts: so that all contacts
    may move at once and none makes energy (Tonge, Benevolenski and Voroshilov 2012, Mass Splitting
    for Jitter-Free Parallel Rigid Body Simulation, § 4).

    Args:
        parameters: stiffness, damping and friction.
        depth: of one sphere in the other [m], negative apart.
        normal: unit vector from the other sphere's centre to that of this one.
        before: velocity of this one relative to the other at the contact, at the beginning of the
            step [m/s].
        velocity: the same at its end, as the forces so far make it.
        inverse: direction → inverse reduced mass of the two bodies along it, of the whole bodies
            and of the contact's pieces [1/kg].
        old: normal force [N] and friction so far.
        dt: of the step [s].

    Returns:
        Normal force [N], and friction, in the frame of the arguments [N].
    """
    k = parameters.stiffness
    ahead = depth - dt * dot(before, normal)
    whole, pieces = inverse(normal)
    damper = 2 * parameters.damping * jnp.sqrt(k / whole)
    damper = dt * k + damper * jnp.clip(ahead / DAMPER_DEPTH, 0, 1)
    inwards = -dot(velocity, normal)
    force, friction = old
    missing = k * depth + damper * inwards - force
    force = jnp.maximum(force + missing / (1 + dt * damper * pieces), 0)
    force = jnp.where(ahead > 0, force, 0)
    slip = tuple(v + inwards * n for v, n in zip(velocity, normal, strict=True))
    grip = parameters.friction * force / jnp.sqrt(dot(slip, slip) + CREEP_SPEED**2)
    change = tuple(-grip * s - f for s, f in zip(slip, friction, strict=True))
    # The larger square, not the larger root: that of 0 has no derivative.
    size = jnp.sqrt(jnp.maximum(dot(change, change), _TINY**2))
    _, pieces = inverse(vscale(1 / size, change))
    friction = vadd(friction, vscale(1 / (1 + dt * grip * pieces), change))
    size = jnp.sqrt(jnp.maximum(dot(friction, friction), _TINY**2))
    return force, vscale(jnp.minimum(parameters.friction * force / size, 1), friction)


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
        inverse_inertia: about the mass centre, body frame [1/(kg m²)].
        contacts: of the body, at least 1.
    """

    center: Vec
    origin: Vec
    mass_center: Vec
    velocity: Vec
    angular_velocity: Vec
    axes: tuple[Vec, Vec, Vec]
    radius: jax.Array
    inverse_mass: jax.Array
    inverse_inertia: Sym
    contacts: Scalar = 1.0

    def velocity_at(self, point: Vec) -> Vec:
        """Velocity of the body at a point [m/s]."""
        return vadd(self.velocity, cross(self.angular_velocity, vsub(point, self.origin)))

    def pushed(self, torque: Vec, force: Vec, time: float) -> _Side:
        """Its velocity after a wrench about the origin, body frame [N·m, N], for a time [s]."""
        torque, force = matvec(self.axes, torque), matvec(self.axes, force)
        arm = vsub(self.mass_center, self.origin)
        turned = self._lighten(vsub(torque, cross(arm, force)))
        gain = vsub(vscale(self.inverse_mass, force), cross(turned, arm))
        return self._replace(
            velocity=vadd(self.velocity, vscale(time, gain)),
            angular_velocity=vadd(self.angular_velocity, vscale(time, turned)),
        )

    def inverse_at(self, point: Vec, direction: Vec) -> Scalar:
        """Inverse mass at a point along a direction, of the body by itself [1/kg]."""
        lever = cross(vsub(point, self.mass_center), direction)
        return self.inverse_mass + dot(lever, self._lighten(lever))

    def _lighten(self, torque: Vec) -> Vec:
        """Angular acceleration by a torque, world frame [rad/s²]."""
        return matvec(self.axes, symvec(self.inverse_inertia, matTvec(self.axes, torque)))


def _depth(one: _Side, other: _Side) -> jax.Array:
    """Depth of spheres in each other [m]."""
    apart = vsub(one.center, other.center)
    return one.radius + other.radius - jnp.sqrt(dot(apart, apart) + _TINY**2)


def _closing(one: _Side, other: _Side) -> jax.Array:
    """Speed at which spheres come nearer [m/s]."""
    normal, point, _ = _contact(one, other)
    return -dot(normal, vsub(one.velocity_at(point), other.velocity_at(point)))


def _contact(one: _Side, other: _Side) -> tuple[Vec, Vec, jax.Array]:
    """Normal, point and depth of spheres in contact."""
    apart = vsub(one.center, other.center)
    normal = vscale(1 / jnp.sqrt(dot(apart, apart) + _TINY**2), apart)
    depth = _depth(one, other)
    # The middle of the overlap, the same point for both, so that angular momentum is kept.
    return normal, vadd(other.center, vscale(other.radius - 0.5 * depth, normal)), depth


def _collide(
    parameters: ContactParameters,
    sides: Sequence[_Side],
    felt: Sequence[Vec],
    old: jax.Array,
    dt: float,
) -> tuple[jax.Array, Any, jax.Array]:
    """Forces of contacts nearer to what `penalty_force` asks for.

    Args:
        parameters: of the contact.
        sides: both spheres of each pair.
        felt: the bodies' wrenches by all contacts so far, about their origins, own frames.
        old: `[4, n]` normal force and friction so far, world frame [N].
        dt: of the step [s].

    Returns:
        New forces, as `old`; their wrenches, torque and force, six of `[n]` for each side; and
        what the change of force is in speed of the contact, `[n]` [m/s].
    """
    normal, point, depth = _contact(*sides)
    pushed = [side.pushed(x[:3], x[3:], dt) for side, x in zip(sides, felt, strict=True)]
    before, velocity = (
        vsub(a.velocity_at(point), b.velocity_at(point)) for a, b in (sides, pushed)
    )

    def inverse(direction: Vec) -> tuple[Scalar, Scalar]:
        one, other = (side.inverse_at(point, direction) for side in sides)
        return one + other, sides[0].contacts * one + sides[1].contacts * other

    force, friction = penalty_force(
        parameters, depth, normal, before, velocity, inverse, (old[0], tuple(old[1:])), dt
    )
    new = jnp.stack([force, *friction])
    change = dt * inverse(normal)[0] * jnp.abs(force - old[0])
    push = vadd(vscale(force, normal), friction)

    def wrench(side: _Side, force: Vec) -> tuple[Scalar, ...]:
        torque = cross(vsub(point, side.origin), force)
        return (*matTvec(side.axes, torque), *matTvec(side.axes, force))

    return new, (wrench(sides[0], push), wrench(sides[1], tuple(-x for x in push))), change


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
        `[worlds, n, n]` [m²], infinite to itself, to empty slots and to robots that blew up.
    """
    own = tuple(x.reshape(worlds, -1) for x in position)
    there = present.reshape(worlds, -1)
    away = tuple(x[:, None, :] - x[:, :, None] for x in own)
    real = there[:, None, :] & there[:, :, None] & ~jnp.eye(there.shape[-1], dtype=bool)
    square = dot(away, away)
    return jnp.where(real & ~jnp.isnan(square), square, jnp.inf)


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
    found = None
    if contact is not None and len(spheres.radius):  # robots that touch nothing have none
        found = _Contact(trees, spheres, present, worlds, contact)

    def detect(state: State, neighbours: Any) -> tuple[InteractionForces, Any]:
        wrench: Any = ()
        if found is not None:
            wrench, neighbours = found.wrench(state, neighbours)
        if tag is None:
            return InteractionForces(wrench), neighbours
        nearest = nearest_robot(state.position, worlds, present, tag)
        return InteractionForces(wrench, *nearest), neighbours

    return RobotInteraction((lambda _: ()) if found is None else found.init, detect)


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
        numbers = (
            *own.center, *own.mass_center, own.radius, own.inverse_mass, *own.inverse_inertia
        )  # fmt: skip
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
        speed = jnp.sqrt(dot(frames.velocity, frames.velocity))
        turning = jnp.sqrt(dot(frames.angular_velocity, frames.angular_velocity))
        speed = jnp.max(speed + self.radius * turning, 0)
        # Robots with a state that is not finite have no contact.
        way = jnp.where(self.present & jnp.isfinite(speed), _SPEED_MARGIN * self.dt * speed, 0)

        def farthest(neighbours: NeighbourList) -> tuple[jax.Array, jax.Array]:
            """Bounds of movement until the end of this step."""
            moved = neighbours.moved + jnp.max(jnp.where(neighbours.close, way, 0))
            return moved, neighbours.strayed + jnp.max(way)

        moved, strayed = farthest(neighbours)
        stale = (moved > _SKIN / 2) | (strayed > _ROBOT_SKIN / 2)
        ahead = 2 * jnp.max(way)
        neighbours = jax.lax.cond(
            stale, lambda: self._find(frames, neighbours, ahead), lambda: neighbours
        )
        moved, strayed = farthest(neighbours)
        shape = self.radius.shape
        nothing = jnp.zeros((6, shape[0] * shape[1]), self.radius.dtype)
        total = jax.lax.cond(
            neighbours.gap < 2 * moved,
            lambda: self._add_up(frames, neighbours, nothing),
            lambda: nothing,
        )
        parts = [total[k].reshape(shape) for k in range(6)]
        root, below = (tuple(x[:1] for x in parts), tuple(x[1:, None] for x in parts))
        neighbours = neighbours._replace(moved=moved, strayed=strayed)
        return ((root[:3], root[3:]), (below[:3], below[3:])), neighbours

    # --- the neighbour list

    def _find(self, frames: Frames, neighbours: NeighbourList, ahead: jax.Array) -> NeighbourList:
        """A new list; where it has no room, one of what may meet in this step, made at every one.

        And where that has none, of what touches. `ahead` is the way by which two spheres may near
        each other in the step [m]; where it is more than the skin, the list looks as far.
        """
        # No farther than to robots that count as close: what blows up needs no list of all.
        usual = jnp.clip(ahead, _SKIN, _ROBOT_SKIN)
        place, near, close = self._balls(frames, usual)
        # Never less than the skin finds.
        skins = jnp.stack([usual, jnp.minimum(ahead, _SKIN), jnp.zeros_like(usual)])

        def attempt(carry: Any) -> Any:
            count, _, found = carry
            found, whole = self._spheres(place, near, skins[count], found, count == len(skins) - 1)
            return count + 1, whole, found

        start = jnp.int32(0), jnp.bool_(False), neighbours
        count, _, found = jax.lax.while_loop(lambda x: (x[0] < len(skins)) & ~x[1], attempt, start)
        moved = jnp.where(count == 1, 0, jnp.inf).astype(ahead.dtype)
        return found._replace(close=close, moved=moved, strayed=moved)

    def _balls(self, frames: Frames, skin: jax.Array) -> tuple[Vec, jax.Array, jax.Array]:
        """Positions of all spheres, pairs of robots that may touch, and robots with others close.

        Pairs of robots are those within a `skin` of each other.

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
        return place, square < (both + skin) ** 2, close

    def _spheres(
        self,
        place: Vec,
        near: jax.Array,
        skin: jax.Array,
        neighbours: NeighbourList,
        last: jax.Array,
    ) -> tuple[NeighbourList, jax.Array]:
        """The pairs of spheres that are nearer than `skin`, and whether the list holds all.

        A list that has no room for all is not used, and need not be finished, but for the `last`.
        """
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
                flags = close.reshape(-1)
                empty = jnp.zeros(len(flags) + 1, jnp.int32), jnp.int32(0)
                every = jnp.arange(len(flags), dtype=jnp.int32)
                listed, count = append_true(flags, every, empty, False)
                # Past the end of the flags there are no pairs, and past the list's none is read.
                listed = jnp.pad(listed, (0, max(0, _FOUND - len(listed))))[:_FOUND]
                row, column = listed // self.size, listed % self.size
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
        wanted = lambda x: (x[0] < end) & (x[4] | last)  # noqa: E731
        _, first, second, total, whole, gap = jax.lax.while_loop(wanted, block, carry)
        return neighbours._replace(first=first, second=second, pairs=total, gap=gap), whole

    # --- forces

    def _add_up(self, frames: Frames, neighbours: NeighbourList, nothing: jax.Array) -> jax.Array:
        """`[6, rows + 1 × lanes]` wrenches on all bodies.

        Sums are products with matrices of zeros and ones: XLA:CPU makes a slow loop of a scatter,
        and other backends add in any order.
        """
        moving = *frames.position, *frames.velocity, *frames.angular_velocity
        values = *moving, *sum(frames.axes, ())
        table = jnp.concatenate([x.reshape(-1) for x in values])
        each = jnp.arange(self.radius.size, dtype=jnp.int32)
        columns = self.radius.size * jnp.arange(len(values), dtype=jnp.int32)[:, None]

        def run(step: Callable[[jax.Array, Any], Any], carry: Any, pairs: jax.Array) -> Any:
            """Over a list of so many pairs, some at a time."""

            def body(state: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
                return state[0] + _PUSHED, step(*state)

            start = jnp.int32(0), carry
            return jax.lax.while_loop(lambda x: x[0] < pairs, body, start)[1]

        def part(x: jax.Array, start: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice(x, (start,), (_PUSHED,))

        def sides(pairs: Sequence[jax.Array], start: jax.Array) -> Any:
            which = [part(x, start) for x in pairs]
            own = [self.frame_of[x] for x in which]
            found = [
                _side(table[frame + columns], self.numbers[:, x])
                for frame, x in zip(own, which, strict=True)
            ]
            return found, own

        def spread(own: Any, values: jax.Array) -> jax.Array:
            """Sums over each body of `[n, 2 × pairs]`, the first sides' before the others'."""
            on = (jnp.concatenate(own)[:, None] == each).astype(values.dtype)
            return jnp.matmul(values, on, precision="highest")

        def look(start: jax.Array, found: Any) -> Any:
            """Pairs that touch by the end of the step, and the number of each body's."""
            flags, counts = found
            (one, other), own = sides(listed, start)
            real = start + jnp.arange(_PUSHED, dtype=jnp.int32) < neighbours.pairs
            touching = real & (_depth(one, other) + self.dt * _closing(one, other) > 0)
            number = jnp.tile(touching.astype(counts.dtype), 2)[None]
            some = jnp.any(touching)
            counts = jax.lax.cond(some, lambda: counts + spread(own, number), lambda: counts)
            return jax.lax.dynamic_update_slice(flags, touching, (start,)), counts

        listed = neighbours.first, neighbours.second
        room = neighbours.first.shape[0] + _PUSHED
        blank = jnp.zeros(room, bool), nothing[:1]
        touching, counts = run(look, blank, neighbours.pairs)
        # Sweeps go over those that touch alone: in a crowd most of the list does not.
        empty = jnp.zeros(room + 1, jnp.int32), jnp.int32(0)
        order, pairs = append_true(touching, jnp.arange(room, dtype=jnp.int32), empty, False)
        met = [take_lanes(x, jnp.minimum(order, len(x) - 1)) for x in listed]

        def sweep(now: Any) -> Any:
            """All contacts once, each with the velocities that the last sweep left."""
            count, forces, felt, _ = now

            def push(start: jax.Array, found: Any) -> Any:
                flags = start + jnp.arange(_PUSHED, dtype=jnp.int32) < pairs
                forces, total, most = found
                both, own = sides(met, start)
                both = [
                    side._replace(contacts=jnp.maximum(counts[0, k], 1))
                    for side, k in zip(both, own, strict=True)
                ]
                old = jax.lax.dynamic_slice(forces, (jnp.int32(0), start), (4, _PUSHED))
                on = [tuple(felt[:, k]) for k in own]
                new, wrenches, change = _collide(self.parameters, both, on, old, self.dt)
                wide = jnp.concatenate([jnp.stack(x) for x in wrenches], 1)
                wide = jnp.where(jnp.tile(flags, 2), wide, 0)
                new = jnp.where(flags, new, 0)
                forces = jax.lax.dynamic_update_slice(forces, new, (jnp.int32(0), start))
                most = jnp.maximum(most, jnp.max(jnp.where(flags, change, 0)))
                return forces, total + spread(own, wide), most

            none = forces, nothing, jnp.zeros_like(nothing[0, 0])
            return count + 1, *run(push, none, pairs)

        def wanted(now: Any) -> jax.Array:
            return (now[0] < _SWEEPS) & (now[3] > _ENOUGH)

        some = jnp.where(pairs > 0, jnp.inf, 0).astype(nothing.dtype)
        start = jnp.int32(0), jnp.zeros((4, room), nothing.dtype), nothing, some
        return jax.lax.while_loop(wanted, sweep, start)[2]


def _side(frame: jax.Array, numbers: jax.Array) -> _Side:
    """From `[18, n]` of frames and `[14, n]` of spheres."""
    f, x = frame, numbers
    axes = (tuple(f[9:12]), tuple(f[12:15]), tuple(f[15:18]))
    origin = tuple(f[:3])
    place = lambda local: vadd(origin, matvec(axes, tuple(local)))  # noqa: E731
    return _Side(
        place(x[:3]), origin, place(x[3:6]), tuple(f[3:6]), tuple(f[6:9]), axes,
        x[6], x[7], tuple(x[8:14]),
    )  # fmt: skip
