"""The share of each face that is exposed to the water: modules cover the faces by which they join.

Without it, a chain of modules would have the frontal drag of every module in it, and a limb the
same drag along and across its length. Undulatory swimming depends on that difference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjx_revolve.body.placement import RestPose, pairs_within, turned

# A face is covered where a neighbour is found at one of these distances in front of it [m]:
# Revolve's joints leave up to 2 mm, or sink a plate of 1 mm into the neighbour's face; limbs keep
# further apart.
_DISTANCES = np.array([-2e-3, -1e-3, 0.0, 1e-3, 2e-3])
# Points along each edge of a face; an exposed share is known to about one in this many.
_POINTS = 24  # at most 31: a row of them is a number
_BITS = 1 << np.arange(_POINTS + 1, dtype=np.uint32)
# For each axis of a part, the two others.
_BESIDE = ((1, 2), (0, 2), (0, 1))
# Tolerance [m], so that flush neighbours count in spite of rounding.
_SLACK = 1e-6


class Exposure(NamedTuple):
    """Exposure of parts at rest, `[npart, 3]` along each part's x, y and z axes.

    A row is a straight line of parts, each of which covers a share of the next one's end. Parts of
    all modules in order.

    Attributes:
        shares: share of the silhouette that no other part covers [-]. Opposite faces are averaged,
            as drag and added mass are the same in both directions.
        joined: share of a part's ends that its neighbours in the row cover [-]; 1 for a part that
            is a row by itself.
        ends: 1 or -1 where a row ends with this part, in that direction; 0 elsewhere.
        rows: length of the row [m]; of a single part its own.
    """

    shares: np.ndarray
    joined: np.ndarray
    ends: np.ndarray
    rows: np.ndarray


def exposure(parts: RestPose) -> Exposure:
    """The exposed share of each part's faces, and the rows that parts form.

    A choice: computed at rest and used for all poses; a bent hinge exposes a little more.

    Args:
        parts: of one body, `Morphology.layout`, or of several.
    """
    part, box, center, turn = _near(parts)
    # Boxes parallel to a face cover a rectangle of it: each axis is tested on its own.
    square = (np.abs(turn - np.round(turn)) < 1e-9).all(axis=(1, 2))
    reach = turned(np.abs(turn), parts.box_half[box]) + _SLACK
    own = parts.box_part
    solid = _spans(parts, own, parts.box_position, parts.box_half)
    silhouette = np.stack([_rectangles(solid[:, a], solid[:, b]) for a, b in _BESIDE], 1)
    silhouette = np.bitwise_or.reduceat(silhouette, parts.main)  # [npart, 3, points]
    heights = np.stack([parts.low, parts.high], 1)[:, :, None]  # [npart, 2, distances, 3]
    heights = heights + (np.array([[-1], [1]]) * _DISTANCES)[..., None]
    before = (np.abs(heights[part] - center[:, None, None]) <= reach[:, None, None]).any(2)
    thin = parts.high - parts.low < 2 * _DISTANCES[-1]
    side, axis, pair = np.nonzero((before & square[:, None, None]).transpose(1, 2, 0))
    covered = np.zeros((len(parts.low), 2, 3, _POINTS), np.uint32)
    neighbour = np.full((len(parts.low), 2, 3), -1)
    if len(pair):  # pairs of one part, side and axis are contiguous
        within = _spans(parts, part, center, reach)
        beside = np.array(_BESIDE)[axis]
        hits = _rectangles(within[pair, beside[:, 0]], within[pair, beside[:, 1]])
        # What a thin plate is mounted on is near its free face, too, but lies behind the other and
        # ends short of it.
        ends = np.stack([-parts.low, parts.high])[side, part[pair], axis]
        out = np.where(side, center[pair, axis], -center[pair, axis])
        behind = thin[part[pair], axis] & (out < ends - (parts.high - parts.low)[part[pair], axis])
        behind &= out + reach[pair, axis] < ends
        hits = np.where(behind[:, None], np.uint32(0), hits)
        face = (part[pair] * 2 + side) * 3 + axis
        start = np.flatnonzero(np.append(True, np.diff(face)))
        covered.reshape(-1, _POINTS)[face[start]] = np.bitwise_or.reduceat(hits, start)
        # The last write holds: the box that covers most of a face. Boxes that only reach past an
        # edge have their centres beside the part, not in front of it.
        most = np.argsort(np.bitwise_count(hits).sum(1), kind="stable")
        most = most[(hits.any(1) & (out > ends))[most]]
        neighbour.reshape(-1)[face[most]] = parts.box_part[box[pair[most]]]
    for k in np.flatnonzero(~square):
        low, high = parts.low[part[k]], parts.high[part[k]]
        grid = low + ((np.arange(_POINTS) + 0.5) / _POINTS)[:, None] * (high - low)
        for side, axis in np.ndindex(2, 3):
            out = center[k, axis] if side else -center[k, axis]
            near, far = (low[axis], high[axis]) if side else (-high[axis], -low[axis])
            if thin[part[k], axis] and out < near and out + reach[k, axis] < far:
                continue
            one, two = _BESIDE[axis]
            points = np.empty((len(_DISTANCES), _POINTS, _POINTS, 3))
            points[..., axis] = heights[part[k], side, :, axis, None, None]
            points[..., one], points[..., two] = grid[:, None, one], grid[:, two]
            inside = np.abs((points - center[k]) @ turn[k]) <= parts.box_half[box[k]] + _SLACK
            covered[part[k], side, axis] |= inside.all(axis=-1).any(axis=0) @ _BITS[:-1]
    hidden = np.bitwise_count(covered & silhouette[:, None]).sum(axis=-1)
    whole = np.maximum(np.bitwise_count(silhouette).sum(axis=-1), 1)
    near, cover = neighbour >= 0, hidden / whole[:, None]
    joined = np.where(near.any(1), (near * cover).sum(1) / np.maximum(near.sum(1), 1), 1.0)
    shares = 1 - hidden.sum(axis=1) / (2 * whole)
    ends = np.where(near.any(1), near[:, 0].astype(int) - near[:, 1], 0)
    return Exposure(shares, joined, ends, _row_lengths(parts, neighbour))


def _row_lengths(parts: RestPose, neighbour: np.ndarray) -> np.ndarray:
    """`[npart, 3]` lengths of rows [m].

    `neighbour` is the part that covers most of each face; -1 for none.
    """
    size = parts.high - parts.low
    length = size.copy()
    part, axis = (x.ravel() for x in np.indices(size.shape))
    for outward in (-1, 1):
        at, toward = part, outward * parts.rotation[part, :, axis]
        going = np.ones(len(at), bool)
        # A line meets each part once.
        for _ in range(len(size)):
            local = np.einsum("ni,nij->nj", toward, parts.rotation[at])
            along = np.abs(local).argmax(1)
            ahead = local[np.arange(len(at)), along] > 0
            further = neighbour[at, ahead.astype(int), along]
            going &= further >= 0
            if not going.any():
                break
            at = np.where(going, further, at)
            entered = np.abs(np.einsum("ni,nij->nj", toward, parts.rotation[at])).argmax(1)
            length[part, axis] += np.where(going, size[at, entered], 0)
    return length


def _near(parts: RestPose) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Candidate pairs: a part, and a box of another part that may cover one of its faces.

    Returns:
        `[pair]` parts and `[pair]` boxes; `[pair, 3]` centre [m] and `[pair, 3, 3]` rotation of the
        box in the part's frame.
    """
    place, boxes_reach = parts.box_centers(), parts.box_reaches()
    # The part's bounding box, thicker by the largest distance, in the core's frame.
    middle, half = (parts.low + parts.high) / 2, (parts.high - parts.low) / 2
    middle = parts.position + turned(parts.rotation, middle)
    reach = turned(np.abs(parts.rotation), half + _DISTANCES.max() + 10 * _SLACK)
    part, box = pairs_within(parts.body, parts.body[parts.box_part])
    near = parts.box_part[box] != part
    for axis in range(3):
        gap = np.abs(middle[part, axis] - place[box, axis])
        near &= gap < reach[part, axis] + boxes_reach[box, axis]
    part, box = part[near], box[near]
    back = parts.rotation[part].swapaxes(1, 2)
    center = turned(back, place[box] - parts.position[part])
    return part, box, center, back @ parts.rotation[parts.box_part[box]]


def _spans(parts: RestPose, part: np.ndarray, center: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """The sample points along each edge of a part that a box covers.

    Args:
        parts: all parts.
        part: `[n]` indices of parts.
        center: `[n, 3]` centre of a box, part frame [m].
        reach: `[n, 3]` half extents of that box along the part's axes [m].

    Returns:
        `[n, 3]` points as bits.
    """
    low = parts.low[part]
    step = (parts.high[part] - low) / _POINTS
    first = np.ceil((center - reach - low) / step - 0.5).clip(0, _POINTS).astype(np.uint32)
    stop = np.floor((center + reach - low) / step + 0.5).clip(0, _POINTS).astype(np.uint32)
    return np.where(first < stop, _BITS[stop] - _BITS[first], 0)


def _rectangles(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """`[n, points]` bit sets of the points in `[n]` rows and `[n]` columns."""
    return (rows[:, None] >> np.arange(_POINTS, dtype=np.uint32) & 1) * columns[:, None]
