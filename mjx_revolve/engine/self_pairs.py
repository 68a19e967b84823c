"""Which modules of one robot can meet."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from mjx_revolve.body.placement import pairs_within, turned
from mjx_revolve.numerics.boxes import BoxPair, box_gap, dot, matmul, matvec, pair_of

if TYPE_CHECKING:
    from mjx_revolve.engine.assembly import Assembly

# Boxes that are no farther apart at rest touch [m]. A choice: rounding.
_TOUCH = 1e-5
# From a hinge to a box that holds it [m]. A choice: what is built to end there ends there.
_AT_HINGE = 1e-3
# By how much neighbours that overlap at rest may do so more [m], so that a hinge is not locked by
# what slides along each other. A choice: the overlap that contacts tolerate.
_DEEPER = 5e-4
# Angles beyond the end stops [rad] and gaps [m] that a pair must keep to be left out. Choices: end
# stops give way by about half a degree.
_RANGE_MARGIN, _CLEARANCE = 0.02, 1e-3
# Boxes of angles that are looked at, for one pair and for one robot. A choice: some tens of
# milliseconds; with five times fewer, twice as many pairs of long random bodies stay undecided, and
# are looked at in every step.
_SHARE, _BUDGET = 2048, 40000
# From rest to the end of a hinge's range, an eighth of a turn after the other and a whole one at
# most: angles in each at which neighbours are compared, and how often the interval in which they
# meet is divided so again. Choices: steps of 2 degrees, then 0.003.
_SPAN, _SPANS, _ANGLES, _PASSES = np.pi / 4, 8, 24, 3


def candidate_pairs(assembly: Assembly) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of parts that might meet: of different rigid bodies of the same robot.

    Left out are parts of a rigid body and of the one that carries it, as the hinge between them
    ends before they meet (see `hinge_stops`), parts that overlap at rest because modules are built
    that way (see `_built_into`), and those without contact.

    Args:
        assembly: of a robot, or of several.

    Returns:
        Rows of the fluid table, the lower one first.
    """
    body, parent = assembly.fluid.body, assembly.parent
    robot = assembly.robot[body]
    first, second = pairs_within(robot, robot)
    a, b = body[first], body[second]
    apart = (first < second) & (a != b) & (parent[a] != b) & (parent[b] != a)
    apart &= assembly.touching[first] & assembly.touching[second]
    pairs = np.stack([first[apart], second[apart]], 1)
    if not len(pairs):
        return pairs
    meets = part_gaps(assembly, pairs) > -_TOUCH
    meets[~meets] = ~_built_into(assembly, pairs[~meets])
    return pairs[meets]


def _built_into(assembly: Assembly, pairs: np.ndarray) -> np.ndarray:
    """`[pairs]` whether modules stand in one another as they are built.

    One is attached to the other, or they overlap by more than may be without being allowed.
    """
    module = assembly.fluid.module[pairs]
    if not len(pairs):
        return np.zeros(0, bool)
    above: list[int] = []
    inside: set[frozenset[int]] = set()
    for body in assembly.morphologies:
        first = len(above)
        above += [first + m.parent if m.parent >= 0 else -1 for m in body.modules]
        index = {m.name: first + k for k, m in enumerate(body.modules)}
        inside |= {frozenset((index[a], index[b])) for a, b in body.overlaps}
    parent = np.array(above)
    attached = (parent[module[:, 0]] == module[:, 1]) | (parent[module[:, 1]] == module[:, 0])
    return attached | np.array([frozenset(pair) in inside for pair in module.tolist()], bool)


def part_gaps(assembly: Assembly, pairs: np.ndarray) -> Float[np.ndarray, " pairs"]:
    """Gaps of pairs of parts at rest [m]."""
    table, body = assembly.fluid, assembly.fluid.body
    center = assembly.position[body] + turned(assembly.rotation[body], table.position)
    rotation = assembly.rotation[body] @ table.rotation
    i, j = pairs.T
    half = table.half_size
    return box_gap(pair_of(center[i], rotation[i], half[i], center[j], rotation[j], half[j]))


