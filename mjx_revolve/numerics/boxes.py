"""Distance and penetration depth of turned boxes, by separating axes.

Two convex bodies are apart where their projections on some axis are; of two boxes, 15 axes decide:
three face normals of each, and the nine cross products of their edges (Gottschalk, Lin and Manocha
1996, OBBTree, SIGGRAPH). The largest gap over these axes is, where it is negative, minus the
penetration depth: the least translation that parts the boxes.

Functions take NumPy's arrays or JAX's, and return the same: vectors `[3, ...]`, matrices
`[3, 3, ...]`, rows first. Axes stand in five groups of three: the first box's, the second's, and
those of each of the first's edges with the second's. Choices are sums with weights of 0 and 1:
XLA:CPU makes a branch of a choice between numbers in memory, and no vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_revolve.numerics.spatial import Scalar, namespace
from mjx_revolve.numerics.xla import materialize

# An axis of two edges counts only where it parts the boxes by so much more than a face [m]: faces
# are steadier, and close to parallel edges have no axis. A choice.
_FACES_FIRST = 1e-5
# Squared sine below which two edges count as parallel [-].
_PARALLEL = 1e-6
# The same where the boxes turn within a step: the axis of two edges swings with them, and flips
# where they become parallel. A choice: 18 degrees.
_SWINGING = 0.1
# Sine of the angle between an edge and a face below which the edge lies flat on it [-]: the contact
# point then moves from the edge's end to its middle. A choice: 0.3 degrees. The gap is that at the
# edge's end also then, and a wider angle gives it the lever of a point that is not there: a light
# plate that a servo presses flat on a face rattled between its edges, at five times the servo's top
# speed.
_FLAT = 0.005


class BoxPair(NamedTuple):
    """Two boxes; all arrays broadcast against each other behind their first axes.

    Attributes:
        offset: `[3, ...]` from the first box's centre to the second's, world frame [m].
        first: `[3, 3, ...]` world from the first box's axes.
        second: `[3, 3, ...]` world from the second box's axes.
        first_half: `[3, ...]` half edges of the first [m].
        second_half: `[3, ...]` half edges of the second [m].
    """

    offset: Scalar
    first: Scalar
    second: Scalar
    first_half: Scalar
    second_half: Scalar


class BoxAxes(NamedTuple):
    """Projections of two boxes on the 15 axes, five groups `[3, ...]`.

    Attributes:
        offset: of the second centre from the first along each axis, with its sign [m].
        reach: sum of both boxes' half widths along each axis [m].
    """

    offset: tuple[Scalar, ...]
    reach: tuple[Scalar, ...]

    def gaps(self, side: tuple[Scalar, ...] | None = None) -> tuple[Scalar, ...]:
        """Gap along each axis [m], negative for an overlap.

        Args:
            side: the sign of the offset along each axis that counts as apart, so that a box that
                has passed through the other counts as deep in it; None: either sign.
        """
        xp = namespace(self.offset[0])
        if side is None:
            return tuple(xp.abs(x) - r for x, r in zip(self.offset, self.reach, strict=True))
        every = zip(self.offset, self.reach, side, strict=True)
        return tuple(x * s - r for x, r, s in every)


def matvec(matrix: Scalar, x: Scalar) -> Scalar:
    """M x of `[3, 3, ...]` and `[3, ...]`."""
    return matrix[:, 0] * x[0] + matrix[:, 1] * x[1] + matrix[:, 2] * x[2]


def matmul(a: Scalar, b: Scalar) -> Scalar:
    """A B of `[3, 3, ...]` both."""
    return matvec(a[:, :, None], b)


def mat_t_vec(matrix: Scalar, x: Scalar) -> Scalar:
    """Mᵀ x."""
    return matrix[0] * x[0] + matrix[1] * x[1] + matrix[2] * x[2]


def dot(a: Scalar, b: Scalar) -> Scalar:
    """A · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _joined(parts: Sequence[Scalar], axis: int = 0) -> Scalar:
    xp = namespace(parts[0])
    found = xp.concatenate(parts, axis)
    return found if xp is np else materialize(found)


def _stacked(rows: Sequence[Scalar]) -> Scalar:
    xp = namespace(rows[0])
    rows = xp.broadcast_arrays(*rows)
    return _joined([x[None] for x in rows])


