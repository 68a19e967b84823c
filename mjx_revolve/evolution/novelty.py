"""Novelty: the mean distance of an individual to its nearest neighbours.

After Lehman and Stanley, "Abandoning objectives: evolution through the search for novelty alone",
Evolutionary Computation 19(2), 2011.
"""

from __future__ import annotations

import numpy as np


def novelty(
    points: np.ndarray, others: np.ndarray, neighbours: int, scale: np.ndarray
) -> np.ndarray:
    """Mean distances to the nearest neighbours.

    Args:
        points: `[N, D]` descriptors of individuals. One with a value that is not finite has
            novelty 0, and is not a neighbour of others.
        others: `[K, D]` of further ones that may be neighbours, such as an archive's.
        neighbours: how many of the nearest; fewer where there are not so many.
        scale: `[D]` a distance of 1 along each axis, see `axis_scale`.

    Returns:
        `[N]` Euclidean distances; 0 where there is no neighbour.
    """
    from scipy.spatial.distance import cdist

    found = np.zeros(len(points))
    placed = np.isfinite(points).all(1)
    own = points[placed] / scale
    distances = cdist(own, np.concatenate([own, others[np.isfinite(others).all(1)] / scale]))
    np.fill_diagonal(distances, np.inf)  # no individual is its own neighbour
    count = min(neighbours, distances.shape[1] - 1)
    if count > 0:
        nearest = np.partition(distances, count - 1, axis=1)[:, :count]
        found[placed] = np.sort(nearest, axis=1).mean(1)
    return found


def axis_scale(points: np.ndarray) -> np.ndarray:
    """Standard deviations `[D]` of points `[N, D]` along each axis; 1 where all are equal."""
    placed = points[np.isfinite(points).all(1)]
    if not len(placed):
        return np.ones(points.shape[1])
    deviation = placed.std(0)
    # Rounding leaves a tiny deviation of equal values.
    tiny = 1e-12 * np.abs(placed).max(0)
    return np.where(deviation > tiny, deviation, 1.0)
