"""Geometry of boxes: quarter turns, unions of aligned boxes, overlap of turned ones."""

from __future__ import annotations

import numpy as np


def quarter_turn(axis: np.ndarray, quarters: int) -> np.ndarray:
    """Rotation `[3, 3]` by quarter turns about a unit vector (Rodrigues), exact for x, y and z.

    Args:
        axis: `[3]` unit vector.
        quarters: 0 to 3.
    """
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters]
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return cos * np.eye(3) + sin * cross + (1 - cos) * np.outer(axis, axis)


def union_measure(low: np.ndarray, high: np.ndarray) -> float:
    """Area (or volume) of the union of `[n, d]` axis-aligned boxes, exactly.

    The boxes' edges cut space into cells; a cell counts when a box covers it.

    Args:
        low: `[n, d]` lowest corners [m].
        high: `[n, d]` highest corners [m].

    Returns:
        The measure [m^d].
    """
    axes = range(low.shape[1])
    edges = [np.unique(np.concatenate([low[:, i], high[:, i]])) for i in axes]
    covered = np.zeros([len(e) - 1 for e in edges], bool)
    for a, b in zip(low, high, strict=True):
        cell = (slice(*np.searchsorted(edges[i], [a[i], b[i]])) for i in axes)
        covered[tuple(cell)] = True
    for widths in map(np.diff, reversed(edges)):
        covered = covered @ widths
    return float(covered)


def boxes_overlap(
    center: np.ndarray,
    rotation: np.ndarray,
    half: np.ndarray,
    centers: np.ndarray,
    rotations: np.ndarray,
    halves: np.ndarray,
) -> np.ndarray:
    """Separating axis theorem for `n` pairs of boxes, or for one box against `n` others.

    Two boxes are apart when their projections are apart on one of 15 axes: three normals of each
    and the nine cross products of their edges (Gottschalk, Lin and Manocha 1996, SIGGRAPH).

    Args:
        center: `[n, 3]` or `[3]` centres of the first boxes [m].
        rotation: `[n, 3, 3]` or `[3, 3]` their axes as columns.
        half: `[n, 3]` or `[3]` their half edges [m].
        centers: `[n, 3]` centres of the second boxes [m].
        rotations: `[n, 3, 3]` their axes as columns.
        halves: `[n, 3]` their half edges [m].

    Returns:
        `[n]` whether they overlap by more than 1 nm.
    """
    theirs = np.swapaxes(rotations, 1, 2)
    mine = np.broadcast_to(np.swapaxes(rotation, -1, -2), theirs.shape)
    crossed = np.cross(mine[:, :, None], theirs[:, None, :]).reshape(-1, 9, 3)
    axes = np.concatenate([mine, theirs, crossed], axis=1)  # [n, 15, 3]
    length = np.linalg.norm(axes, axis=2)
    halfs = np.broadcast_to(half, halves.shape)
    shadow_a = np.einsum("nki,ni->nk", np.abs(np.einsum("nkx,nix->nki", axes, mine)), halfs)
    shadow_b = np.einsum("nki,ni->nk", np.abs(np.einsum("nkx,nix->nki", axes, theirs)), halves)
    gap = np.abs(np.einsum("nkx,nx->nk", axes, centers - center)) - shadow_a - shadow_b
    # Parallel edges have no cross product and separate nothing.
    return np.all((gap < -1e-9 * length) | (length < 1e-9), axis=1)