def box_axes(pair: BoxPair, parallel: float = _PARALLEL) -> BoxAxes:
    """Projections of two boxes on the 15 axes.

    Edges with a squared sine below `parallel` have no axis: their reach is set to 1e3 m, so that
    their gap is never the largest.
    """
    a, b, turn = pair.first_half, pair.second_half, _relative(pair)
    xp, t = namespace(turn), mat_t_vec(pair.first, pair.offset)
    size = xp.abs(turn)
    offset = [t, mat_t_vec(turn, t)]
    reach = [a + matvec(size, b), b + mat_t_vec(size, a)]
    # The second's edges once more behind the last.
    round_b, round_size = _joined([b, b[:2]]), _joined([size, size[:, :2]], 1)
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        square = 1 - turn[i] * turn[i]
        crossed = weight(square > parallel, square)
        inverse = crossed / xp.sqrt(xp.maximum(square, parallel))
        offset.append((t[i2] * turn[i1] - t[i1] * turn[i2]) * inverse)
        both = a[i1] * size[i2] + a[i2] * size[i1]
        both = both + round_b[1:4] * round_size[i, 2:5] + round_b[2:5] * round_size[i, 1:4]
        reach.append(both * inverse + 1e3 * (1 - crossed))
    return BoxAxes(tuple(offset), tuple(reach))


def weight(condition: Scalar, like: Scalar) -> Scalar:
    """1 where a condition holds, else 0, of the type of another number."""
    xp = namespace(like)
    return xp.where(condition, 1.0, 0.0).astype(like.dtype)


def _relative(pair: BoxPair) -> Scalar:
    """The second box's axes, seen from the first: first from second."""
    one, other = pair.first, pair.second
    return sum(one[k][:, None] * other[k][None] for k in range(3))


def box_gap(pair: BoxPair) -> Scalar:
    """Largest gap of two boxes over the 15 axes [m].

    Negative: minus the penetration depth. Positive: they are apart, by at least that distance.
    """
    return _largest(box_axes(pair).gaps())


def _largest(groups: Sequence[Scalar]) -> Scalar:
    """Over all axes of some groups."""
    xp, found = namespace(groups[0]), groups[0]
    for group in groups[1:]:
        found = xp.maximum(found, group)
    return xp.maximum(xp.maximum(found[0], found[1]), found[2])


class BoxContact(NamedTuple):
    """Where two boxes meet.

    Attributes:
        gap: along the normal [m]; negative for an overlap.
        start: the same now, where `gap` is that a step later [m].
        normal: `[3, ...]` unit vector from the first box to the second, world frame.
        point: `[3, ...]` in the middle between them, from the first box's centre, world frame [m].
    """

    gap: Scalar
    start: Scalar
    normal: Scalar
    point: Scalar


def box_contact(pair: BoxPair, ahead: BoxPair | None = None) -> BoxContact:
    """Where two boxes meet: the axis that parts them most, and a point between their features.

    The point is the middle of what the two touching features (corners, edges, faces) have in
    common. It is where it was when the boxes turn a little: features lie flat within 0.3 degrees.

    Args:
        pair: now.
        ahead: a step later. Then `gap` is the gap then, along the axis that parts the boxes most
            then, among those that part them now (or, if none does, that part them least badly):
            boxes that would pass through each other within the step do not.

    Returns:
        The contact; normal and point are those ahead.
    """
    xp = namespace(pair.offset[0])
    axes = box_axes(pair, _PARALLEL if ahead is None else _SWINGING)
    now = axes.gaps()
    side = tuple(1 - 2 * weight(x < 0, x) for x in axes.offset)
    score = now
    if ahead is not None:
        least = xp.minimum(_largest(now), 0) - _FACES_FIRST
        parting = [weight(n >= least, n) for n in now]
        later = box_axes(ahead).gaps(side)
        score = tuple(w * x - 1e3 * (1 - w) for w, x in zip(parting, later, strict=True))
    face, crossing = _largest(score[:2]), _largest(score[2:])
    edges = weight(crossing > face + _FACES_FIRST, face)
    best = face + edges * (crossing - face)
    share = [(1 - edges) * x for x in _largest_of(score[:2])]
    share += [edges * x for x in _largest_of(score[2:])]
    start = sum(s[k] * x[k] for s, x in zip(share, now, strict=True) for k in range(3))
    pair = pair if ahead is None else ahead
    turn = _relative(pair)
    normal = _axis(turn, [x * y for x, y in zip(share, side, strict=True)])
    # The features that look at each other, seen from the first box.
    t = mat_t_vec(pair.first, pair.offset)
    one, spread = _feature(normal, pair.first_half)
    other, other_spread = _feature(-mat_t_vec(turn, normal), pair.second_half)
    away = t + matvec(turn, other) - one
    size, back = xp.abs(turn), mat_t_vec(turn, away)
    on_first = _common(spread, away, matvec(size, other_spread))
    on_second = away + matvec(turn, _common(other_spread, -back, mat_t_vec(size, spread)))
    # Of two edges, the point of the first that is nearest to the second.
    edge = _stacked([x[0] + x[1] + x[2] for x in share[2:]])
    other_edge = matvec(turn, share[2] + share[3] + share[4])
    cosine = dot(edge, other_edge)
    way = dot(edge, away) - cosine * dot(other_edge, away)
    way = way / (1 - edges * cosine * cosine)
    reach = dot(edge, spread)
    first = share[0][0] + share[0][1] + share[0][2]
    point = first * on_first + (1 - edges - first) * on_second
    point = point + edges * xp.clip(way, -reach, reach) * edge
    # In the middle between the two along the normal.
    point = point + (0.5 * dot(normal, away) - dot(normal, point)) * normal
    return BoxContact(best, start, matvec(pair.first, normal), matvec(pair.first, one + point))


