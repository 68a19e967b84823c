"""Which faces the water reaches: modules hide the faces by which they are joined.

Without this, a chain of modules would meet the water head-on with the front of every module in it,
and a limb would be no harder to move sideways than lengthwise; swimming lives on that difference.
"""

from __future__ import annotations

import numpy as np

from mjx_revolve.body.placement import Layout, pairs_within, turned

# A face is covered where a neighbour is found at one of these distances in front of it [m]:
# Revolve's joints leave up to 2 mm, or sink a plate of 1 mm into the neighbour's face; limbs keep
# further apart.
_DISTANCES = np.array([-2e-3, -1e-3, 0.0, 1e-3, 2e-3])
# Points along each edge of a face; an exposed share is known to about one in this many.
_POINTS = 24  # a multiple of 8, at most 32: a row of them is a number
# For each axis of a part, the two others.
_BESIDE = ((1, 2), (0, 2), (0, 1))
# A hair of slack [m], so that flush neighbours count whatever the rounding.
_SLACK = 1e-6


def exposed_shares(parts: Layout) -> np.ndarray:
    """The share of each part's faces that no other part covers, at rest.

    A choice: the pose at rest stands for all poses; a bent hinge opens a little more. Opposite
    faces are averaged, as drag and added mass are the same in both directions. `Morphology.exposed`
    keeps them.

    Args:
        parts: of the robot, `Morphology.layout`.

    Returns:
        `[npart, 3]` exposed share of the silhouette along each part's x, y and z axes [-], parts of
        all modules in order.
    """
    part, box, center, turn = _near(parts)
    # Boxes that stand square to a face cover a rectangle of it: each axis tells on its own.
    square = (np.abs(turn - np.round(turn)) < 1e-9).all(axis=(1, 2))
    reach = turned(np.abs(turn), parts.box_half[box] + _SLACK)[:, None]
    ticks = ((np.arange(_POINTS) + 0.5) / _POINTS)[:, None]
    grid = parts.low[:, None] + ticks * (parts.high - parts.low)[:, None]  # [npart, points, 3]
    own = parts.box_part
    solid = np.abs(grid[own] - parts.box_position[:, None]) <= parts.box_half[:, None]
    silhouette = np.bitwise_or.reduceat(_crossed(solid), parts.main)  # [npart, 3, points]
    # Faces are numbered by part, side and axis.
    sides = np.stack([parts.low, parts.high], 1)  # [npart, 2, 3]
    heights = sides[:, :, None] + (np.array([[-1], [1]]) * _DISTANCES)[..., None]
    before = (np.abs(heights[part] - center[:, None, None]) <= reach[:, None]).any(2)
    covered = np.zeros((len(sides), 2, 3, _POINTS), np.uint32)
    within = _crossed(np.abs(grid[part] - center[:, None]) <= reach)
    side, axis, pair = np.nonzero((before & square[:, None, None]).transpose(1, 2, 0))
    if len(pair):  # pairs of a part, a side and an axis stand together, as pairs of a part do
        number = (part[pair] * 2 + side) * 3 + axis
        start = np.flatnonzero(np.append(True, np.diff(number)))
        found = np.bitwise_or.reduceat(within[pair, axis], start)
        covered.reshape(-1, _POINTS)[number[start]] = found
    for k, side, axis in np.ndindex(len(part), 2, 3) if not square.all() else ():
        if square[k]:
            continue
        beside = _BESIDE[axis]
        face = np.empty((len(_DISTANCES), _POINTS, _POINTS, 3))
        face[..., axis] = heights[part[k], side, :, axis, None, None]
        face[..., beside[0]] = grid[part[k], :, None, beside[0]]
        face[..., beside[1]] = grid[part[k], None, :, beside[1]]
        inside = np.abs((face - center[k]) @ turn[k]) <= parts.box_half[box[k]] + _SLACK
        covered[part[k], side, axis] |= _packed(inside.all(axis=-1).any(axis=0))
    hidden = np.bitwise_count(covered & silhouette[:, None]).sum(axis=-1)
    whole = np.maximum(np.bitwise_count(silhouette).sum(axis=-1), 1)
    return 1 - hidden.sum(axis=1) / (2 * whole)


def _near(parts: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
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


def _crossed(inside: np.ndarray) -> np.ndarray:
    """`[n, 3, points]` points of the faces across each axis that are inside along both others.

    Args:
        inside: `[n, points, 3]` along each axis; bits of the result are the points along the second
            of the two.
    """
    bits = _packed(inside.swapaxes(1, 2))
    rows = [inside[:, :, a] * bits[:, b, None] for a, b in _BESIDE]
    return np.stack(rows, 1)


def _packed(inside: np.ndarray) -> np.ndarray:
    """`[..., points]` truth values as bits."""
    found = np.zeros((*inside.shape[:-1], 4), np.uint8)
    found[..., : _POINTS // 8] = np.packbits(inside, axis=-1, bitorder="little")
    bits: np.ndarray = found.view("<u4")[..., 0]
    return bits
