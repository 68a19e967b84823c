"""Where a population is evaluated: it is cut into blocks, and somebody scores them.

A `Workplace` turns blocks into scores. Here is the simplest one, this process; the others are
`processes.Processes`, on this machine, and `cluster.Cluster`, on many.

A block is a tuple of what `fitness.evaluate` takes before the key: `(genes,)` where all have one
body. All blocks of genes have one shape, that of one chunk of `xla.LANES` lanes, so that each is
one run of the same compiled program wherever it is scored: that is why scores do not depend, to the
last bit, on how many workers there are nor on who scores what.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import jax
import numpy as np

from mjx_revolve.episodes.config import Config
from mjx_revolve.numerics.xla import LANES, on_cpu

Block = tuple[Any, ...]
"""What `fitness.evaluate` takes before the key; the first of them has one entry per individual."""
Scored = tuple[np.ndarray, dict[str, np.ndarray]]
"""`[rows]` scores and measures of a block, float32."""


class Workplace(Protocol):
    """Whoever scores blocks."""

    @property
    def place(self) -> str:
        """The address of a cluster; nothing on this machine."""

    @property
    def workers(self) -> int:
        """How many processes score."""

    def score(self, blocks: Sequence[Block], key: jax.Array) -> list[Scored | str]:
        """Scores blocks.

        Args:
            blocks: the blocks.
            key: draws the episodes' starts.

        Returns:
            The scores of each, or in words why nobody could score it.
        """

    def close(self) -> None:
        """Ends the work."""


class ThisProcess:
    """Scores blocks here, one after the other: two at once can lock XLA's CPU back end up."""

    place = ""
    workers = 1

    def __init__(self, fitness: Any) -> None:
        self.fitness = fitness

    def score(self, blocks: Sequence[Block], key: jax.Array) -> list[Scored | str]:
        """See `Workplace`."""
        return [evaluate_block(self.fitness, block, key) for block in blocks]

    def close(self) -> None:
        """There is nobody to send home."""


def evaluate_block(fitness: Any, block: Block, key: jax.Array) -> Scored:
    """Scores one block.

    Args:
        fitness: the fitness.
        block: what it takes before the key; arrays become JAX's.
        key: draws the episodes' starts.

    Returns:
        Scores and measures.
    """
    arguments = [jax.numpy.asarray(x) if isinstance(x, np.ndarray) else x for x in block]
    scores, measures = fitness.evaluate(*arguments, key)
    return np.asarray(scores, np.float32), {
        name: np.asarray(values, np.float32) for name, values in measures.items()
    }


def key_as_data(key: jax.Array) -> tuple[np.ndarray, str]:
    """A key as what another process can be sent: numbers, and the kind of key."""
    return np.asarray(jax.random.key_data(key)), str(jax.random.key_impl(key))


def key_from_data(data: tuple[np.ndarray, str]) -> jax.Array:
    """The inverse of `key_as_data`."""
    return jax.random.wrap_key_data(jax.numpy.asarray(data[0]), impl=data[1])


def split_blocks(population: np.ndarray, size: int) -> list[np.ndarray]:
    """Cuts a population into blocks of one shape.

    Args:
        population: `[P, G]`.
        size: rows of a block.

    Returns:
        `[size, G]` each; the last one is padded with copies of its first row.
    """
    blocks = [population[start : start + size] for start in range(0, len(population), size)]
    short = size - len(blocks[-1])
    if short:
        blocks[-1] = np.concatenate([blocks[-1], np.repeat(blocks[-1][:1], short, 0)])
    return blocks


def block_size(trials: int) -> int | None:
    """Individuals in a block: as many as fill a chunk of lanes; None: all, on an accelerator."""
    return max(1, LANES // trials) if on_cpu() else None


def choose_block(fitness: Any) -> int | None:
    """Individuals in a block of this fitness, which may name its own `block_size`; None: all."""
    own = getattr(fitness, "block_size", None)
    config: Config | None = getattr(fitness, "config", None)
    return own if own or config is None else block_size(config.task.trials)


def example_block(fitness: Any, population_size: int) -> Block:
    """A block to compile for: the fitness's own `example_block()`, or genes of zero."""
    if hasattr(fitness, "example_block"):
        return fitness.example_block()
    return (np.zeros((choose_block(fitness) or population_size, fitness.num_genes), np.float32),)
