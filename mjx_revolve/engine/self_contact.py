"""Contact of a robot's own modules: impulses between boxes, on velocities, a step ahead.

A penalty spring that is stable at a step of 20 ms lets a servo press centimetres of one module into
another. So a contact is a condition on velocities, which looks ahead (as "speculative contacts" do;
cf. Stewart & Trinkle 1996, An implicit time-stepping scheme for rigid body dynamics with inelastic
collisions and Coulomb friction, IJNME 39): with g the gap at the end of the step of the motion
without contact, n its normal, λ ≥ 0 the forces along the normals and W = J M⁻¹ Jᵀ,

    g + dt² (W λ) ≥ 0,   complementary to λ ≥ 0.

Gaps are those of the boxes themselves, exactly (`numerics.boxes`). W is that of the articulated
bodies with all that is implicit in the step: forces go through the factors that the step has
already computed, backward and forward. They act in pairs at one point, so that momentum is kept to
rounding, and they stop what they meet and never push it apart: contact takes energy. What overlaps
already is parted no faster than it was approached.

Contact has no friction: modules are smooth and wet, they meet at low speed, and what evolution must
not find are bodies that pass through themselves; a second and third direction would cost three
times as much.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.engine.kinematics import BodyFrames
from mjx_revolve.engine.meetings import Boxes, Meetings
from mjx_revolve.numerics.boxes import BoxPair, box_contact, last_of, weight
from mjx_revolve.numerics.spatial import (
    Mat,
    Scalar,
    Vec,
    cross,
    dot,
    matmul,
    matTvec,
    matvec,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.numerics.xla import fuse, materialize, take_lanes

# Contacts of one robot at a time. A choice: few robots have more.
_MOST = 8
# Pairs that are tested exactly at a time, and robots with contacts solved together: enough
# for vector registers. Few robots of a chunk have contacts at a time. Choices.
_PAIRS, _ROBOTS = 32, 8
# Pairs that are near which are listed at a time, where robots differ. A choice.
_ROOM = 2048
# Flags in a word.
_WORD = 32
# What no contact needs [m/s²].
_NONE = -1e9
# Overlap that is tolerated [m], the share of the rest that is removed in a step, and the top speed
# of that [m/s]. Choices.
_SLOP, _SHARE, _TOP = 5e-4, 1.0, 1.0
# Sweeps over the forces of several contacts, and the error at which they end [m]. Choices: one
# sweep is exact for one contact.
_SWEEPS, _ENOUGH = 30, 2e-5
# Added to the inverse mass of a contact [1/kg], so that what is wedged between two modules has
# finite forces. A choice: as if 50 kg gave way, where modules have some tens of grams.
_SOFTNESS = 0.02


class Bodies(NamedTuple):
    """Rigid bodies of robots, as `kinematics.body_frames` returns them.

    Attributes:
        now: their poses.
        ahead: at the end of the step without contact.
    """

    now: BodyFrames
    ahead: BodyFrames


class Acceleration(NamedTuple):
    """What forces do to robots.

    Attributes:
        bodies: angular and linear acceleration of all bodies, own frames, six of `[nbody, lanes]`.
        robot: `[6 + nhinge, lanes]` of the root, linear and angular, and of the hinges.
    """

    bodies: tuple[Scalar, ...]
    robot: jax.Array


# Torques [N·m] and forces [N] about the bodies' origins, own frames, six of `[nbody, lanes]` →
# accelerations.
Respond = Callable[[tuple[jax.Array, ...]], Acceleration]


def contact_acceleration(
    meetings: Meetings,
    bodies: Bodies,
    respond_at: Callable[[jax.Array], Respond],
    dt: float,
) -> tuple[jax.Array, jax.Array]:
    """Accelerations of robots by contacts of their own modules.

    Args:
        meetings: which boxes can meet.
        bodies: of the robots.
        respond_at: which lanes, int32 → their responses to forces.
        dt: of the step [s].

    Returns:
        As `Acceleration.robot`; and, where robots are alike, `State.clearance`.
    """
    nbody, lanes = bodies.now.position[0].shape
    nothing = jnp.zeros((6 + nbody - 1, lanes), bodies.now.position[0].dtype)
    look_up, gather = _make_search(meetings, bodies)
    blocks, width = meetings.first.shape
    room = blocks * width if meetings.steady else min(blocks * width, _ROOM)
    start = jnp.zeros(room + max(width, _PAIRS), jnp.int32), jnp.int32(0)
    clear = jnp.full(width, 1e3, nothing.dtype)
    table = ContactTable(
        jnp.full((_MOST, lanes), _NONE, nothing.dtype),
        jnp.zeros((_MOST + 1, 14, lanes), nothing.dtype),
    )

    def measure(listed: Any, table: ContactTable) -> ContactTable:
        return _measure_all(listed, look_up, table, dt, meetings.steady)

    def resolve(table: ContactTable) -> jax.Array:
        lane = jnp.arange(lanes, dtype=jnp.int32)
        size = min(_ROBOTS, lanes)
        most = -(-lanes // size)
        start = jnp.zeros(most * size + 1, jnp.int32), jnp.int32(0)
        touches = table.need[0] > 0
        for k in range(1, _MOST):
            touches = touches | (table.need[k] > 0)
        touching, count = _append(touches, lane, start, meetings.steady)

        def solve(k: Any, total: jax.Array) -> jax.Array:
            which = jax.lax.dynamic_slice(touching, (k * size,), (size,))
            real = k * size + jnp.arange(size, dtype=jnp.int32) < count
            own: ContactTable = jax.tree.map(lambda x: take_lanes(x, which), table)
            contacts = _Contacts(own, real, nbody, dt)
            found = contacts.solve(respond_at(which), len(total))

            def write(j: Any, total: jax.Array) -> jax.Array:
                place = jnp.int32(0), which[j]
                old = jax.lax.dynamic_slice(total, place, (len(total), 1))
                new = jax.lax.dynamic_slice(found, (jnp.int32(0), j), (len(total), 1))
                return jax.lax.dynamic_update_slice(total, jnp.where(real[j], new, old), place)

            return _loop(size, write, total)

        return _repeat(-(-count // size), most, solve, nothing, meetings.steady)

    if meetings.steady:
        _, listed, clear = _loop(
            meetings.count, lambda _, x: gather(x), (jnp.int32(0), start, clear)
        )
        found = jax.lax.cond(
            listed[1] > 0, lambda: resolve(measure(listed, table)), lambda: nothing
        )
        return found, clear

    def more(carry: Any) -> Any:
        """The next blocks, until the list is full."""
        block, clear, table = carry
        wanted = lambda x: (x[0] < meetings.count) & (x[1][1] + width <= room)  # noqa: E731
        block, listed, clear = jax.lax.while_loop(wanted, gather, (block, start, clear))
        return block, clear, measure(listed, table)

    _, clear, table = jax.lax.while_loop(
        lambda x: x[0] < meetings.count, more, (jnp.int32(0), clear, table)
    )
    return resolve(table), clear


def _loop(count: Any, body: Callable[[jax.Array, Any], Any], carry: Any) -> Any:
    """`fori_loop` from 0 with a counter of 32 bits in either mode."""
    return jax.lax.fori_loop(0, count, lambda k, x: body(jnp.asarray(k, jnp.int32), x), carry)


def _repeat(count: Any, most: int, body: Any, carry: Any, steady: bool) -> Any:
    """A loop of `count` rounds; of known length, so that it has derivatives, where it must be."""
    if not steady:
        return _loop(count, body, carry)

    def step(k: Any, carry: Any) -> Any:
        return jax.lax.cond(k < count, lambda x: body(k, x), lambda x: x, carry)

    return _loop(most, step, carry)


def _append(flags: jax.Array, values: jax.Array, found: Any, steady: bool) -> Any:
    """A list with room for one more, and its length, with the values `[n]` where flags are set."""

    def write(k: Any, found: Any) -> Any:
        new = jax.lax.dynamic_slice(values, (k,), (1,))
        return jax.lax.dynamic_update_slice(found[0], new, (found[1],))

    if steady:
        every = lambda k, x: (write(k, x), x[1] + flags[k].astype(jnp.int32))  # noqa: E731
        return jax.lax.cond(any_lane(flags), lambda: _loop(len(flags), every, found), lambda: found)

    words = _pack_bits(flags)
    count = len(words)

    def step(carry: Any) -> Any:
        """To the next word, or the next set bit of this one."""
        k, word, *found = carry
        done = word == 0
        bit = jax.lax.population_count((word & -word) - 1)
        place = jnp.where(done, 0, _WORD * k + bit)
        found = write(place, found), found[1] + (1 - done.astype(jnp.int32))
        after = jax.lax.dynamic_slice(words, (jnp.minimum(k + 1, count - 1),), (1,))[0]
        return jnp.where(done, k + 1, k), jnp.where(done, after, word & (word - 1)), *found

    return jax.lax.while_loop(lambda x: x[0] < count, step, (jnp.int32(0), words[0], *found))[2:]


def _pack_bits(flags: jax.Array) -> jax.Array:
    """`[n / 32]` int32 of `[n]`: bit j of word k is flag 32 k + j."""
    count = -(-len(flags) // _WORD)
    bits = jnp.pad(flags.astype(jnp.int32), (0, count * _WORD - len(flags)))
    bits = bits.reshape(count, _WORD)
    words = bits[:, 0]
    for j in range(1, _WORD):
        words = words | (bits[:, j] << j)
    return words


def any_lane(found: jax.Array) -> jax.Array:
    """Whether any of `[n]` is set; by halves, as a fused step has no reductions."""
    while found.shape[0] > 1:
        middle = found.shape[0] // 2
        tail = found[2 * middle :]
        found = jnp.concatenate([found[:middle] | found[middle : 2 * middle], tail])
    return found[0]


# ------------------------------------------------------------------ pairs in contact


def _make_search(meetings: Meetings, bodies: Bodies) -> tuple[Any, Any]:
    """Pairs with bounding spheres that overlap at the end of the step.

    Returns:
        A function: numbers of pairs → their two boxes. And one that looks at the next block:
        (block, (numbers of such pairs, how many there are), the spheres' clearance `[width]`).
    """
    lanes, dtype = bodies.now.position[0].shape[-1], bodies.now.position[0].dtype
    body = jnp.asarray(meetings.body, jnp.int32)
    boxes = meetings.boxes
    bodies = jax.tree.map(materialize, bodies)
    center = meetings.centers(bodies.ahead.position, bodies.ahead.rotation)
    center = tuple(x.reshape(-1) for x in center)
    radius = jnp.sqrt(dot(boxes.half_size, boxes.half_size)).reshape(-1)
    frames, shells = jax.tree.map(lambda x: x.reshape(-1), (bodies, boxes))
    pick = lambda xs, k: jax.tree.map(lambda x: take_lanes(x, k), xs)  # noqa: E731
    alike = boxes.half_size[0].shape[-1] == 1
    shape_of = (lambda k: k // lanes) if alike else (lambda k: k)
    width = meetings.first.shape[1]
    blocks = tuple(map(jnp.asarray, (meetings.first, meetings.second)))
    every = tuple(x.reshape(-1) for x in blocks)

    def look_up(pair: jax.Array) -> tuple[_Given, ...]:
        found = []
        for number in every:
            which = take_lanes(number, pair)
            own = take_lanes(body, which // lanes)
            frame = own * lanes + which % lanes
            found.append(
                _Given(
                    own.astype(dtype),
                    pick(frames, frame),
                    pick(shells, shape_of(which)),
                    which % lanes,
                )
            )
        return tuple(found)

    def gather(carry: Any) -> Any:
        block, listed, clear = carry
        pair = tuple(jax.lax.dynamic_index_in_dim(x, block, 0, False) for x in blocks)
        away = tuple(take_lanes(x, pair[1]) - take_lanes(x, pair[0]) for x in center)
        reach = sum(take_lanes(radius, shape_of(x)) for x in pair)
        real, square = pair[0] != pair[1], dot(away, away)
        near = real & (square < reach * reach)
        number = block * width + jnp.arange(width, dtype=jnp.int32)
        if alike:
            clear = jnp.where(real, jnp.minimum(clear, jnp.sqrt(square) - reach), clear)
        return block + 1, _append(near, number, listed, meetings.steady), clear

    return look_up, gather


def _measure_all(
    listed: Any, look_up: Any, table: ContactTable, dt: float, steady: bool
) -> ContactTable:
    """The contacts of listed pairs join those of each robot; the weakest give way."""
    numbers, count = listed

    def examine(k: Any, table: ContactTable) -> ContactTable:
        pair = jax.lax.dynamic_slice(numbers, (k * _PAIRS,), (_PAIRS,))
        given = look_up(pair)
        need, *rest = _measure(given, dt)
        need = jnp.where(k * _PAIRS + jnp.arange(_PAIRS, dtype=jnp.int32) < count, need, _NONE)
        return _insert(table, need, jnp.stack(rest), given[0].lane)

    most = -(-(len(numbers) - 1) // _PAIRS)
    return _repeat(-(-count // _PAIRS), most, examine, table, steady)


class ContactTable(NamedTuple):
    """Contacts of robots.

    Attributes:
        need: `[_MOST, lanes]` the acceleration along the normal that each needs [m/s²]; not
            positive where boxes stay apart unless other contacts push them together.
        rest: `[_MOST + 1, 14, lanes]` the numbers of both bodies, and torque and force of a unit
            force on each, own frames; the last contact is none.
    """

    need: jax.Array
    rest: jax.Array


class _Given(NamedTuple):
    """One box of each pair, `[n]` each.

    Attributes:
        number: of its body.
        body: that body.
        box: on it.
        lane: its robot.
    """

    number: jax.Array
    body: Bodies
    box: Boxes
    lane: jax.Array


def _measure(given: tuple[_Given, ...], dt: float) -> list[jax.Array]:
    """What pairs need, and the 14 other numbers of them; see `ContactTable`."""

    def pose(frame: BodyFrames, box: Boxes) -> tuple[Vec, Mat]:
        """Centres and rotations of boxes."""
        center = vadd(frame.position, matvec(frame.rotation, box.position))
        if box.rotation is None:
            return center, frame.rotation
        return center, matmul(frame.rotation, box.rotation)

    def compute(given: Any) -> Any:
        (one, box), (other, second) = given
        sides = [tuple(pose(x, shape) for x in body) for body, shape in given]
        half = box.half_size, second.half_size
        pair, later = (
            BoxPair(vsub(y[0], x[0]), x[1], y[1], *half) for x, y in zip(*sides, strict=True)
        )
        contact = box_contact(pair, later)
        closing = jnp.maximum(contact.start - contact.gap, 0)
        parted = jnp.clip(-_SHARE * (contact.start + _SLOP), 0, dt * _TOP)
        target = jnp.minimum(contact.start, 0) + jnp.minimum(parted, closing)
        need = (target - contact.gap) / dt**2
        point = vadd(sides[0][0][0], contact.point)
        arms = [matTvec(x.now.rotation, vsub(point, x.now.position)) for x in (one, other)]
        # Where the point ends that is fixed to each body.
        ends = [
            vadd(x.ahead.position, matvec(x.ahead.rotation, arm))
            for x, arm in zip((one, other), arms, strict=True)
        ]
        speed = dot(contact.normal, vsub(ends[1], ends[0])) / dt
        # Normals turn within the step; so that no work is done, boxes part no faster than they met.
        need = jnp.minimum(need, 2 * jnp.maximum(-speed, 0) / dt)
        units = []
        for x, arm, sign in zip((one, other), arms, (-1.0, 1.0), strict=True):
            push = vscale(sign, matTvec(x.now.rotation, contact.normal))
            units += [*cross(arm, push), *push]
        return need, *units

    need, *units = fuse(compute)(tuple(x[1:3] for x in given))
    return [need, *(x.number for x in given), *units]


def _insert(table: ContactTable, need: jax.Array, rest: jax.Array, lane: jax.Array) -> ContactTable:
    """Contacts of such lanes, each in place of its robot's weakest one so far."""

    def one(j: Any, table: ContactTable) -> ContactTable:
        zero, own = jnp.int32(0), lane[j]
        needs = jax.lax.dynamic_slice(table.need, (zero, own), (_MOST, 1))[:, 0]
        slot, least = zero, needs[0]
        for k in range(1, _MOST):
            weaker = needs[k] < least
            slot, least = jnp.where(weaker, k, slot), jnp.where(weaker, needs[k], least)
        slot = slot.astype(jnp.int32)
        most = jnp.maximum(need[j], least).reshape(1, 1)
        new = jax.lax.dynamic_slice(rest, (zero, j), (14, 1))[None]
        # What is not read is written where it stands; what is too weak, behind the others.
        place = jnp.where(need[j] > least, slot, _MOST), zero, own
        return ContactTable(
            jax.lax.dynamic_update_slice(table.need, most, (slot, own)),
            jax.lax.dynamic_update_slice(table.rest, new, place),
        )

    return _loop(len(lane), one, table)


# ------------------------------------------------------------------ forces


class _Contacts:
    """Contacts of some robots, `[k, lanes]` each.

    Attributes:
        need: acceleration along the normal that each needs [m/s²]; not positive: no contact.
        bodies: numbers of the two bodies.
        unit: torque and force of a unit force on each.
    """

    def __init__(self, table: ContactTable, real: jax.Array, count: int, dt: float) -> None:
        rows = [table.rest[:_MOST, k] for k in range(14)]
        self.count, self.dt = count, dt
        self.need = jnp.where(real, table.need, _NONE)
        self.bodies = tuple(x.astype(jnp.int32) for x in rows[:2])
        self.unit = rows[2:8], rows[8:14]

    def _spread(self, force: jax.Array) -> tuple[jax.Array, ...]:
        """Torque and force on all bodies of forces along the normals, six of `[nbody, lanes]`."""
        number = jnp.arange(self.count, dtype=jnp.int32)[:, None]
        found = [jnp.zeros((self.count, force.shape[-1]), force.dtype)] * 6
        for body, unit in zip(self.bodies, self.unit, strict=True):
            for k in range(len(force)):
                own = weight(number == body[k], force) * force[k]
                found = [x + own * y[k] for x, y in zip(found, unit, strict=True)]
        return tuple(found)

    def _gather(self, acceleration: tuple[jax.Array, ...]) -> jax.Array:
        """Acceleration of the contacts along their normals `[k, lanes]`."""
        total = jnp.zeros_like(self.need)
        for body, unit in zip(self.bodies, self.unit, strict=True):
            for x, y in zip(acceleration, unit, strict=True):
                total = total + jnp.take_along_axis(x, body, 0, mode="promise_in_bounds") * y
        return total

    def solve(self, respond: Respond, rows: int) -> jax.Array:
        """The accelerations by all contacts, `Acceleration.robot` of so many rows.

        Contacts take part one after the other, the one that misses most first: a column of W is
        the response to its unit force. Those that take part are solved by projected Gauss-Seidel
        (cf. Cottle, Pang and Stone 1992, The Linear Complementarity Problem, chapter 5), which is
        exact for one contact, and in which each step lessens ½ λᵀ W λ - λᵀ need, and with it the
        energy. A robot that is done stays as it is, whatever its neighbours in the batch need.
        """
        lanes = self.need.shape[-1]

        def sweep(columns: jax.Array, inverse: jax.Array, now: Any) -> Any:
            old, moving = now
            force, most = [old[k] for k in range(_MOST)], jnp.zeros(lanes, old.dtype)
            for k in range(_MOST):
                missing = self.need[k] - _sum([columns[j, k] * x for j, x in enumerate(force)])
                new = jnp.maximum(force[k] + missing * inverse[k], 0)
                force[k] = force[k] + moving * (new - force[k])
                most = jnp.maximum(most, jnp.abs(force[k] - old[k]) * columns[k, k])
            return jnp.stack(force), moving * weight(most * self.dt**2 > _ENOUGH, most)

        def settle(force: jax.Array, columns: jax.Array, moving: jax.Array) -> jax.Array:
            diagonal = jnp.stack([columns[k, k] for k in range(_MOST)])
            taken = weight(diagonal > 0, diagonal)
            inverse = taken / (diagonal + 1 - taken)
            step = fuse(lambda now: sweep(columns, inverse, now), inline=True)

            def end(_: Any, now: Any) -> Any:
                return jax.lax.cond(any_lane(now[1] > 0), step, lambda x: x, now)

            found: jax.Array = _loop(_SWEEPS, end, (force, moving))[0]
            return found

        def join(now: Any) -> Any:
            """One contact more of each robot that misses any."""
            force, columns, moved, missing, wanting = now
            worst, better = missing[0], []
            for k in range(1, _MOST):
                better.append(weight(missing[k] > worst, worst))
                worst = jnp.maximum(worst, missing[k])
            chosen = jnp.stack(last_of(better)) * wanting
            change = respond(self._spread(chosen))
            own = self._gather(change.bodies) + _SOFTNESS * chosen
            columns = (1 - chosen[:, None]) * columns + chosen[:, None] * own
            moved = (1 - chosen[:, None]) * moved + chosen[:, None] * change.robot
            force = settle(force, columns, wanting)
            return force, columns, moved, *self._missing(force, columns)

        def step(_: Any, now: Any) -> Any:
            return jax.lax.cond(any_lane(now[-1] > 0), fuse(join, inline=True), lambda x: x, now)

        force = jnp.zeros_like(self.need)
        columns = jnp.zeros((_MOST, *force.shape), force.dtype)
        moved = jnp.zeros((_MOST, rows, lanes), force.dtype)
        start = force, columns, moved, *self._missing(force, columns)
        force, _, moved, *_ = _loop(_MOST, step, start)
        return _sum([force[k] * moved[k] for k in range(_MOST)])

    def _missing(self, force: jax.Array, columns: jax.Array) -> tuple[jax.Array, jax.Array]:
        """What contacts miss that do not take part [m/s²]; `[lanes]` 1 where any misses much."""
        missing, worst = [], jnp.full_like(force[0], _NONE)
        for k in range(_MOST):
            own = self.need[k] - _sum([columns[j, k] * force[j] for j in range(_MOST)])
            taken = weight(columns[k, k] > 0, own)
            missing.append((1 - taken) * own + taken * _NONE)
            worst = jnp.maximum(worst, missing[k])
        return jnp.stack(missing), weight(worst * self.dt**2 > _ENOUGH, worst)


def _sum(xs: list[jax.Array]) -> jax.Array:
    """Written out, as a fused step has no reductions."""
    total = xs[0]
    for x in xs[1:]:
        total = total + x
    return total
