"""Blocks of a population: splitting, scoring, and sending to another process.

A block is a tuple of the arguments of `fitness.evaluate` before the key: `(genes,)` if all
individuals have one body. All blocks of genes have one shape, that of one chunk of `xla.LANES`
lanes, so that each is one run of the same compiled program in any process. So scores are equal to
the last bit for any number of workers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from mjx_revolve.episodes.fitness import Fitness
from mjx_revolve.numerics.xla import LANES, on_cpu

KeyData = tuple[np.ndarray, str]  # a random key as `key_as_data` has it
Block = tuple[Any, ...]
"""The arguments of `fitness.evaluate` before the key; the first has one entry per individual."""
Scored = tuple[np.ndarray, dict[str, np.ndarray]]
"""`[rows]` scores and measures of a block, float32."""


def evaluate_block(fitness: Any, block: Block, key: jax.Array) -> Scored:
    """Scores one block; `key` draws the episodes' starts."""
    arguments = [jax.numpy.asarray(x) if isinstance(x, np.ndarray) else x for x in block]
    scores, measures = fitness.evaluate(*arguments, key)
    return np.asarray(scores, np.float32), {
        name: np.asarray(values, np.float32) for name, values in measures.items()
    }


def join(parts: Sequence[Scored]) -> Scored:
    """Scores and measures of several blocks, one after the other."""
    return np.concatenate([scores for scores, _ in parts]), {
        name: np.concatenate([measures[name] for _, measures in parts]) for name in parts[0][1]
    }


def take(scored: Scored, rows: slice | np.ndarray) -> Scored:
    """Some rows of scores and measures."""
    return scored[0][rows], {name: values[rows] for name, values in scored[1].items()}


def key_as_data(key: jax.Array) -> KeyData:
    """A key as values that can be sent to another process: numbers, and the kind of key."""
    return np.asarray(jax.random.key_data(key)), str(jax.random.key_impl(key))


def key_from_data(data: KeyData) -> jax.Array:
    """The inverse of `key_as_data`."""
    return jax.random.wrap_key_data(jax.numpy.asarray(data[0]), impl=data[1])


def split_blocks(population: np.ndarray, size: int) -> list[np.ndarray]:
    """Cuts a population `[P, G]` into blocks `[size, G]`.

    The last one is padded with copies of its first row.
    """
    blocks = [population[start : start + size] for start in range(0, len(population), size)]
    short = size - len(blocks[-1])
    if short:
        blocks[-1] = np.concatenate([blocks[-1], np.repeat(blocks[-1][:1], short, 0)])
    return blocks


def block_size(trials: int) -> int | None:
    """Individuals in a block: as many as fill a chunk of lanes; None: all, on an accelerator."""
    return max(1, LANES // trials) if on_cpu() else None


def choose_block(fitness: object) -> int | None:
    """Individuals in a block of this fitness, which may have its own `block_size`; None: all."""
    if isinstance(fitness, Fitness):
        return block_size(fitness.config.task.trials)
    return fitness.block_size if hasattr(fitness, "block_size") else None


def example_block(fitness: Any, population_size: int) -> Block:
    """A block to compile for: the fitness's own `example_block()`, or genes of zero."""
    if hasattr(fitness, "example_block"):
        return fitness.example_block()
    return (np.zeros((choose_block(fitness) or population_size, fitness.num_genes), np.float32),)
