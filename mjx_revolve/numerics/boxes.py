"""Distance and penetration depth of turned boxes, by components, by separating axes.

Two convex bodies are apart where their projections on some axis are; of two boxes, 15 axes decide:
three face normals of each, and the nine cross products of their edges (Gottschalk, Lin and Manocha
1996, OBBTree, SIGGRAPH). The largest gap over these axes is, where it is negative, minus the
penetration depth: the least translation that parts the boxes.

Functions take NumPy's arrays or JAX's, and return the same; see `spatial` for vectors. Choices are
sums with weights of 0 and 1: XLA:CPU makes a branch of a choice between numbers in memory, and no
vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_revolve.numerics.spatial import (
    Mat,
    Scalar,
    Vec,
    dot,
    matTvec,
    matvec,
    namespace,
    transpose,
    vadd,
    vscale,
    vsub,
)

# An axis of two edges counts only where it parts the boxes by so much more than a face [m]: faces
# are steadier, and close to parallel edges have no axis. A choice.
_FACES_FIRST = 1e-5
# Squared sine below which two edges count as parallel [-].
_PARALLEL = 1e-6
# The same where the boxes turn within a step: the axis of two edges swings with them, and flips
# where they become parallel. A choice: 18 degrees.
_SWINGING = 0.1
# Sine of the angle between an edge and a face below which the edge lies flat on it [-]: the contact
# point then moves from the edge's end to its middle. A choice.
_FLAT = 0.05


class BoxPair(NamedTuple):
    """Two boxes; all components broadcast against each other.

    Attributes:
        offset: from the first box's centre to the second's, world frame [m].
        first: world from the first box's axes.
        second: world from the second box's axes.
        first_half: half edges of the first [m].
        second_half: half edges of the second [m].
    """

    offset: Vec
    first: Mat
    second: Mat
    first_half: Vec
    second_half: Vec


class BoxAxes(NamedTuple):
    """Projections of two boxes on the 15 axes.

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


def box_axes(pair: BoxPair, parallel: float = _PARALLEL) -> BoxAxes:
    """Projections of two boxes on the 15 axes: the first's, the second's, then edge by edge.

    Edges with a squared sine below `parallel` have no axis: their reach is set to 1e3 m, so that
    their gap is never the largest.
    """
    xp = namespace(pair.offset[0])
    a, b = pair.first_half, pair.second_half
    t = matTvec(pair.first, pair.offset)
    turn = _relative(pair)
    size = tuple(tuple(xp.abs(x) for x in row) for row in turn)
    columns = transpose(size)
    offset = [*t, *matTvec(turn, t)]
    reach = [a[i] + dot(size[i], b) for i in range(3)]
    reach += [b[j] + dot(columns[j], a) for j in range(3)]
    for i in range(3):
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            square = 1 - turn[i][j] * turn[i][j]
            crossed = weight(square > parallel, square)
            inverse = crossed / xp.sqrt(xp.maximum(square, parallel))
            offset.append((t[i2] * turn[i1][j] - t[i1] * turn[i2][j]) * inverse)
            both = a[i1] * size[i2][j] + a[i2] * size[i1][j]
            both = both + b[j1] * size[i][j2] + b[j2] * size[i][j1]
            reach.append(both * inverse + 1e3 * (1 - crossed))
    return BoxAxes(tuple(offset), tuple(reach))


def weight(condition: Scalar, like: Scalar) -> Scalar:
    """1 where a condition holds, else 0, of the type of another number."""
    xp = namespace(like)
    return xp.where(condition, 1.0, 0.0).astype(like.dtype)


def _relative(pair: BoxPair) -> Mat:
    """The second box's axes, seen from the first: first from second."""
    columns = transpose(pair.second)
    return transpose(tuple(matTvec(pair.first, x) for x in columns))


def box_gap(pair: BoxPair) -> Scalar:
    """Largest gap of two boxes over the 15 axes [m].

    Negative: minus the penetration depth. Positive: they are apart, by at least that distance.
    """
    gaps = box_axes(pair).gaps()
    xp = namespace(gaps[0])
    found = gaps[0]
    for gap in gaps[1:]:
        found = xp.maximum(found, gap)
    return found


class BoxContact(NamedTuple):
    """Where two boxes meet.

    Attributes:
        gap: along the normal [m]; negative for an overlap.
        start: the same now, where `gap` is that a step later [m].
        normal: unit vector from the first box to the second, world frame.
        point: in the middle between them, from the first box's centre, world frame [m].
    """

    gap: Scalar
    start: Scalar
    normal: Vec
    point: Vec


