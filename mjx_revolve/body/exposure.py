"""Which faces the water reaches: modules hide the faces by which they are joined.

Without this, a chain of modules would meet the water head-on with the front of every module in it,
and a limb would be no harder to move sideways than lengthwise; swimming lives on that difference.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mjx_revolve.body.morphology import Morphology

# A face is covered where a neighbour is found at one of these distances in front of it [m]:
# Revolve's joints leave up to 2 mm, or sink a plate of 1 mm into the neighbour's face; limbs keep
# further apart.
_DISTANCES = (-2e-3, -1e-3, 0.0, 1e-3, 2e-3)
# Points along each edge of a face; an exposed share is known to about one in this many.
_POINTS = 24


def exposed_shares(morphology: Morphology) -> list[np.ndarray]:
    """The share of each part's faces that no other part covers, at rest.

    A choice: the pose at rest stands for all poses; a bent hinge opens a little more. Opposite
    faces are averaged, as drag and added mass are the same in both directions.

    Args:
        morphology: the robot.

    Returns:
        For each part of each module, in order, `[3]` exposed share of the silhouette along the
        part's x, y and z axes [-].
    """
    parts: list[dict[str, Any]] = []
    for module in morphology.modules:
        for part in module.kind.parts:
            boxes = [(np.asarray(box.position), np.asarray(box.size) / 2) for box in part.boxes]
            parts.append(
                {
                    "center": module.position + module.rotation @ np.asarray(part.position),
                    "rotation": module.rotation,
                    "boxes": boxes,
                    "bounds": tuple(np.asarray(x) for x in part.bounds),
                }
            )
    centers = np.array([part["center"] for part in parts])
    radii = np.array([np.linalg.norm(np.abs(part["bounds"]).max(0)) for part in parts])
    radii += max(_DISTANCES)
    shares = []
    for i, here in enumerate(parts):
        apart = np.linalg.norm(centers - here["center"], axis=1)
        near = [parts[j] for j in np.flatnonzero(apart < radii + radii[i]) if j != i]
        shares.append(np.array([_exposed_share(here, near, axis) for axis in range(3)]))
    return shares


def _exposed_share(part: dict[str, Any], near: list[dict[str, Any]], axis: int) -> float:
    """Mean over both faces of the silhouette along an axis."""
    low, high = part["bounds"]
    beside = [a for a in range(3) if a != axis]
    ticks = (np.arange(_POINTS) + 0.5) / _POINTS
    grid = np.stack(np.meshgrid(ticks, ticks, indexing="ij"), -1).reshape(-1, 2)
    points = np.zeros((len(grid), 3))
    points[:, beside] = low[beside] + grid * (high - low)[beside]
    silhouette = np.zeros(len(points), bool)
    for position, half in part["boxes"]:
        silhouette |= np.all(np.abs(points[:, beside] - position[beside]) <= half[beside], axis=1)
    count = int(silhouette.sum())
    shown = []
    for side, out in ((low, -1), (high, 1)):
        faces = np.repeat(points[None, silhouette], len(_DISTANCES), 0)
        faces[:, :, axis] = side[axis] + out * np.array(_DISTANCES)[:, None]
        faces = part["center"] + faces.reshape(-1, 3) @ part["rotation"].T
        covered = np.zeros(len(faces), bool)
        for other in near:
            local = (faces - other["center"]) @ other["rotation"]
            for position, half in other["boxes"]:
                # A hair of slack, so that flush neighbours count whatever the rounding.
                x, y, z = (np.abs(local - position) <= half + 1e-6).T
                covered |= x & y & z
        shown.append(1 - covered.reshape(-1, count).any(0).mean())
    return float(np.mean(shown))