def _largest_of(groups: Sequence[Scalar]) -> list[Scalar]:
    """1 for an axis with the largest number of some groups, 0 for all others.

    Numbers are compared with each other, never with their maximum: XLA may compute it with other
    last bits than the numbers themselves, and then no axis would be it.
    """
    xp = namespace(groups[0])
    share, best = first_largest(groups)
    second = weight(best[1] > best[0], best)
    third = weight(best[2] > xp.maximum(best[0], best[1]), best)
    row = _stacked(last_of([second, third]))
    return [x * row for x in share]


def first_largest(xs: Sequence[Scalar]) -> tuple[list[Scalar], Scalar]:
    """1 for the first of the largest of some things, 0 for the others; and the largest."""
    best, better = xs[0], []
    for x in xs[1:]:
        better.append(weight(x > best, x))
        best = namespace(best).maximum(best, x)
    return last_of(better), best


def last_of(better: Sequence[Scalar]) -> list[Scalar]:
    """1 for the last of some things that was better than those before it, 0 for the others.

    Args:
        better: 1 or 0 for each of them but the first.
    """
    share, left = [], 1.0
    for x in reversed(better):
        share.append(left * x)
        left = left * (1 - x)
    return [left, *reversed(share)]


def _axis(turn: Scalar, share: Sequence[Scalar]) -> Scalar:
    """The sum of the 15 axes, unit vectors in the first box's frame, by such shares."""
    xp = namespace(turn)
    crossed = []
    for i in range(3):
        square = 1 - turn[i] * turn[i]
        crossed.append(matvec(turn, share[2 + i] / xp.sqrt(xp.maximum(square, _PARALLEL))))
    # e_i × Σ of the second box's axes.
    x, y, z = crossed
    edges = _stacked([y[2] - z[1], z[0] - x[2], x[1] - y[0]])
    return share[0] + matvec(turn, share[1]) + edges


def _feature(normal: Scalar, half: Scalar) -> tuple[Scalar, Scalar]:
    """Middle of a box's corner, edge or face that lies farthest along a direction; its half edges.

    Both in the box's frame.
    """
    xp = namespace(normal)
    share = xp.clip(normal / _FLAT, -1, 1)
    return share * half, (1 - xp.abs(share)) * half


def _common(spread: Scalar, away: Scalar, reach: Scalar) -> Scalar:
    """Middle of what two features have in common along the axes of the first's box.

    From the middle of the first feature, of half edges `spread`. `away` leads to that of the
    second, which reaches so far along each axis.
    """
    xp = namespace(spread)
    low = xp.maximum(-spread, away - reach)
    high = xp.minimum(spread, away + reach)
    # With nothing in common, the end of the other one: the gap is that at its corner.
    return xp.clip(0.5 * (low + high), away - reach, away + reach)


def pair_of(
    center: np.ndarray, rotation: np.ndarray, half: np.ndarray,
    centers: np.ndarray, rotations: np.ndarray, halves: np.ndarray,
) -> BoxPair:  # fmt: skip
    """Pairs of boxes from arrays `[..., 3]` and `[..., 3, 3]`, for `box_gap` and `box_contact`.

    Args:
        center: of the first boxes, world frame [m].
        rotation: world from the first boxes' axes.
        half: half edges of the first [m].
        centers: of the second boxes.
        rotations: of the second.
        halves: of the second.

    Returns:
        The pairs.
    """
    vec = lambda x: np.moveaxis(x, -1, 0)  # noqa: E731
    mat = lambda x: np.moveaxis(x, (-2, -1), (0, 1))  # noqa: E731
    return BoxPair(vec(centers - center), mat(rotation), mat(rotations), vec(half), vec(halves))
