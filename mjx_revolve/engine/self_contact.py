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
from functools import partial, reduce
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
from mjx_revolve.numerics.spatial import Vec, cross
from mjx_revolve.numerics.xla import fuse, materialize, on_cpu, split_arrays, take_lanes

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
    values: Any,
    look_at: Callable[[Any, jax.Array | None], Robots],
    rows: int,
    dt: float,
    felt: int = 0,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Accelerations of robots by contacts of their own modules.

    Its derivatives are those of the contacts that push, see `_differentiable_response`: which ones
    do has none.

    Args:
        meetings: which boxes can meet.
        clearance: `[lanes]` least distance by which boxes stay apart at the end of the step [m];
            negative where that is not known.
        touched: `[lanes]` whether they did not stay apart before. Those that did not are looked at
            together: a few robots take as long as the one with the most contacts.
        values: what `look_at` reads. Its arrays have derivatives; a `SingleTree` has none.
        look_at: (such values, which lanes, int32, None: all) → the robots in them.
        rows: of a response.
        dt: of the step [s].
        felt: rows of the forces that sensors feel, see `State.pressed`.

    Returns:
        As a response; the clearance as it is known then; and the forces that are felt.
    """
    # A function with a derivative of its own takes all arrays that it reads.
    arrays, fill = split_arrays((meetings, values))

    def search(listed: bool, arrays: Any, clearance: jax.Array, touched: jax.Array) -> jax.Array:
        pairs, own = fill(arrays)
        robots = partial(look_at, own)
        return _search(pairs, clearance, touched, robots, rows, dt, felt, listed)

    solve = jax.custom_jvp(partial(search, False))

    @solve.defjvp
    def differentiate(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
        found = search(True, *jax.lax.stop_gradient(primals))
        found, contacts = found[: rows + 1 + felt], found[rows + 1 + felt :]

        def respond(arrays: Any) -> jax.Array:
            pairs, own = fill(arrays)
            return _differentiable_response(pairs, look_at(own, None), contacts, dt, felt)

        _, change = jax.jvp(respond, primals[:1], tangents[:1])
        still = jnp.zeros_like(found[:1])
        return found, jnp.concatenate([change[:rows], still, change[rows:]])

    found = solve(arrays, clearance, touched)
    return found[:rows], found[rows], found[rows + 1 :]


def _search(
    meetings: Meetings,
    clearance: jax.Array,
    touched: jax.Array,
    look_at: Callable[[jax.Array], Robots],
    rows: int,
    dt: float,
    felt: int,
    listed: bool,
) -> jax.Array:
    """Contacts' accelerations, the clearance as it is known then, and the forces that are felt.

    Only robots are looked at that have used up their clearance, a few at a time. On other back ends
    than the CPU a kernel takes as long for one robot as for all: there all are, when one has.
    If `listed`, `[_ROUNDS (2 _MOST + 1), lanes]` follow: forces and pairs of the contacts after
    each round, and whether it was the first one.
    """
    lanes, dtype, steady = len(clearance), clearance.dtype, meetings.steady
    wanted = (clearance < 0) & (meetings.count > 0)
    size = min(_ROBOTS if meetings.lanes > 1 else _ALIKE, lanes)
    most = -(-lanes // size)
    # One array: XLA:CPU aborts over a loop of which a part is not used, as the clearance would be
    # where a caller returns positions only.
    more = felt + _ROUNDS * (2 * _MOST + 1) * listed
    rest = jnp.zeros((rows + more, lanes), dtype)
    start = jnp.concatenate([rest[:rows], clearance[None], rest[rows:]])

    def look() -> Any:
        room = jnp.zeros(most * size + 1, jnp.int32), jnp.int32(0)
        every = jnp.arange(lanes, dtype=jnp.int32)
        first = append_true(wanted & touched, every, room, steady)
        order, count = append_true(wanted & ~touched, every, first, steady)

        def visit(k: Any, found: Any) -> Any:
            which = jax.lax.dynamic_slice(order, (k * size,), (size,))
            real = k * size + jnp.arange(size, dtype=jnp.int32) < count
            solved = _settle(meetings, which, real, look_at(which), rows, dt, felt, listed)
            return _put(found, solved, which, real)

        return _repeat(-(-count // size), most, visit, start, steady)

    def look_at_all() -> Any:
        which = jnp.arange(lanes, dtype=jnp.int32)
        solved = _settle(meetings, which, wanted, look_at(which), rows, dt, felt, listed)
        return jnp.where(wanted, solved, start)

    see = fuse(look) if on_cpu() else look_at_all
    found: jax.Array = jax.lax.cond(any_lane(wanted), see, lambda: start)
    return found


def _settle(
    meetings: Meetings,
    which: jax.Array,
    real: jax.Array,
    robots: Robots,
    rows: int,
    dt: float,
    felt: int,
    listed: bool,
) -> jax.Array:
    """Accelerations of some robots by their contacts, the clearance without them, forces felt.

    If `listed`, what the rounds found, too, see `_search`.

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
        zeros(_MOST) if listed else None,
    )

    def look_again(now: Any) -> Any:
        contacts, clear, moving, first, rounds = now
        change = contacts.acceleration()[6:] - first * robots.hurry
        # Within a loop only what is fused by itself is computed once.
        frames = fuse(robots.pose, inline=True)(steps + dt**2 * change)
        kept = weight(contacts.force > 0, clear)
        drift = first * robots.drift
        table = find(meetings, which, moving > 0, frames, kept, drift, dt, halves, listed)
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
        if listed:  # the last round stands last, and those before it begin with none
            assert found.pairs is not None
            own = jnp.concatenate([found.force, found.pairs, first[None]])
            rounds = jnp.concatenate([rounds[1:], own[None]])
        return found, clear, moving, jnp.zeros_like(first), rounds

    rounds = zeros(_ROUNDS, 2 * _MOST + 1) if listed else ()
    start = none, zeros(), weight(real, steps), jnp.ones_like(steps[0]), rounds
    contacts, clear, *_, rounds = _while_any(2, _ROUNDS, look_again, start, meetings.steady)
    found = [contacts.acceleration(), clear[None]]
    if contacts.ends is not None:
        # Halves of modules stand behind the bodies.
        ends = [contacts.ends[:, k] + bodies * (k > 1) for k in range(contacts.ends.shape[1])]
        found.append(_felt(contacts.force, ends, felt))
    if listed:
        found.append(rounds.reshape(-1, size))
    return jnp.concatenate(found)


