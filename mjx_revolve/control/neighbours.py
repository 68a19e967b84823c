"""How joints that share a rigid body act on each other: matrices, column by column."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from mjx_revolve.engine.plant import Plant

Columns = Mapping[int, jax.Array]
"""For each hinge row that may act on others, `[hinge rows, lanes]` how it does."""


def join_pairs(onto_first: jax.Array, onto_second: jax.Array, plant: Plant) -> Columns:
    """A matrix over hinges from the weights of pairs.

    Args:
        onto_first: `[num_pairs, lanes]` how the later hinge of a pair acts on the earlier one.
        onto_second: how the earlier one acts on the later one, likewise.
        plant: whose pairs.

    Returns:
        Its columns.
    """
    rows, lanes = plant.num_hinge_rows, onto_first.shape[1:]
    if not plant.num_pairs:
        return {}
    wide = lambda x: jnp.broadcast_to(jnp.asarray(x), onto_first.shape)  # noqa: E731
    i, j = wide(plant.first), wide(plant.second)
    lane = jnp.arange(lanes[0]) if lanes else 0
    matrix = jnp.zeros((rows, rows, *lanes), onto_first.dtype)
    # What is past the end stands for no pair.
    matrix = matrix.at[i, j, lane].add(onto_first, mode="drop")
    matrix = matrix.at[j, i, lane].add(onto_second, mode="drop")
    if isinstance(plant.first, jax.Array):
        acting = list(range(rows))
    else:
        acting = sorted({*plant.first.ravel().tolist(), *plant.second.ravel().tolist()})
    return {j: matrix[:, j] for j in acting}


def mean_of_neighbours(like: jax.Array, plant: Plant) -> Columns:
    """The matrix that takes the mean over each hinge's neighbours; 0 for those without.

    Args:
        like: `[..., lanes]` of the floating-point type.
        plant: whose pairs.

    Returns:
        Its columns.
    """
    ones = jnp.ones((plant.num_pairs, *like.shape[1:]), like.dtype)
    columns = join_pairs(ones, ones, plant)
    if not columns:
        return {}
    count = jnp.maximum(sum(columns.values()), 1)
    return {j: column / count for j, column in columns.items()}


def act(columns: Columns, values: jax.Array) -> jax.Array:
    """The matrix times values of the hinges; written out: no reductions inside the compiled loop.

    Args:
        columns: of the matrix.
        values: `[hinge rows, lanes]`.

    Returns:
        `[hinge rows, lanes]`.
    """
    found = jnp.zeros_like(values)
    for j, column in columns.items():
        found = found + column * values[j : j + 1]
    return found
