"""Which modules of one robot can meet."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mjx_revolve.body.placement import pairs_within, turned
from mjx_revolve.numerics.boxes import box_gap, pair_of

if TYPE_CHECKING:
    from mjx_revolve.engine.assembly import Assembly

# Parts that overlap by more than this at rest [m] are built that way, and pass through each other
# later on, too. A choice: rounding.
REST_OVERLAP = 1e-5
# Angles beyond the end stops [rad] and gaps [m] that a pair must keep to be left out. Choices: end
# stops give way by half a degree.
_RANGE_MARGIN, _CLEARANCE = 0.02, 1e-3
# Boxes of angles that are looked at, for one pair and for one robot. A choice: some milliseconds.
_SHARE, _BUDGET = 512, 8000
# Angles from rest to the end of a hinge's range at which neighbours are compared, and how often the
# interval in which they meet is divided so again. Choices: steps of 2 degrees, then 0.003.
_ANGLES, _PASSES = 24, 3


def candidate_pairs(assembly: Assembly) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of parts that might meet: of different rigid bodies of the same robot.

    Left out are parts of a rigid body and of the one that carries it, as the hinge between them
    ends before they meet (see `hinge_stops`), and parts that overlap at rest by more than
    `REST_OVERLAP`.

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
    pairs = np.stack([first[apart], second[apart]], 1)
    if not len(pairs):
        return pairs
    return pairs[part_gaps(assembly, pairs) > -REST_OVERLAP]


def part_gaps(assembly: Assembly, pairs: np.ndarray) -> Float[np.ndarray, " pairs"]:
    """Gaps of pairs of parts at rest [m]."""
    table, body = assembly.fluid, assembly.fluid.body
    center = assembly.position[body] + turned(assembly.rotation[body], table.position)
    rotation = assembly.rotation[body] @ table.rotation
    i, j = pairs.T
    half = table.half_size
    return box_gap(pair_of(center[i], rotation[i], half[i], center[j], rotation[j], half[j]))


def _ancestry(parent: np.ndarray) -> np.ndarray:
    """`[nbody, nbody]` whether the second body is the first or carries it."""
    found = np.eye(len(parent), dtype=bool)
    for body in range(1, len(parent)):
        found[body] |= found[parent[body]]
    return found


def _poses(assembly: Assembly, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`[n, nbody, 3]` positions and `[n, nbody, 3, 3]` rotations, core frames, of `[n, nbody]`."""
    place, turn = assembly.from_parents()
    position = np.zeros((*angle.shape, 3))
    rotation = np.broadcast_to(np.eye(3), (*angle.shape, 3, 3)).copy()
    sine, versed = np.sin(angle), 1 - np.cos(angle)
    for body in assembly.moved:
        x, y, z = assembly.axis[body]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        # Rodrigues.
        own = sine[:, body, None, None] * cross + versed[:, body, None, None] * (cross @ cross)
        own = turn[body] @ (np.eye(3) + own)
        above = assembly.parent[body]
        position[:, body] = position[:, above] + rotation[:, above] @ place[body]
        rotation[:, body] = rotation[:, above] @ own
    return position, rotation


class _Boxes(NamedTuple):
    """The boxes of pairs of parts, at some angles: what `pair_of` takes."""

    center: np.ndarray
    rotation: np.ndarray
    half: np.ndarray
    centers: np.ndarray
    rotations: np.ndarray
    halves: np.ndarray


def _boxes(assembly: Assembly, pairs: np.ndarray, poses: tuple[np.ndarray, np.ndarray]) -> _Boxes:
    """Of `[n, 2]` pairs, each at its own one of `n` poses."""
    table, (position, rotation) = assembly.fluid, poses
    row, found = np.arange(len(pairs)), []
    for part in pairs.T:
        body = table.body[part]
        turn = rotation[row, body]
        found += [
            position[row, body] + turned(turn, table.position[part]),
            turn @ table.rotation[part],
            table.half_size[part],
        ]
    return _Boxes(*found)