def rest_overlaps(assembly: Assembly, pairs: np.ndarray) -> Float[np.ndarray, " pairs"]:
    """By how much pairs of parts overlap at rest [m]; 0 where they do not."""
    return np.maximum(-part_gaps(assembly, pairs), 0.0) if len(pairs) else np.zeros(0)


def _ancestry(parent: np.ndarray) -> np.ndarray:
    """`[nbody, nbody]` whether the second body is the first or carries it."""
    found = np.eye(len(parent), dtype=bool)
    for body in range(1, len(parent)):
        found[body] |= found[parent[body]]
    return found


def _turning(axis: np.ndarray, x: np.ndarray) -> list[np.ndarray]:
    """`[n, 3, k]` columns x, K x and K² x, as `[3, k, n]`.

    Turned by an angle about `[n, 3]` axes they are x + sin K x + (1 - cos) K² x (Rodrigues).
    """
    cross = np.cross(axis[:, None], -np.eye(3))
    first = cross @ x
    return [np.moveaxis(part, 0, 2) for part in (x, first, cross @ first)]


def _poses(assembly: Assembly, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`[3, nbody, n]` positions, `[3, 3, nbody, n]` rotations, core frames, of `[nbody, n]`."""
    place, turn = assembly.from_parents()
    still, *turning = _turning(turned(turn, assembly.axis), turn)
    still, first, second, place = (x.astype(angle.dtype) for x in (still, *turning, place))
    position = np.zeros((3, *angle.shape), angle.dtype)
    rotation = np.zeros((3, 3, *angle.shape), angle.dtype)
    rotation += np.eye(3, dtype=angle.dtype)[..., None, None]
    sine, versed = np.sin(angle), 1 - np.cos(angle)
    for body in assembly.moved:
        own = still[..., [body]] + sine[body] * first[..., [body]]
        own += versed[body] * second[..., [body]]
        above = assembly.parent[body]
        up = rotation[:, :, above]
        position[:, body] = position[:, above] + matvec(up, place[body])
        rotation[:, :, body] = matmul(up, own)
    return position, rotation


def meeting_pairs(assembly: Assembly) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of parts of a robot that can meet within the limits of its hinges.

    Of `candidate_pairs` those are left out that stay apart at all angles: by branch and bound over
    the hinges on the way from one part to the other. When hinge k turns by δ, one of the parts
    moves by at most δ times the distance of its farthest point from the hinge's axis; so, in a box
    of angles, the gap is at least that in its middle, less a sum of these over half the box's
    edges (`_nearing`). Boxes of angles in which that leaves a gap are done; others are halved. A
    pair is kept when it overlaps in the middle of a box, or when its share of the work is used up.

    Args:
        assembly: of one robot.

    Returns:
        Rows of the fluid table, the lower one first.
    """
    pairs = candidate_pairs(assembly)
    if not len(pairs):
        return pairs
    table, above = assembly.fluid, _ancestry(assembly.parent)
    low, high = assembly.stops.T
    middle, half = (low + high) / 2, (high - low) / 2 + _RANGE_MARGIN
    own = table.body[pairs]
    way = (above[own[:, 0]] ^ above[own[:, 1]]).T
    first_side = above[own[:, 0]].T & way
    kept, spent, budget = np.zeros(len(pairs), bool), np.zeros(len(pairs), int), _BUDGET
    which = np.arange(len(pairs))
    # In single precision: errs by less than a thousandth of the clearance, and is faster.
    single = lambda x: np.asarray(x, np.float32)  # noqa: E731
    center, edge = (single(np.where(way, x[:, None], 0)) for x in (middle, half))
    axis, place, size = (single(x).T for x in (assembly.axis, table.position, table.half_size))
    radius, axes = np.linalg.norm(size, axis=0), np.moveaxis(single(table.rotation), 0, 2)
    while len(which):
        spent += np.bincount(which, minlength=len(pairs))
        kept[spent > _SHARE] = True
        budget -= len(which)
        if budget < 0:
            kept[which] = True
        stay = ~kept[which]
        which, center, edge = which[stay], center[:, stay], edge[:, stay]
        position, rotation = _poses(assembly, center)
        spin = matvec(rotation, axis[..., None])
        row, shapes, reaches = np.arange(len(which)), [], []
        for part in pairs[which].T:
            body = table.body[part]
            turn = rotation[:, :, body, row]
            origin = position[:, body, row] + matvec(turn, place[:, part])
            shapes.append((origin, matmul(turn, axes[..., part]), size[:, part]))
            arm = origin[:, None] - position
            # The arm's length across the unit axis.
            across = np.maximum(dot(arm, arm) - dot(spin, arm) ** 2, 0)
            reaches.append(np.sqrt(across) + radius[part])
        (one, first, half_one), (other, second, half_other) = shapes
        gap = box_gap(BoxPair(other - one, first, second, half_one, half_other))
        moves = edge * np.minimum(*reaches)
        kept[which[gap < 0]] = True
        nearing = _nearing(edge, reaches, first_side[:, which])
        stay = (gap - nearing < _CLEARANCE) & ~kept[which]
        which, center, edge, moves = which[stay], center[:, stay], edge[:, stay], moves[:, stay]
        row, aside = np.arange(len(which)), np.zeros_like(edge)
        widest = moves.argmax(0) if len(which) else row
        edge[widest, row] /= 2
        aside[widest, row] = edge[widest, row]
        which, edge = np.tile(which, 2), np.tile(edge, 2)
        center = np.concatenate([center - aside, center + aside], 1)
    return pairs[kept]


def _nearing(edge: np.ndarray, reaches: list[np.ndarray], first_side: np.ndarray) -> np.ndarray:
    """`[n]` by how much parts of pairs can near each other within half edges of angles [m].

    The reach of one part counts for the hinges next to it, that of the other for those beyond:
    turned one after the other, from where the two meet outwards, all between a hinge and the part
    that its turn is said to move is still as in the middle. Of all such divisions, the least sum.
    """
    one, other = (edge * reach for reach in reaches)
    less = one - other
    # Along the way: up from the first part, bodies in falling order, then down to the second.
    up = np.cumsum(np.where(first_side, less, 0)[::-1], 0)
    down = up[-1] + np.cumsum(np.where(first_side, 0, less), 0)
    return other.sum(0) + np.minimum(np.minimum(up.min(0), down.min(0)), 0)


def hinge_stops(assembly: Assembly) -> Float[np.ndarray, "nbody 2"]:
    """Angles at which hinges end: their range, less where their own neighbours would meet.

    Neighbours are the parts of the rigid body that carries the hinge and of the one that it
    carries, but for those without contact, those of one module, and those that overlap or touch at
    rest and are built so (see `_built_into`) or both hold the hinge: boxes that stand end to end
    there, as in models of chains, stand for shapes that let it turn. Others that overlap by a few
    millimetres get half a millimetre deeper at most.

    Args:
        assembly: of a robot, or of several.

    Returns:
        Lowest and highest angle of each body's hinge [rad].
    """
    table, body = assembly.fluid, assembly.fluid.body
    stops = assembly.range.copy()
    order = np.argsort(body, kind="stable")
    first, second = pairs_within(assembly.parent[body], body[order])
    pairs = np.stack([order[second], first], 1)
    radius = np.linalg.norm(table.half_size, axis=1)
    hinge = body[pairs[:, 1]]
    place = assembly.position[body] + turned(assembly.rotation[body], table.position)
    far = [np.linalg.norm(place[part] - assembly.position[hinge], axis=1) for part in pairs.T]
    near = np.abs(far[0] - far[1]) < radius[pairs].sum(1)
    near &= table.module[pairs[:, 0]] != table.module[pairs[:, 1]]
    near &= assembly.touching[pairs].all(1)
    pairs = pairs[near]
    if not len(pairs):
        return stops
    meets = part_gaps(assembly, pairs) > _TOUCH
    some = pairs[~meets]
    holds = [_holds(assembly, part, body[some[:, 1]]) for part in some.T]
    meets[~meets] = ~(_built_into(assembly, some) | (holds[0] & holds[1]))
    pairs = pairs[meets]
    hinge = body[pairs[:, 1]]

    i, j = pairs.T
    origin, rotation = assembly.position[hinge], assembly.rotation[body] @ table.rotation
    # From the hinge to the box that it carries, and that box's axes, at rest and as they turn.
    arm = np.concatenate([(place[j] - origin)[..., None], rotation[j]], 2)
    turning = _turning(turned(assembly.rotation[hinge], assembly.axis[hinge]), arm)
    offset, fixed = (origin - place[i]).T, np.moveaxis(rotation[i], 0, 2)
    given = *turning, offset, fixed, table.half_size[i].T, table.half_size[j].T

    def gap(angle: np.ndarray, some: np.ndarray) -> np.ndarray:
        """`[n, some]` of so many of the pairs, at such angles of their hinges [m]."""
        still, first, second, offset, fixed, *halves = (x[..., None, some] for x in given)
        moved = still + np.sin(angle) * first + (1 - np.cos(angle)) * second
        return box_gap(BoxPair(offset + moved[:, 0], fixed, moved[:, 1:], *halves))

    every = np.arange(len(pairs))
    rest = gap(np.zeros((1, len(pairs))), every)[0]
    allowed = np.where(rest > _TOUCH, -1e-6, np.minimum(rest, 0) - _DEEPER)
    share = np.arange(1, _ANGLES + 1)[:, None] / _ANGLES
    for side, nearest in enumerate((np.maximum, np.minimum)):
        end, free = stops[hinge, side], np.zeros(len(pairs))
        some, meeting = every, every[:0]
        for _ in range(_SPANS):
            width = np.clip(end - free, -_SPAN, _SPAN)
            met = (gap(free[some] + share * width[some], some) < allowed[some]).any(0)
            meeting = np.append(meeting, some[met])
            some = some[~met]
            free[some] += width[some]
            some = some[free[some] != end[some]]
        free[some] = end[some]  # nothing is in the way in a whole turn
        some = meeting
        for _ in range(_PASSES):
            hit = gap(free[some] + share * width[some], some) < allowed[some]
            met = hit.any(0)
            free[some] += np.where(met, hit.argmax(0) / _ANGLES, 1) * width[some]
            some = some[met]
            width[some] /= _ANGLES
        nearest.at(stops[:, side], hinge, free)
    return stops


def _holds(assembly: Assembly, part: np.ndarray, hinge: np.ndarray) -> np.ndarray:
    """`[n]` whether the boxes of parts reach to where hinges are."""
    table, body = assembly.fluid, assembly.fluid.body[part]
    there = assembly.position[hinge] - assembly.position[body]
    there = turned(assembly.rotation[body].swapaxes(1, 2), there) - table.position[part]
    there = turned(table.rotation[part].swapaxes(1, 2), there)
    return (np.abs(there) < table.half_size[part] + _AT_HINGE).all(1)


def hinge_levers(
    assembly: Assembly, pairs: Int[np.ndarray, "pairs 2"]
) -> Float[np.ndarray, " nbody"]:
    """How far parts of pairs can move, one seen from the other, for each radian of a hinge.

    The farthest that a part reaches from a hinge between the two, on the side of it where they
    reach less far, as if all hinges on the way could stretch: an upper bound, in every pose.

    Args:
        assembly: of a robot, or of several.
        pairs: rows of its fluid table.

    Returns:
        Of each body's hinge [m]; 0 where it stands between no pair.
    """
    table, parent, place = assembly.fluid, assembly.parent.tolist(), assembly.position
    center = place[table.body] + turned(assembly.rotation[table.body], table.position)
    radius = np.linalg.norm(table.half_size, axis=1)
    found = np.zeros(len(parent))
    for part in pairs:
        ways: list[list[int]] = [[], []]
        for way, body in zip(ways, table.body[part].tolist(), strict=True):
            while parent[body]:
                way.append(body)
                body = parent[body]
        one, other = ways
        while one and other and one[-1] == other[-1]:
            one.pop(), other.pop()
        hinges = [*one, *reversed(other)]
        # Neighbours on the way belong to one rigid body, at a fixed distance.
        points = np.concatenate([center[part[:1]], place[hinges], center[part[1:]]])
        along = np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))
        reach = np.minimum(radius[part[0]] + along, radius[part[1]] + along[-1] - along)
        found[hinges] = np.maximum(found[hinges], reach[:-1])
    return found