def _felt(force: jax.Array, ends: list[jax.Array], felt: int) -> jax.Array:
    """`[felt, lanes]` forces of contacts, at what is pressed: rows of `[_MOST, lanes]` each."""
    row = jnp.arange(felt, dtype=force.dtype)[:, None]
    at = lambda k: _sum([weight(row == x[k], force) for x in ends])  # noqa: E731
    return _sum([force[k] * at(k) for k in range(_MOST)])


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
    """A loop of `count` rounds; of known length where it must be, see `Meetings.steady`."""
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

    `steady` loops have a known length, see `Meetings.steady`.
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
    listed: bool,
) -> ContactTable:
    """Contacts of some robots: pairs with bounding spheres that may overlap when the step ends.

    None take the places `[_MOST, lanes]` that are 1 in `kept`; boxes are where they end but for a
    `drift` of `[lanes]` [m]. `halves`: which halves of modules are in contact is found, too, and if
    `listed`, which pairs.
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
        block, near_pairs, clear = carry
        number = block * width + jnp.arange(width, dtype=jnp.int32)
        one, other = look_up(jnp.minimum(number, npair * size - 1))
        start, end = (pick(spheres, box.shell * size + box.lane) for box in (one, other))
        away, reach = end[:3] - start[:3], start[3] + end[3]
        given = take_lanes(real, one.lane) & (one.shell != other.shell) & (number < npair * size)
        square = dot(away, away)
        near = given & (square < (reach + take_lanes(drift, one.lane)) ** 2)
        apart = jnp.where(given & ~near, jnp.sqrt(jnp.maximum(square, 1e-30)) - reach, _FAR)
        for k in range(0, width, size):
            clear = jnp.minimum(clear, apart[k : k + size])
        return block + 1, append_true(near, number, near_pairs, steady), clear

    def examine(near_pairs: Any, table: ContactTable) -> ContactTable:
        """The contacts of these pairs join those of each robot; the weakest give way."""
        numbers, count = near_pairs

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
            if listed:
                found.append((number // size).astype(dtype))
            left = count - k * _PAIRS
            if steady:
                real = jnp.arange(_PAIRS, dtype=jnp.int32) < left
                need, gap = jnp.where(real, need, _NONE), jnp.where(real, gap, _FAR)
            left = _PAIRS if steady else jnp.minimum(left, _PAIRS)
            return _insert(table, left, (need, gap, jnp.stack(found)), given[0].lane)

        return _repeat(-(-count // _PAIRS), -(-npair * size // _PAIRS), measure, table, steady)

    clear = jnp.full(size, _FAR, dtype)
    table = ContactTable(
        _NONE + (_KEPT - _NONE) * kept,
        jnp.zeros((_MOST + 1, 8 + 2 * halves + listed, size), dtype),
        clear,
    )
    room = most * width if steady else min(most * width, _ROOM)
    start = jnp.zeros(room + max(width, _PAIRS), jnp.int32), jnp.int32(0)
    if steady:
        _, near_pairs, clear = _loop(most, lambda _, x: gather(x), (jnp.int32(0), start, clear))
        table = examine(near_pairs, table)
        return table._replace(clear=jnp.minimum(clear, table.clear))
    count = jnp.int32(0)
    for k in range(size):
        own = meetings.count[0] if lanes == 1 else meetings.count[which[k]]
        count = jnp.maximum(count, jnp.where(real[k], own, 0))
    blocks = -(-count * size // width)

    def more(carry: Any) -> Any:
        """The next blocks, until the list is full."""
        block, clear, table = carry
        wanted = lambda x: (x[0] < blocks) & (x[1][1] + width <= room)  # noqa: E731
        block, near_pairs, clear = jax.lax.while_loop(wanted, gather, (block, start, clear))
        return block, clear, examine(near_pairs, table)

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
    listed: bool,
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
    if listed:
        found.append(jnp.repeat(jnp.arange(npair, dtype=dtype), size))
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
            there are two further rows, of the halves of modules: 2 module, 1 more to the right;
            and a last one where contacts are listed, of the pair.
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
        pairs: `[_MOST, lanes]` the number of each; None where they are not listed.
    """

    need: jax.Array
    levers: jax.Array
    columns: jax.Array
    moved: jax.Array
    force: jax.Array
    ends: jax.Array | None
    pairs: jax.Array | None

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
            return jnp.stack(_levers(robots, ahead, [numbers[k] for k in range(_MOST)]), 1)

        kept = weight(self.force > 0, self.force)
        new = fuse(find_levers, inline=True)(numbers, ahead)
        levers = materialize(kept * self.levers + (1 - kept) * new)
        every = [levers[k] for k in range(len(levers))]
        along = lambda hinges: _sum([hinges[k] * x for k, x in enumerate(every)])  # noqa: E731
        wanted = _limit_need(table.need, along(robots.steps), along(change), dt)
        need = kept * self.need + (1 - kept) * wanted
        moved = kept[:, None] * self.moved
        columns = _sum([moved[:, 6 + k][:, None] * x for k, x in enumerate(every)])
        columns = kept[:, None] * (columns + _SOFTNESS * _unit(self.force))
        bodies = self.ends
        if bodies is not None:
            own = jnp.concatenate([numbers[:, :2], numbers[:, 8 : 6 + bodies.shape[1]]], 1)
            bodies = kept[:, None] * bodies + (1 - kept[:, None]) * own
        pairs = self.pairs
        if pairs is not None:
            pairs = kept * pairs + (1 - kept) * numbers[:, -1]
        contacts = _Contacts(need, levers, columns, moved, kept * self.force, bodies, pairs)
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


