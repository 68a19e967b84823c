"""Which faces the water reaches: modules hide the faces by which they are joined.

Without this, a chain of modules would meet the water head-on with the front of every module in it,
and a limb would be no harder to move sideways than lengthwise; swimming lives on that difference.
"""

from __future__ import annotations

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
# A hair of slack [m], so that flush neighbours count whatever the rounding.
_SLACK = 1e-6


def exposed_shares(parts: RestPose) -> np.ndarray:
    """The share of each part's faces that no other part covers, at rest.

    A choice: the pose at rest stands for all poses; a bent hinge opens a little more. Opposite
    faces are averaged, as drag and added mass are the same in both directions.

    Args:
        parts: of one body, `Morphology.layout`, or of several.

    Returns:
        `[npart, 3]` exposed share of the silhouette along each part's x, y and z axes [-], parts of
        all modules in order.
    """
    part, box, center, turn = _near(parts)
    # Boxes that stand square to a face cover a rectangle of it: each axis tells on its own.
    square = (np.abs(turn - np.round(turn)) < 1e-9).all(axis=(1, 2))
    reach = turned(np.abs(turn), parts.box_half[box]) + _SLACK
    own = parts.box_part
    solid = _spans(parts, own, parts.box_position, parts.box_half)
    silhouette = np.stack([_rectangles(solid[:, a], solid[:, b]) for a, b in _BESIDE], 1)
    silhouette = np.bitwise_or.reduceat(silhouette, parts.main)  # [npart, 3, points]
    heights = np.stack([parts.low, parts.high], 1)[:, :, None]  # [npart, 2, distances, 3]
    heights = heights + (np.array([[-1], [1]]) * _DISTANCES)[..., None]
    before = (np.abs(heights[part] - center[:, None, None]) <= reach[:, None, None]).any(2)
    side, axis, pair = np.nonzero((before & square[:, None, None]).transpose(1, 2, 0))
    covered = np.zeros((len(parts.low), 2, 3, _POINTS), np.uint32)
    if len(pair):  # those of a part, a side and an axis stand together, as those of a part do
        within = _spans(parts, part, center, reach)
        beside = np.array(_BESIDE)[axis]
        hits = _rectangles(within[pair, beside[:, 0]], within[pair, beside[:, 1]])
        face = (part[pair] * 2 + side) * 3 + axis
        start = np.flatnonzero(np.append(True, np.diff(face)))
        covered.reshape(-1, _POINTS)[face[start]] = np.bitwise_or.reduceat(hits, start)
    for k in np.flatnonzero(~square):
        low, high = parts.low[part[k]], parts.high[part[k]]
        grid = low + ((np.arange(_POINTS) + 0.5) / _POINTS)[:, None] * (high - low)
        for side, axis in np.ndindex(2, 3):
            one, two = _BESIDE[axis]
            points = np.empty((len(_DISTANCES), _POINTS, _POINTS, 3))
            points[..., axis] = heights[part[k], side, :, axis, None, None]
            points[..., one], points[..., two] = grid[:, None, one], grid[:, two]
            inside = np.abs((points - center[k]) @ turn[k]) <= parts.box_half[box[k]] + _SLACK
            covered[part[k], side, axis] |= inside.all(axis=-1).any(axis=0) @ _BITS[:-1]
    hidden = np.bitwise_count(covered & silhouette[:, None]).sum(axis=-1)
    whole = np.maximum(np.bitwise_count(silhouette).sum(axis=-1), 1)
    return 1 - hidden.sum(axis=1) / (2 * whole)


def _near(parts: RestPose) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Parts and boxes of other parts that may cover a face of theirs.

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
    """Which points along each edge of parts some boxes reach.

    Args:
        parts: all of them.
        part: `[n]` which.
        center: `[n, 3]` of a box, part frame [m].
        reach: `[n, 3]` of it from there along the part's axes [m].

    Returns:
        `[n, 3]` points as bits.
    """
    low = parts.low[part]
    step = (parts.high[part] - low) / _POINTS
    first = np.ceil((center - reach - low) / step - 0.5).clip(0, _POINTS).astype(np.uint32)
    stop = np.floor((center + reach - low) / step + 0.5).clip(0, _POINTS).astype(np.uint32)
    return np.where(first < stop, _BITS[stop] - _BITS[first], 0)


def _rectangles(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """`[n, points]` the points of `[n]` rows and `[n]` columns, bits are the columns."""
    return (rows[:, None] >> np.arange(_POINTS, dtype=np.uint32) & 1) * columns[:, None]
