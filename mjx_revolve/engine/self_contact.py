"""Contact of a robot's own modules: impulses between boxes, on velocities, a step ahead.

A penalty spring that is stable at a step of 20 ms lets a servo press centimetres of one module into
another. So a contact is a condition on velocities, which looks ahead (as "speculative contacts" do;
cf. Stewart & Trinkle 1996, An implicit time-stepping scheme for rigid body dynamics with inelastic
collisions and Coulomb friction, IJNME 39): with g the gap at the end of the step of the motion
without contact, n its normal, λ ≥ 0 the forces along the normals and W = J M⁻¹ Jᵀ,

    g + dt² (W λ) ≥ 0,   complementary to λ ≥ 0.

Gaps are those of the boxes themselves, exactly (`numerics.boxes`). W is that of the articulated
bodies with all that is implicit in the step: forces go through the factors that the step has
already computed, backward and forward. J is that at the end of the step, as gaps are: within 20 ms
hinges turn by 6 degrees and contacts slide by millimetres. Forces act as torques of the hinges, so
that momentum is kept to rounding, and they stop what they meet and never push it apart: contact
takes energy. What overlaps already is parted no faster than it was approached.

Contact has no friction: modules are smooth and wet, they meet at low speed, and what evolution must
not find are bodies that pass through themselves; a second and third direction would cost three
times as much.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.kinematics import BodyFrames
from mjx_revolve.engine.meetings import Meetings
from mjx_revolve.numerics.boxes import (
    BoxPair,
    box_contact,
    dot,
    first_largest,
    matmul,
    matvec,
    weight,
)
from mjx_revolve.numerics.spatial import cross
from mjx_revolve.numerics.xla import fuse, materialize, on_cpu, take_lanes

# Contacts of one robot at a time. A choice: few robots have more.
_MOST = 8
# Robots that are tested together: loops last as long as the robot with the most pairs and contacts
# needs, so that 256 random bodies step a third faster by fours than by eights; one at a time is a
# third slower where all touch. Tables of one body need no copies: eights are a tenth faster there.
# Pairs of spheres, and of boxes, that are compared at a time: enough for vector registers. Choices.
_ROBOTS, _ALIKE, _SPHERES, _PAIRS = 4, 8, 32, 16
# Pairs that are near which are listed at a time, where loops need no known length. A choice.
_ROOM = 256
# Flags in a word.
_WORD = 32
# The clearance of robots without boxes that can meet [m].
_FAR = 1e3
# What no contact needs, and what stands for the need of those that push already [m/s²].
_NONE, _KEPT = -1e9, 1e9
# Overlap that is tolerated [m]: that at rest, at least and at most so much; with 1.5 mm, what is
# wedged between two others was pressed into one of them. The share of the rest that is removed in a
# step, and the top speed of that [m/s]. Choices.
_SLOP, _AT_REST, _SHARE, _TOP = 5e-4, 2e-3, 1.0, 1.0
# Rounds in which contacts are looked for, and by how much those of one round must turn a hinge for
# a further one [rad]. Choices: 0.2 degrees move the end of a limb by .3 mm.
_ROUNDS, _TURN = 3, 0.003
# Sweeps over the forces of several contacts, and the error at which they end [m]. Choices: one
# sweep is exact for one contact.
_SWEEPS, _ENOUGH = 30, 2e-5
# Added to the inverse mass of a contact [1/kg], so that what is wedged between two modules has
# finite forces. A choice: as if 500 kg gave way, where modules have some tens of grams.
_SOFTNESS = 0.002


# Torques of hinges `[nhinge, lanes]` [N·m] → accelerations `[6 + nhinge, lanes]` of the root, first
# linear, and of the hinges.
Respond = Callable[[jax.Array], jax.Array]


class Robots(NamedTuple):
    """Some of the robots.

    Attributes:
        steps: `[nhinge, lanes]` by which hinges turn in the step without contact [rad].
        hurry: `[nhinge, lanes]` their accelerations in it [rad/s²].
        drift: `[lanes]` by how much boxes may near each other by these [m].
        pose: what hinges turn by → `kinematics.body_frames`.
        carried: sums of values `[1 + nhinge, lanes]` of bodies over all that each hinge carries,
            `[nhinge, lanes]`.
        make_respond: what makes their response to torques.
    """

    steps: jax.Array
    hurry: jax.Array
    drift: jax.Array
    pose: Callable[[jax.Array], tuple[BodyFrames, BodyFrames]]
    carried: Callable[[list[jax.Array]], list[jax.Array]]
    make_respond: Callable[[], Respond]


def contact_acceleration(
    meetings: Meetings,
    clearance: jax.Array,
    touched: jax.Array,
    look_at: Callable[[jax.Array], Robots],
    rows: int,
    dt: float,
    felt: int = 0,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Accelerations of robots by contacts of their own modules.

    Only robots are looked at that have used up their clearance, a few at a time. On other back ends
    than the CPU a kernel takes as long for one robot as for all: there all are, when one has.

    Args:
        meetings: which boxes can meet.
        clearance: `[lanes]` least distance by which boxes stay apart at the end of the step [m];
            negative where that is not known.
        touched: `[lanes]` whether they did not stay apart before. Those that did not are looked at
            together: a few robots take as long as the one with the most contacts.
        look_at: which lanes, int32 → the robots in them.
        rows: of a response.
        dt: of the step [s].
        felt: rows of the forces that sensors feel, see `State.pressed`.

    Returns:
        As a response; the clearance as it is known then; and the forces that are felt.
    """
    lanes, dtype, steady = len(clearance), clearance.dtype, meetings.steady
    wanted = (clearance < 0) & (meetings.count > 0)
    size = min(_ROBOTS if meetings.lanes > 1 else _ALIKE, lanes)
    most = -(-lanes // size)
    # One array: XLA:CPU aborts over a loop of which a part is not used, as the clearance would be
    # where a caller returns positions only.
    rest = jnp.zeros((rows + felt, lanes), dtype)
    start = jnp.concatenate([rest[:rows], clearance[None], rest[rows:]])

    def look() -> Any:
        room = jnp.zeros(most * size + 1, jnp.int32), jnp.int32(0)
        every = jnp.arange(lanes, dtype=jnp.int32)
        first = append_true(wanted & touched, every, room, steady)
        listed, count = append_true(wanted & ~touched, every, first, steady)

        def visit(k: Any, found: Any) -> Any:
            which = jax.lax.dynamic_slice(listed, (k * size,), (size,))
            real = k * size + jnp.arange(size, dtype=jnp.int32) < count
            solved = _settle(meetings, which, real, look_at(which), rows, dt, felt)
            return _put(found, solved, which, real)

        return _repeat(-(-count // size), most, visit, start, steady)

    def look_at_all() -> Any:
        which = jnp.arange(lanes, dtype=jnp.int32)
        solved = _settle(meetings, which, wanted, look_at(which), rows, dt, felt)
        return jnp.where(wanted, solved, start)

    found: jax.Array = jax.lax.cond(
        any_lane(wanted), fuse(look) if on_cpu() else look_at_all, lambda: start
    )
    return found[:rows], found[rows], found[rows + 1 :]


def _settle(
    meetings: Meetings,
    which: jax.Array,
    real: jax.Array,
    robots: Robots,
    rows: int,
    dt: float,
    felt: int,
) -> jax.Array:
    """Accelerations of some robots by their contacts, the clearance without them, forces felt.

    In rounds: contacts are first looked for where bodies would be at unchanged speeds, which is
    where they stay if they press; where they end up elsewhere, further ones are looked for there,
    and join those that push.
    """
    size, steps = len(which), robots.steps
    bodies = 1 + len(steps)
    halves = felt > bodies
    find = _find_contacts if on_cpu() else _find_at_once
    zeros = lambda *shape: jnp.zeros((*shape, size), steps.dtype)  # noqa: E731
    none = _Contacts(
        zeros(_MOST),
        zeros(len(steps), _MOST),
        zeros(_MOST, _MOST),
        zeros(_MOST, rows),
        zeros(_MOST),
        zeros(_MOST, 4 if halves else 2) if felt else None,
    )

    def look_again(now: Any) -> Any:
        contacts, clear, moving, first = now
        change = contacts.acceleration()[6:] - first * robots.hurry
        # Within a loop only what is fused by itself is computed once.
        frames = fuse(robots.pose, inline=True)(steps + dt**2 * change)
        kept = weight(contacts.force > 0, clear)
        drift = first * robots.drift
        table = find(meetings, which, moving > 0, frames, kept, drift, dt, halves)
        near = (table.need > -drift / dt**2) & (table.need < _KEPT)
        touches = _largest(weight(near, kept)) > 0

        def resolve() -> Any:
            found = contacts.join(table, frames[1], robots, change, dt, meetings.steady)
            turned = _largest(jnp.abs(found.acceleration()[6:] - change))
            return found, weight(dt**2 * turned > _TURN, clear)

        found, moving = jax.lax.cond(
            any_lane(touches), resolve, lambda: (contacts, jnp.zeros_like(moving))
        )
        clear = first * (table.clear - drift) + (1 - first) * clear
        return found, clear, moving, jnp.zeros_like(first)

    start = none, zeros(), weight(real, steps), jnp.ones_like(steps[0])
    contacts, clear, *_ = _while_any(2, _ROUNDS, look_again, start, meetings.steady)
    found = [contacts.acceleration(), clear[None]]
    if contacts.ends is not None:
        row = jnp.arange(felt, dtype=steps.dtype)[:, None]
        # Halves of modules stand behind the bodies.
        ends = [contacts.ends[:, k] + bodies * (k > 1) for k in range(contacts.ends.shape[1])]
        at = lambda k: _sum([weight(row == x[k], steps) for x in ends])  # noqa: E731
        found.append(_sum([contacts.force[k] * at(k) for k in range(_MOST)]))
    return jnp.concatenate(found)


def _put(into: jax.Array, columns: jax.Array, which: jax.Array, real: jax.Array) -> jax.Array:
    """`[n, lanes]` with `[n, few]` columns in place of the real ones of some lanes."""

    def write(j: Any, into: jax.Array) -> jax.Array:
        place = jnp.int32(0), which[j]
        old = jax.lax.dynamic_slice(into, place, (len(into), 1))
        new = jax.lax.dynamic_slice(columns, (jnp.int32(0), j), (len(into), 1))
        return jax.lax.dynamic_update_slice(into, jnp.where(real[j], new, old), place)

    return _loop(len(which), write, into)


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


def _while_any(
    going: int, most: int, body: Callable[[Any], Any], carry: tuple[Any, ...], steady: bool
) -> Any:
    """At most so many rounds, as long as any lane goes on: this part of the carry is positive."""
    if steady or on_cpu():

        def step(_: Any, carry: Any) -> Any:
            return jax.lax.cond(any_lane(carry[going] > 0), body, lambda x: x, carry)

        return _loop(most, step, carry)
    # The host waits for each condition: there are no more of them than rounds.
    wanted = lambda x: (x[0] < most) & any_lane(x[1][going] > 0)  # noqa: E731
    return jax.lax.while_loop(wanted, lambda x: (x[0] + 1, body(x[1])), (0, carry))[1]


def append_true(flags: jax.Array, values: jax.Array, found: Any, steady: bool) -> Any:
    """A list with room for one more, and its length, with the values `[n]` where flags are set.

    `steady` loops have a known length, so that they have derivatives.
    """
    if not on_cpu():  # where a loop over flags would be a kernel for each
        listed, count = found
        ends = count + jnp.cumsum(flags, dtype=jnp.int32)
        places = jnp.where(flags, ends - 1, len(listed))
        return listed.at[places].set(values, mode="drop"), ends[-1]

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


def _find_contacts(
    meetings: Meetings,
    which: jax.Array,
    real: jax.Array,
    poses: tuple[BodyFrames, BodyFrames],
    kept: jax.Array,
    drift: jax.Array,
    dt: float,
    halves: bool,
) -> ContactTable:
    """Contacts of some robots: pairs with bounding spheres that may overlap when the step ends.

    None take the places `[_MOST, lanes]` that are 1 in `kept`; boxes are where they end but for a
    `drift` of `[lanes]` [m]. `halves`: which halves of modules are in contact is found, too.
    """
    size, dtype, steady = len(which), kept.dtype, meetings.steady
    npair, lanes = meetings.first.shape
    width = size * max(1, _SPHERES // size)
    most = -(-npair * size // width)
    numbers = [jnp.asarray(x, dtype).reshape(-1) for x in jax.tree.leaves(poses)]
    frames, shapes = materialize(jnp.stack(numbers)), meetings.shapes
    pick = lambda x, k: materialize(take_lanes(x, k))  # noqa: E731
    body = jnp.asarray(meetings.body, jnp.int32)
    cells = (
        jnp.asarray(meetings.halves.T, dtype) if halves and meetings.halves is not None else None
    )
    ahead = frames[12:].reshape(12, -1, size)
    spheres = _spheres(meetings, which, ahead)
    pairs = [jnp.asarray(x, jnp.int32).reshape(-1) for x in (meetings.first, meetings.second)]
    at_rest = jnp.asarray(meetings.rest, dtype).reshape(-1)

    def flat(k: jax.Array, lane: jax.Array, lanes: int) -> jax.Array:
        return k if lanes == 1 else k * lanes + take_lanes(which, lane)

    def look_up(number: jax.Array) -> tuple[_Given, ...]:
        """The two boxes of pairs, numbered by place among the robot's pairs · size + robot."""
        lane = number % size
        found = []
        for every in pairs:
            shell = take_lanes(every, flat(number // size, lane, lanes))
            place = flat(shell, lane, meetings.lanes)
            found.append(_Given(shell, take_lanes(body, shell), place, lane))
        return tuple(found)

    def gather(carry: Any) -> Any:
        """The next spheres."""
        block, listed, clear = carry
        number = block * width + jnp.arange(width, dtype=jnp.int32)
        one, other = look_up(jnp.minimum(number, npair * size - 1))
        start, end = (pick(spheres, box.shell * size + box.lane) for box in (one, other))
        away, reach = end[:3] - start[:3], start[3] + end[3]
        given = take_lanes(real, one.lane) & (one.shell != other.shell) & (number < npair * size)
        square = dot(away, away)
        near = given & (square < (reach + take_lanes(drift, one.lane)) ** 2)
        # Of a pair that stands for none the root has a gradient, too, and it must be finite.
        apart = jnp.where(given & ~near, jnp.sqrt(jnp.maximum(square, 1e-30)) - reach, _FAR)
        for k in range(0, width, size):
            clear = jnp.minimum(clear, apart[k : k + size])
        return block + 1, append_true(near, number, listed, steady), clear

    def examine(listed: Any, table: ContactTable) -> ContactTable:
        """The contacts of listed pairs join those of each robot; the weakest give way."""
        numbers, count = listed

        def measure(k: Any, table: ContactTable) -> ContactTable:
            number = jax.lax.dynamic_slice(numbers, (k * _PAIRS,), (_PAIRS,))
            given = look_up(number)
            rest = take_lanes(at_rest, flat(number // size, number % size, lanes))
            shown = tuple(
                (pick(frames, x.body * size + x.lane), pick(shapes[:-1], x.number)) for x in given
            )
            need, gap, *units = _measure(shown, rest, dt)
            found = [*(x.body.astype(dtype) for x in given), *units]
            if cells is not None:
                tables = [pick(cells, x.shell) for x in given]
                ahead = [frame[12:] for frame, _ in shown]
                found += [_half(*x, units[3:]) for x in zip(tables, ahead, strict=True)]
            numbers_of = jnp.stack(found)
            left = count - k * _PAIRS
            if steady:
                listed = jnp.arange(_PAIRS, dtype=jnp.int32) < left
                need, gap = jnp.where(listed, need, _NONE), jnp.where(listed, gap, _FAR)
            left = _PAIRS if steady else jnp.minimum(left, _PAIRS)
            return _insert(table, left, (need, gap, numbers_of), given[0].lane)

        return _repeat(-(-count // _PAIRS), -(-npair * size // _PAIRS), measure, table, steady)

    clear = jnp.full(size, _FAR, dtype)
    table = ContactTable(
        _NONE + (_KEPT - _NONE) * kept,
        jnp.zeros((_MOST + 1, 10 if halves else 8, size), dtype),
        clear,
    )
    room = most * width if steady else min(most * width, _ROOM)
    start = jnp.zeros(room + max(width, _PAIRS), jnp.int32), jnp.int32(0)
    if steady:
        _, listed, clear = _loop(most, lambda _, x: gather(x), (jnp.int32(0), start, clear))
        table = examine(listed, table)
    else:
        count = jnp.int32(0)
        for k in range(size):
            own = meetings.count[0] if lanes == 1 else meetings.count[which[k]]
            count = jnp.maximum(count, jnp.where(real[k], own, 0))
        blocks = -(-count * size // width)

        def more(carry: Any) -> Any:
            """The next blocks, until the list is full."""
            block, clear, table = carry
            wanted = lambda x: (x[0] < blocks) & (x[1][1] + width <= room)  # noqa: E731
            block, listed, clear = jax.lax.while_loop(wanted, gather, (block, start, clear))
            return block, clear, examine(listed, table)

        _, clear, table = jax.lax.while_loop(
            lambda x: x[0] < blocks, more, (jnp.int32(0), clear, table)
        )
    return table._replace(clear=jnp.minimum(clear, table.clear))


def _find_at_once(
    meetings: Meetings,
    _: jax.Array,
    real: jax.Array,
    poses: tuple[BodyFrames, BodyFrames],
    kept: jax.Array,
    _drift: jax.Array,
    dt: float,
    halves: bool,
) -> ContactTable:
    """As `_find_contacts`, of all robots: all their pairs are measured side by side."""
    size, dtype = kept.shape[-1], kept.dtype
    frames = jnp.stack([jnp.asarray(x, dtype) for x in jax.tree.leaves(poses)])
    shapes = meetings.shapes[:-1].reshape(-1, len(meetings.body), meetings.lanes)
    body, npair = jnp.asarray(meetings.body, jnp.int32), len(meetings.first)
    pairs = [
        jnp.broadcast_to(jnp.asarray(x, jnp.int32), (npair, size))
        for x in (meetings.first, meetings.second)
    ]

    def pick(table: jax.Array, row: jax.Array) -> jax.Array:
        """`[n, npair size]` of `[n, rows, lanes or 1]`."""
        wide = jnp.broadcast_to(table, (*table.shape[:2], size))
        return jnp.take_along_axis(wide, row[None], 1).reshape(len(table), -1)

    shown = tuple((pick(frames, body[x]), pick(shapes, x)) for x in pairs)
    at_rest = jnp.broadcast_to(jnp.asarray(meetings.rest, dtype), (npair, size)).reshape(-1)
    need, gap, *units = _measure(shown, at_rest, dt)
    found = [*(body[x].reshape(-1).astype(dtype) for x in pairs), *units]
    if halves:
        none = np.zeros((len(meetings.body), 5)) if meetings.halves is None else meetings.halves
        cells = jnp.asarray(none.T, dtype)[..., None]
        for x, (frame, _shape) in zip(pairs, shown, strict=True):
            found.append(_half(pick(cells, x), frame[12:], units[3:]))
    there = real & (pairs[0] != pairs[1])
    need = jnp.where(there, need.reshape(npair, size), _NONE)
    gap = jnp.where(there, gap.reshape(npair, size), _FAR)
    # The contacts that need most, in the places that are not kept.
    rank = jnp.cumsum(1 - kept, 0).astype(jnp.int32) - 1
    rank = jnp.pad(rank, ((0, 1), (0, 0)), constant_values=npair)
    free = jnp.pad(1 - kept, ((0, 1), (0, 0))) * weight(rank < npair, kept)
    order = jnp.argsort(-need, axis=0)
    chosen = jnp.take_along_axis(order, jnp.clip(rank, 0, npair - 1), 0)
    rest = jnp.stack(found).reshape(-1, npair, size)
    rest = jnp.moveaxis(jnp.take_along_axis(rest, chosen[None], 1), 0, 1) * free[:, None]
    need = jnp.where(free > 0, jnp.take_along_axis(need, chosen, 0), _NONE)[:_MOST]
    return ContactTable(jnp.where(kept > 0, _KEPT, need), rest, gap.min(0))


def _spheres(meetings: Meetings, which: jax.Array, ahead: jax.Array) -> jax.Array:
    """`[4, nshell few]` middles of some robots' bounding spheres, root's frame, and radii [m].

    `ahead`: `[12, nbody, few]` the numbers of `BodyFrames`.
    """
    body, lanes = meetings.body, meetings.lanes
    shapes = meetings.shapes.reshape(-1, len(body), lanes)
    own = shapes if lanes == 1 else take_lanes(shapes, which)
    # Boxes stand in runs of the bodies that follow each other: slices are copied by vectors.
    starts = [0, *(1 + np.flatnonzero(np.diff(body) != 1)), len(body)]
    runs = [ahead[:, body[i] : body[i] + j - i] for i, j in pairwise(starts)]
    frames = jnp.concatenate(runs, 1)
    middle = frames[9:] + matvec(frames[:9].reshape(3, 3, len(body), -1), own[:3])
    radius = jnp.broadcast_to(own[-1:], middle[:1].shape)
    return materialize(jnp.concatenate([middle, radius]).reshape(4, -1))


class ContactTable(NamedTuple):
    """Contacts of robots.

    Attributes:
        need: `[_MOST, lanes]` the acceleration along the normal that each needs [m/s²]; not
            positive where boxes stay apart unless other contacts push them together.
        rest: `[_MOST + 1, 8, lanes]` the numbers of both bodies, the normal and the point at the
            end of the step, root's frame [-, m]; the last contact is none. Where they are felt
            there are two further rows, of the halves of modules: 2 module, 1 more to the right.
        clear: `[lanes]` how far at least boxes are apart at the step's end [m].
    """

    need: jax.Array
    rest: jax.Array
    clear: jax.Array


class _Given(NamedTuple):
    """One box of each pair, `[n]` int32 each.

    Attributes:
        shell: it.
        body: its body.
        number: of its shape.
        lane: its robot.
    """

    shell: jax.Array
    body: jax.Array
    number: jax.Array
    lane: jax.Array


def _placed(frames: jax.Array, shape: jax.Array) -> list[tuple[jax.Array, jax.Array]]:
    """Rotation and centre of boxes now and ahead, from numbers of `Bodies` and of `Boxes`."""
    mat, found = lambda x: x.reshape(3, 3, x.shape[-1]), []
    for k in (0, 12):
        turn, position = mat(frames[k : k + 9]), frames[k + 9 : k + 12]
        own = matmul(turn, mat(shape[3:12])) if len(shape) > 6 else turn
        found.append((own, position + matvec(turn, shape[:3])))
    return found


def _measure(given: tuple[tuple[jax.Array, jax.Array], ...], at_rest: jax.Array, dt: float) -> Any:
    """What pairs need, their gaps, normals and points; see `ContactTable`."""

    def compute(given: Any, at_rest: jax.Array) -> Any:
        halves = [shape[-3:] for _, shape in given]
        boxes = list(zip(*(_placed(*x) for x in given), strict=True))
        pair, later = (
            BoxPair(other[1] - one[1], one[0], other[0], *halves) for one, other in boxes
        )
        contact = box_contact(pair, later)
        closing = jnp.maximum(contact.start - contact.gap, 0)
        tolerated = jnp.clip(at_rest, _SLOP, _AT_REST)
        parted = jnp.clip(-_SHARE * (contact.start + tolerated), 0, dt * _TOP)
        target = jnp.minimum(contact.start, 0) + jnp.minimum(parted, closing)
        need = (target - contact.gap) / dt**2
        point = boxes[1][0][1] + contact.point
        return need, contact.gap, *contact.normal, *point

    return fuse(compute)(given, at_rest)


def _half(cells: jax.Array, ahead: jax.Array, point: list[jax.Array]) -> jax.Array:
    """Which halves of modules points are at; see `ContactTable` and `Meetings.halves`."""
    way = matvec(ahead[:9].reshape(3, 3, -1), tuple(cells[1:4]))
    aside = dot(way, tuple(x - p for x, p in zip(point, ahead[9:], strict=True)))
    return 2 * cells[0] + weight(aside > cells[4], aside)


def _insert(
    table: ContactTable, count: Any, found: tuple[jax.Array, ...], lane: jax.Array
) -> ContactTable:
    """So many contacts of such lanes, each in place of its robot's weakest one so far."""
    need, gap, rest = found

    def one(j: Any, table: ContactTable) -> ContactTable:
        zero, own = jnp.int32(0), lane[j]
        needs = jax.lax.dynamic_slice(table.need, (zero, own), (_MOST, 1))[:, 0]
        slot, least = zero, needs[0]
        for k in range(1, _MOST):
            weaker = needs[k] < least
            slot, least = jnp.where(weaker, k, slot), jnp.where(weaker, needs[k], least)
        slot = slot.astype(jnp.int32)
        most = jnp.maximum(need[j], least).reshape(1, 1)
        new = jax.lax.dynamic_slice(rest, (zero, j), (len(rest), 1))[None]
        clear = jnp.minimum(table.clear[own], gap[j]).reshape(1)
        # What is not read is written where it stands; what is too weak, behind the others.
        place = jnp.where(need[j] > least, slot, _MOST), zero, own
        return ContactTable(
            jax.lax.dynamic_update_slice(table.need, most, (slot, own)),
            jax.lax.dynamic_update_slice(table.rest, new, place),
            jax.lax.dynamic_update_slice(table.clear, clear, (own,)),
        )

    return _loop(count, one, table)


# ------------------------------------------------------------------ forces


class _Contacts(NamedTuple):
    """Contacts of some robots.

    Attributes:
        need: `[_MOST, lanes]` acceleration along the normal by all contacts that each needs
            [m/s²]; not positive: no contact.
        levers: `[nhinge, _MOST, lanes]` how fast a hinge's turning parts the boxes at the end of
            the step [m/rad]: a unit force along the normal is such a torque at the hinge.
        columns: `[_MOST, _MOST, lanes]` of W, of the contacts that take part.
        moved: `[_MOST, rows, lanes]` the responses to unit forces of these.
        force: `[_MOST, lanes]` [N].
        ends: `[_MOST, 2 or 4, lanes]` numbers of both bodies, and of both halves of modules, see
            `ContactTable`; None where they are not felt.
    """

    need: jax.Array
    levers: jax.Array
    columns: jax.Array
    moved: jax.Array
    force: jax.Array
    ends: jax.Array | None

    def acceleration(self) -> jax.Array:
        """By all contacts, a response."""
        return _sum([self.force[k] * self.moved[k] for k in range(_MOST)])

    def join(
        self,
        table: ContactTable,
        ahead: BodyFrames,
        robots: Robots,
        change: jax.Array,
        dt: float,
        steady: bool,
    ) -> _Contacts:
        """Those that push, with those of a table in the other places, solved.

        `change` are the accelerations by which hinges end where the table's contacts are.
        """
        numbers = table.rest[:_MOST]

        def find_levers(numbers: jax.Array, ahead: BodyFrames) -> jax.Array:
            number = jnp.arange(len(ahead.position[0]), dtype=numbers.dtype)[:, None]
            ends = lambda x: weight(number == x[1], x) - weight(number == x[0], x)  # noqa: E731
            signs = robots.carried([ends(numbers[k]) for k in range(_MOST)])
            axis = tuple(row[2][1:] for row in ahead.rotation)
            found = []
            for k in range(_MOST):
                normal, point = numbers[k, 2:5], numbers[k, 5:8]
                arm = tuple(x - p[1:] for x, p in zip(point, ahead.position, strict=True))
                found.append(signs[k] * dot(axis, cross(arm, tuple(normal))))
            return jnp.stack(found, 1)

        kept = weight(self.force > 0, self.force)
        new = fuse(find_levers, inline=True)(numbers, ahead)
        levers = materialize(kept * self.levers + (1 - kept) * new)
        every = [levers[k] for k in range(len(levers))]
        along = lambda hinges: _sum([hinges[k] * x for k, x in enumerate(every)])  # noqa: E731
        # Contact does no work: boxes part no faster than they met.
        most = 2 * jnp.maximum(-along(robots.steps), 0) / dt**2
        # By as much as they near each other in the step, too, which levers at its end do not say of
        # what turns: `_measure` asks for no more.
        most = jnp.maximum(most, table.need)
        need = kept * self.need + (1 - kept) * jnp.minimum(table.need + along(change), most)
        moved = kept[:, None] * self.moved
        columns = _sum([moved[:, 6 + k][:, None] * x for k, x in enumerate(every)])
        columns = kept[:, None] * (columns + _SOFTNESS * _unit(self.force))
        bodies = self.ends
        if bodies is not None:
            own = jnp.concatenate([numbers[:, :2], numbers[:, 8:]], 1)
            bodies = kept[:, None] * bodies + (1 - kept[:, None]) * own
        contacts = _Contacts(need, levers, columns, moved, kept * self.force, bodies)
        return contacts.solve(robots.make_respond(), dt, steady)

    def solve(self, respond: Respond, dt: float, steady: bool) -> _Contacts:
        """With the forces of all contacts.

        Contacts take part one after the other, the one that misses most first: a column of W is
        the response to its unit force. Those that take part are solved by projected Gauss-Seidel
        (cf. Cottle, Pang and Stone 1992, The Linear Complementarity Problem, chapter 5), which is
        exact for one contact, and in which each step lessens ½ λᵀ W λ - λᵀ need, and with it the
        energy. A robot that is done stays as it is, whatever its neighbours in the batch need.
        """
        lanes = self.need.shape[-1]
        levers = [self.levers[k] for k in range(len(self.levers))]

        def sweep(columns: jax.Array, inverse: jax.Array, now: Any) -> Any:
            old, moving = now
            force, most = [], jnp.zeros(lanes, old.dtype)
            missing = self.need - _sum([columns[j] * old[j] for j in range(_MOST)])
            for k in range(_MOST):
                change = jnp.maximum(old[k] + missing[k] * inverse[k], 0) - old[k]
                force.append(old[k] + moving * change)
                missing = missing - columns[k] * (moving * change)
                most = jnp.maximum(most, moving * jnp.abs(change) * columns[k, k])
            return jnp.stack(force), moving * weight(most * dt**2 > _ENOUGH, most)

        def settle(force: jax.Array, columns: jax.Array, moving: jax.Array) -> jax.Array:
            diagonal = _diagonal(columns)
            taken = weight(diagonal > 0, diagonal)
            inverse = taken / (diagonal + 1 - taken)
            step = fuse(lambda now: sweep(columns, inverse, now), inline=True)
            return _while_any(1, _SWEEPS, step, (force, moving), steady)[0]

        def join(now: Any) -> Any:
            """One contact more of each robot that misses any."""
            force, columns, moved, missing, wanting = now
            worst, _ = first_largest([missing[k] for k in range(_MOST)])
            chosen = jnp.stack(worst) * wanting
            torque = [_sum([chosen[k] * x[k] for k in range(_MOST)]) for x in levers]
            change = respond(jnp.stack(torque))
            own = _sum([change[6 + k] * x for k, x in enumerate(levers)]) + _SOFTNESS * chosen
            columns = (1 - chosen[:, None]) * columns + chosen[:, None] * own
            moved = (1 - chosen[:, None]) * moved + chosen[:, None] * change
            force = settle(force, columns, wanting)
            return force, columns, moved, *self._missing(force, columns, dt)

        missing = self._missing(self.force, self.columns, dt)
        start = self.force, self.columns, self.moved, *missing
        step = fuse(join, inline=True)
        force, columns, moved, *_ = _while_any(-1, _MOST, step, start, steady)
        return self._replace(force=force, columns=columns, moved=moved)

    def _missing(
        self, force: jax.Array, columns: jax.Array, dt: float
    ) -> tuple[jax.Array, jax.Array]:
        """What contacts miss that do not take part [m/s²]; `[lanes]` 1 where any misses much."""
        missing = self.need - _sum([columns[j] * force[j] for j in range(_MOST)])
        taken = weight(_diagonal(columns) > 0, force)
        missing = (1 - taken) * missing + taken * _NONE
        worst = _largest(missing)
        return missing, weight(worst * dt**2 > _ENOUGH, worst)


def _unit(like: jax.Array) -> jax.Array:
    """The unit matrix, `[_MOST, _MOST, 1]`."""
    place = jnp.arange(_MOST, dtype=jnp.int32)
    return weight(place[:, None, None] == place[None, :, None], like)


def _diagonal(columns: jax.Array) -> jax.Array:
    return jnp.stack([columns[k, k] for k in range(_MOST)])


def _sum(xs: list[jax.Array]) -> jax.Array:
    """Written out, as a fused step has no reductions."""
    return reduce(jnp.add, xs)


def _largest(rows: jax.Array) -> jax.Array:
    """The largest over the first axis, written out, too."""
    return reduce(jnp.maximum, [rows[k] for k in range(len(rows))])