def _levers(robots: Robots, ahead: BodyFrames, contacts: list[jax.Array]) -> list[jax.Array]:
    """`[nhinge, lanes]` of contacts, each by numbers as of `ContactTable`; see `_Contacts`."""
    signs = _signs(robots, [(x[0], x[1]) for x in contacts])
    return [
        sign * _turning(ahead, tuple(x[2:5]), tuple(x[5:8]))
        for x, sign in zip(contacts, signs, strict=True)
    ]


def _signs(robots: Robots, ends: list[tuple[jax.Array, jax.Array]]) -> list[jax.Array]:
    """`[nhinge, lanes]` 1 for a hinge that carries the second of two bodies only, -1 the first."""
    number = jnp.arange(1 + len(robots.steps), dtype=ends[0][0].dtype)[:, None]
    one = lambda x: weight(number == x[1], x[1]) - weight(number == x[0], x[0])  # noqa: E731
    return robots.carried([one(x) for x in ends])


def _turning(ahead: BodyFrames, normal: Vec, point: Vec) -> jax.Array:
    """`[nhinge, lanes]` how fast turning hinges move points along normals [m/rad]."""
    axis = tuple(row[2][1:] for row in ahead.rotation)
    arm = tuple(x - p[1:] for x, p in zip(point, ahead.position, strict=True))
    return dot(axis, cross(arm, normal))