def meeting_pairs(assembly: Assembly) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of parts of a robot that can meet within the limits of its hinges.

    Of `candidate_pairs` those are left out that stay apart at all angles: by branch and bound over
    the hinges on the way from one part to the other. When hinge k turns by δ, one of the parts
    moves by at most δ times the distance of its farthest point from the hinge's axis; so, in a box
    of angles, the gap is at least that in its middle, less the sum of these over half the box's
    edges. Boxes of angles in which that leaves a gap are done; others are halved. A pair is kept
    when it overlaps in the middle of a box, or when its share of the work is used up.

    Args:
        assembly: of one robot.

    Returns:
        Rows of the fluid table, the lower one first.
    """
    pairs = candidate_pairs(assembly)
    if not len(pairs):
        return pairs
    table, above = assembly.fluid, _ancestry(assembly.parent)
    radius = np.linalg.norm(table.half_size, axis=1)
    low, high = assembly.stops.T
    middle, half = (low + high) / 2, (high - low) / 2 + _RANGE_MARGIN
    own = table.body[pairs]
    way = above[own[:, 0]] ^ above[own[:, 1]]
    kept = np.zeros(len(pairs), bool)
    spent = np.zeros(len(pairs), int)
    which = np.arange(len(pairs))
    center, edge = np.where(way, middle, 0.0), np.where(way, half, 0.0)
    budget = _BUDGET
    while len(which):
        spent += np.bincount(which, minlength=len(pairs))
        kept[spent > _SHARE] = True
        budget -= len(which)
        if budget < 0:
            kept[which] = True
        stay = ~kept[which]
        which, center, edge = which[stay], center[stay], edge[stay]
        poses = _poses(assembly, center)
        boxes = _boxes(assembly, pairs[which], poses)
        gap = box_gap(pair_of(*boxes))
        spin = turned(poses[1].reshape(-1, 3, 3), np.tile(assembly.axis, (len(which), 1)))
        spin = spin.reshape(*center.shape, 3)
        reach = np.full(center.shape, np.inf)
        for place, part in ((boxes.center, 0), (boxes.centers, 1)):
            arm = np.cross(spin, place[:, None] - poses[0])
            far = np.linalg.norm(arm, axis=2) + radius[pairs[which, part]][:, None]
            reach = np.minimum(reach, far)
        moves = edge * reach
        kept[which[gap < 0]] = True
        stay = (gap - moves.sum(1) < _CLEARANCE) & ~kept[which]
        which, center, edge, moves = which[stay], center[stay], edge[stay], moves[stay]
        rows, widest = np.arange(len(which)), moves.argmax(1) if len(which) else which
        edge[rows, widest] /= 2
        aside = np.zeros_like(edge)
        aside[rows, widest] = edge[rows, widest]
        which, edge = np.tile(which, 2), np.tile(edge, (2, 1))
        center = np.concatenate([center - aside, center + aside])
    return pairs[kept]


def hinge_stops(assembly: Assembly) -> Float[np.ndarray, "nbody 2"]:
    """Angles at which hinges end: their range, less where their own neighbours would meet.

    Neighbours are the parts of the rigid body that carries the hinge and of the one that it
    carries, but for those of one module and those that overlap or touch at rest: boxes that stand
    end to end at a hinge, as in models of chains, stand for shapes that let it turn.

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
    pairs = pairs[near]
    if not len(pairs):
        return stops
    pairs = pairs[part_gaps(assembly, pairs) > REST_OVERLAP]
    hinge = body[pairs[:, 1]]

    axis, origin, up = assembly.axis[hinge], assembly.position[hinge], assembly.rotation[hinge]
    cross = np.cross(axis[:, None], -np.eye(3))
    rotation = assembly.rotation[body] @ table.rotation
    i, j = pairs.T

    def gap(angle: np.ndarray) -> np.ndarray:
        """`[n, pairs]` at such angles of their hinges [m]."""
        sine, versed = np.sin(angle)[..., None, None], (1 - np.cos(angle))[..., None, None]
        own = np.eye(3) + sine * cross + versed * (cross @ cross)
        turn = up @ own @ up.swapaxes(1, 2)
        moved = origin + (turn @ (place[j] - origin)[..., None])[..., 0]
        return box_gap(
            pair_of(
                np.broadcast_to(place[i], moved.shape), np.broadcast_to(rotation[i], turn.shape),
                np.broadcast_to(table.half_size[i], moved.shape),
                moved, turn @ rotation[j], np.broadcast_to(table.half_size[j], moved.shape),
            )
        )  # fmt: skip

    allowed = np.minimum(gap(np.zeros((1, len(pairs)))), 0) - 1e-6
    share = np.arange(1, _ANGLES + 1)[:, None] / _ANGLES
    for side, nearest in enumerate((np.maximum, np.minimum)):
        free, width = np.zeros(len(pairs)), stops[hinge, side].copy()
        for _ in range(_PASSES):
            hit = gap(free + share * width) < allowed
            met = hit.any(0)
            free = free + np.where(met, hit.argmax(0) / _ANGLES, 1) * width
            width = np.where(met, width / _ANGLES, 0)
        nearest.at(stops[:, side], hinge, free)
    return stops


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