def box_contact(pair: BoxPair, ahead: BoxPair | None = None) -> BoxContact:
    """Where two boxes meet: the axis that parts them most, and a point between their features.

    The point is the middle of what the two touching features (corners, edges, faces) have in
    common. It is where it was when the boxes turn a little: features lie flat within 3 degrees.

    Args:
        pair: now.
        ahead: a step later. Then `gap` is the gap then, along the axis that parts the boxes most
            then, among those that part them now (or, if none does, that part them least badly):
            boxes that would pass through each other within the step do not.

    Returns:
        The contact; normal and point are now's.
    """
    xp = namespace(pair.offset[0])
    axes = box_axes(pair, _PARALLEL if ahead is None else _SWINGING)
    now = axes.gaps()
    side = tuple(1 - 2 * weight(x < 0, x) for x in axes.offset)
    score = now
    if ahead is not None:
        parts = now[0]
        for gap in now[1:]:
            parts = xp.maximum(parts, gap)
        least = xp.minimum(parts, 0) - _FACES_FIRST
        parting = [weight(n >= least, n) for n in now]
        later = box_axes(ahead).gaps(side)
        score = tuple(w * x - 1e3 * (1 - w) for w, x in zip(parting, later, strict=True))
    turn = _relative(pair)
    best, taken = score[0], []
    for k in range(1, 15):
        better = weight(score[k] > best + (_FACES_FIRST if k > 5 else 0), best)
        best = better * score[k] + (1 - better) * best
        taken.append(better)
    share = last_of(taken)
    start = _sum(share, now)
    signed = [x * y for x, y in zip(share, side, strict=True)]
    normal = _axis(turn, signed)
    # The feature that touches first is the one that reaches farthest at the end of the step.
    turn_ahead = turn if ahead is None else _relative(ahead)
    toward = normal if ahead is None else _axis(turn_ahead, signed)
    # The features that face each other, in the first box's frame.
    t = matTvec(pair.first, pair.offset)
    back = transpose(turn)
    one, spread = _feature(toward, pair.first_half)
    backward = matTvec(turn_ahead, tuple(-x for x in toward))
    other, other_spread = _feature(backward, pair.second_half)
    away = vsub(vadd(t, matvec(turn, other)), one)
    on_first = _common(spread, away, turn, other_spread)
    on_second = _common(other_spread, matvec(back, tuple(-x for x in away)), back, spread)
    on_second = vadd(away, matvec(turn, on_second))
    # Of two edges, the point of the first that is nearest to the second.
    edge = tuple(sum(share[6 + 3 * i : 9 + 3 * i]) for i in range(3))
    other_edge = matvec(turn, tuple(sum(share[6 + j :: 3]) for j in range(3)))
    kinds = sum(share[:3]), sum(share[3:6]), sum(edge)
    cosine = dot(edge, other_edge)
    way = dot(edge, away) - cosine * dot(other_edge, away)
    way = way / (1 - kinds[2] * cosine * cosine)
    reach = dot(edge, spread)
    crossing = vscale(xp.clip(way, -reach, reach), edge)
    point = tuple(_sum(kinds, x) for x in zip(on_first, on_second, crossing, strict=True))
    # In the middle between the two along the normal.
    point = vadd(point, vscale(0.5 * dot(normal, away) - dot(normal, point), normal))
    return BoxContact(best, start, matvec(pair.first, normal), matvec(pair.first, vadd(one, point)))


def last_of(better: Sequence[Scalar]) -> list[Scalar]:
    """One-hot weights of the last candidate that was better than all before it.

    Args:
        better: 1 or 0 for each candidate but the first.

    Returns:
        1 or 0 for each candidate, the first included.
    """
    xp = namespace(better[0])
    share, left = [], xp.ones_like(better[0])
    for x in reversed(better):
        share.append(left * x)
        left = left * (1 - x)
    return [left, *reversed(share)]


def _sum(weights: Sequence[Scalar], values: Sequence[Scalar]) -> Scalar:
    """Sum of products."""
    return sum(w * x for w, x in zip(weights, values, strict=True))


def _axis(turn: Mat, share: Sequence[Scalar]) -> Vec:
    """The weighted sum of the 15 axes, which are unit vectors in the first box's frame."""
    xp = namespace(turn[0][0])
    found = vadd(tuple(share[:3]), matvec(turn, tuple(share[3:6])))
    for i in range(3):
        scaled = []
        for j in range(3):
            square = 1 - turn[i][j] * turn[i][j]
            scaled.append(share[6 + 3 * i + j] / xp.sqrt(xp.maximum(square, _PARALLEL)))
        # e_i × Σ of the second box's axes.
        x = matvec(turn, tuple(scaled))
        i1, i2 = (i + 1) % 3, (i + 2) % 3
        parts = list(found)
        parts[i1], parts[i2] = parts[i1] - x[i2], parts[i2] + x[i1]
        found = tuple(parts)
    return found


def _feature(normal: Vec, half: Vec) -> tuple[Vec, Vec]:
    """Middle of a box's corner, edge or face that lies farthest along a direction; its half edges.

    Both in the box's frame.
    """
    xp = namespace(normal[0])
    share = tuple(xp.clip(x / _FLAT, -1, 1) for x in normal)
    middle = tuple(s * h for s, h in zip(share, half, strict=True))
    return middle, tuple((1 - xp.abs(s)) * h for s, h in zip(share, half, strict=True))


def _common(spread: Vec, away: Vec, turn: Mat, other_spread: Vec) -> Vec:
    """Middle of the overlap of two features, relative to the middle of the first, its box's axes.

    `away` leads from the middle of the first feature to that of the second, `turn` turns the
    second's axes into the first's, and both spreads are half edges of the features.
    """
    xp = namespace(away[0])
    found = []
    for i in range(3):
        reach = dot(tuple(xp.abs(x) for x in turn[i]), other_spread)
        low = xp.maximum(-spread[i], away[i] - reach)
        high = xp.minimum(spread[i], away[i] + reach)
        # Without an overlap, the nearer end of the other feature: the gap is that at its corner.
        found.append(xp.clip(0.5 * (low + high), away[i] - reach, away[i] + reach))
    return tuple(found)


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
        The pairs, by components.
    """
    vec = lambda x: tuple(x[..., i] for i in range(3))  # noqa: E731
    mat = lambda x: tuple(tuple(x[..., i, j] for j in range(3)) for i in range(3))  # noqa: E731
    return BoxPair(vec(centers - center), mat(rotation), mat(rotations), vec(half), vec(halves))