def _limit_need(need: jax.Array, steps: jax.Array, change: jax.Array, dt: float) -> jax.Array:
    """What contacts need of all accelerations by contact, `[_MOST, lanes]` each [m/s²].

    Args:
        need: beside those by which hinges ended where the contacts were found.
        steps: by how much boxes part in the step without contact [m].
        change: by the accelerations by which hinges ended there.
        dt: of the step [s].
    """
    # Contact does no work: boxes part no faster than they met.
    most = 2 * jnp.maximum(-steps, 0) / dt**2
    # By as much as they near each other in the step, too, which levers at its end do not say of
    # what turns: `_measure` asks for no more.
    return jnp.minimum(need + change, jnp.maximum(most, need))


def _differentiable_response(
    meetings: Meetings, robots: Robots, rounds: jax.Array, dt: float, felt: int
) -> jax.Array:
    """Accelerations of all robots by known contacts, and the forces felt, with their derivatives.

    What `_settle` does, with the pairs and forces that it found in each round. By the implicit
    function theorem those that push keep W λ = need, so that their forces change by
    W⁻¹ (d need - dW λ).

    Args:
        meetings: which boxes can meet.
        robots: all of them.
        rounds: `[_ROUNDS (2 _MOST + 1), lanes]`, see `_search`.
        dt: of the step [s].
        felt: rows of the forces that sensors feel.

    Returns:
        `[rows + felt, lanes]`.
    """
    rounds = rounds.reshape(_ROUNDS, 2 * _MOST + 1, -1)
    dtype, lanes, hinges = rounds.dtype, rounds.shape[-1], len(robots.steps)
    body = jnp.asarray(meetings.body, jnp.int32)
    shapes = meetings.shapes[:-1].reshape(-1, len(meetings.body), meetings.lanes)
    every = [jnp.asarray(x, jnp.int32) for x in (meetings.first, meetings.second)]
    at_rest, respond = jnp.asarray(meetings.rest, dtype), robots.make_respond()

    def pick(table: jax.Array, rows: jax.Array) -> jax.Array:
        """`[..., (n,) lanes]` of `[..., rows, lanes or 1]`, rows `[(n,) lanes]`."""
        wide = jnp.broadcast_to(table, (*table.shape[:-1], lanes))
        index = jnp.broadcast_to(rows, (*wide.shape[:-2], rows.size // lanes, lanes))
        found = jnp.take_along_axis(wide, index, -2)
        return found if rows.ndim > 1 else found[..., 0, :]

    def look(frames: jax.Array, change: jax.Array, pair: jax.Array, shells: Any, sign: Any) -> Any:
        """One contact of each robot: what it needs, its levers, their response, what it presses."""
        pressed, shown = [], []
        for shell in shells:
            own = jnp.take(body, shell)
            here = weight(jnp.arange(frames.shape[1], dtype=jnp.int32)[:, None] == own, frames)
            shown.append((_sum_by_halves(jnp.moveaxis(frames * here, 1, 0)), pick(shapes, shell)))
            pressed.append(own.astype(dtype))
        need, _, *units = _measure(tuple(shown), pick(at_rest, pair), dt)
        ahead = BodyFrames(
            tuple(map(tuple, frames[12:21].reshape(3, 3, *frames.shape[1:]))), tuple(frames[21:])
        )
        lever = sign * _turning(ahead, tuple(units[:3]), tuple(units[3:]))
        along = lambda hinges: _sum_by_halves(hinges * lever)  # noqa: E731
        if meetings.halves is not None and felt > 1 + hinges:
            cells = jnp.asarray(meetings.halves.T, dtype)[..., None]
            for shell, (frame, _) in zip(shells, shown, strict=True):
                half = _half(pick(cells, shell), frame[12:], units[3:])
                pressed.append(1 + hinges + half)
        need = _limit_need(need, along(robots.steps), along(change), dt)
        return need, lever, respond(lever), pressed

    def look_again(before: Any, found: jax.Array) -> tuple[Any, None]:
        def add(before: Any) -> Any:
            was, acceleration, *contacts, _ = before
            change = acceleration[6:] - found[-1] * robots.hurry
            frames = jnp.stack(jax.tree.leaves(robots.pose(robots.steps + dt**2 * change)))
            pair = found[_MOST:-1].astype(jnp.int32)
            shells = [pick(x, pair) for x in every]
            bodies = [jnp.take(body, x).astype(dtype) for x in shells]
            signs = jnp.stack(_signs(robots, list(zip(*bodies, strict=True))))
            new = jax.vmap(partial(look, frames, change))(pair, shells, signs)
            kept, pushes = weight(was > 0, was), weight(force > 0, force)

            def merge(old: jax.Array, new: jax.Array) -> jax.Array:
                here = kept.reshape(_MOST, *[1] * (old.ndim - 2), -1)
                return here * old + (1 - here) * new

            contacts = need, levers, moved, _ = jax.tree.map(merge, tuple(contacts), new)
            acceleration = _sum([force[k] * moved[k] for k in range(_MOST)])
            reached = jnp.stack([_sum_by_halves(x * acceleration[6:]) for x in levers])
            missing = pushes * (need - reached - _SOFTNESS * force)
            arms, ways = jax.lax.stop_gradient((levers, moved))
            columns = [_sum_by_halves(jnp.moveaxis(arms * x[6:], 1, 0)) for x in ways]
            matrix = pushes[:, None] * pushes * jnp.stack(columns, 1)
            matrix = matrix + _unit(force) * (1 - pushes + _SOFTNESS * pushes)
            more = _solve(matrix, missing - jax.lax.stop_gradient(missing))
            acceleration = acceleration + _sum([more[k] * ways[k] for k in range(_MOST)])
            return force, acceleration, *contacts, force + more

        force = found[:_MOST]
        changes = any_lane(_largest(jnp.abs(force - before[0])) > 0)
        return jax.lax.cond(changes, fuse(add, inline=True), lambda x: x, before), None

    zeros = lambda *shape: jnp.zeros((*shape, lanes), dtype)  # noqa: E731
    ends = [zeros(_MOST)] * (4 if felt > 1 + hinges else 2)
    none = zeros(_MOST), zeros(_MOST, hinges), zeros(_MOST, 6 + hinges), ends
    start = zeros(_MOST), zeros(6 + hinges), *none, zeros(_MOST)
    (_, acceleration, *_, pressed, force), _ = jax.lax.scan(look_again, start, rounds)
    return jnp.concatenate([acceleration, _felt(force, pressed, felt)]) if felt else acceleration


def _solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """`[n, lanes]` from a constant `[n, n, lanes]` with a large diagonal, by Gauss and Jordan."""
    row = jnp.arange(len(matrix), dtype=jnp.int32)[:, None]
    for k in range(len(matrix)):
        own, found = matrix[k] / matrix[k, k], right[k] / matrix[k, k]
        here = weight(row == k, right)
        rest = (1 - here) * matrix[:, k]
        right = (1 - here) * right - rest * found + here * found
        matrix = (1 - here)[:, None] * matrix - rest[:, None] * own + here[:, None] * own
    return right


def _sum_by_halves(rows: jax.Array) -> jax.Array:
    """Over the first axis: its derivative has few additions of padded arrays."""
    while len(rows) > 1:
        middle = len(rows) // 2
        rows = jnp.concatenate([rows[:middle] + rows[middle : 2 * middle], rows[2 * middle :]])
    return rows[0]


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
