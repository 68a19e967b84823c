"""Matrices over pairs of hinges that share a rigid body, column by column."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from mjx_revolve.engine.plant import Plant

NeighbourMatrix = Mapping[int, jax.Array]
"""Nonzero columns by hinge row, `[hinge rows, lanes]` each."""


def pair_matrix(onto_first: jax.Array, onto_second: jax.Array, plant: Plant) -> NeighbourMatrix:
    """The matrix of weights of pairs.

    Args:
        onto_first: `[num_pairs, lanes]` from the later hinge of a pair to the earlier one.
        onto_second: `[num_pairs, lanes]` from the earlier one to the later one.
        plant: of the pairs.
    """
    rows, lanes = plant.num_hinge_rows, onto_first.shape[1:]
    if not plant.num_pairs:
        return {}
    wide = lambda x: jnp.broadcast_to(jnp.asarray(x), onto_first.shape)  # noqa: E731
    i, j = wide(plant.first), wide(plant.second)
    lane = jnp.arange(lanes[0]) if lanes else 0
    matrix = jnp.zeros((rows, rows, *lanes), onto_first.dtype)
    # An index past the end means no pair.
    matrix = matrix.at[i, j, lane].add(onto_first, mode="drop")
    matrix = matrix.at[j, i, lane].add(onto_second, mode="drop")
    if isinstance(plant.first, jax.Array):
        acting = list(range(rows))
    else:
        acting = sorted({*plant.first.ravel().tolist(), *plant.second.ravel().tolist()})
    return {j: matrix[:, j] for j in acting}


def neighbour_mean(like: jax.Array, plant: Plant) -> NeighbourMatrix:
    """The matrix that takes the mean over each hinge's neighbours; 0 for those without.

    Args:
        like: `[..., lanes]` of the floating-point type.
        plant: of the pairs.
    """
    ones = jnp.ones((plant.num_pairs, *like.shape[1:]), like.dtype)
    columns = pair_matrix(ones, ones, plant)
    if not columns:
        return {}
    count = jnp.maximum(sum(columns.values()), 1)
    return {j: column / count for j, column in columns.items()}


def apply_matrix(columns: NeighbourMatrix, values: jax.Array) -> jax.Array:
    """The matrix times `[hinge rows, lanes]`. No reductions inside the compiled loop."""
    found = jnp.zeros_like(values)
    for j, column in columns.items():
        found = found + column * values[j : j + 1]
    return found
