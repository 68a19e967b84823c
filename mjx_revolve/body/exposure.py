"""Which faces the water reaches: modules hide the faces by which they are joined.

Without this, a chain of modules would meet the water head-on with the front of every module in it,
and a limb would be no harder to move sideways than lengthwise; swimming lives on that difference.
"""

from __future__ import annotations

import numpy as np

from mjx_revolve.body.placement import Layout

# A face is covered where a neighbour is found at one of these distances in front of it [m]:
# Revolve's joints leave up to 2 mm, or sink a plate of 1 mm into the neighbour's face; limbs keep
# further apart.
_DISTANCES = np.array([-2e-3, -1e-3, 0.0, 1e-3, 2e-3])
# Points along each edge of a face; an exposed share is known to about one in this many.
_POINTS = 24
_BITS = 1 << np.arange(_POINTS)
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
    reach = np.einsum("pij,pj->pi", np.abs(turn), parts.box_half[box] + _SLACK)[:, None]
    ticks = ((np.arange(_POINTS) + 0.5) / _POINTS)[:, None]
    grid = parts.low[:, None] + ticks * (parts.high - parts.low)[:, None]  # [npart, points, 3]
    within = np.abs(grid[part] - center[:, None]) <= reach  # [pair, points, 3]
    own = parts.box_part
    solid = np.abs(grid[own] - parts.box_position[:, None]) <= parts.box_half[:, None]
    shares = np.empty((len(grid), 3))
    for axis in range(3):
        beside = [a for a in range(3) if a != axis]
        silhouette = np.bitwise_or.reduceat(_cross(solid, beside), parts.main)
        shown = []
        for side, out in ((parts.low, -1), (parts.high, 1)):
            height = side[:, None, axis] + out * _DISTANCES  # [npart, distances]
            before = np.abs(height[part] - center[:, None, axis]) <= reach[:, :, axis]
            covered = np.zeros_like(silhouette)
            some = np.flatnonzero(square & before.any(axis=1))
            np.bitwise_or.at(covered, part[some], _cross(within[some], beside))
            for k in np.flatnonzero(~square):
                face = np.empty((len(_DISTANCES), _POINTS, _POINTS, 3))
                face[..., axis] = height[part[k], :, None, None]
                face[..., beside[0]] = grid[part[k], :, None, beside[0]]
                face[..., beside[1]] = grid[part[k], None, :, beside[1]]
                inside = np.abs((face - center[k]) @ turn[k]) <= parts.box_half[box[k]] + _SLACK
                covered[part[k]] |= inside.all(axis=-1).any(axis=0) @ _BITS
            hidden = np.bitwise_count(covered & silhouette).sum(axis=1)
            shown.append(1 - hidden / np.maximum(np.bitwise_count(silhouette).sum(axis=1), 1))
        shares[:, axis] = np.mean(shown, axis=0)
    return shares


def _near(parts: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Parts and boxes of other parts that may cover a face of theirs.

    Returns:
        `[pair]` parts and `[pair]` boxes; `[pair, 3]` centre [m] and `[pair, 3, 3]` rotation of the
        box in the part's frame.
    """
    place = parts.box_centers()
    # The part's bounding box, thicker by the largest distance, in the core's frame.
    middle, half = (parts.low + parts.high) / 2, (parts.high - parts.low) / 2
    middle = parts.position + np.einsum("pij,pj->pi", parts.rotation, middle)
    grown = half + _DISTANCES.max() + 10 * _SLACK
    reach = np.einsum("pij,pj->pi", np.abs(parts.rotation), grown)
    gap = np.abs(middle[:, None] - place) - reach[:, None] - parts.box_reaches()
    near = (gap < 0).all(axis=2) & (parts.box_part != np.arange(len(middle))[:, None])
    part, box = np.nonzero(near)
    back = np.swapaxes(parts.rotation[part], 1, 2)
    center = np.einsum("pij,pj->pi", back, place[box] - parts.position[part])
    return part, box, center, back @ parts.rotation[parts.box_part[box]]


def _cross(inside: np.ndarray, beside: list[int]) -> np.ndarray:
    """`[n, points]` points of a face that are inside along both axes; bits are its columns."""
    rows = inside[:, :, beside[1]] @ _BITS
    return np.where(inside[:, :, beside[0]], rows[:, None], 0)
