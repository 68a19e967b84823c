"""Where a population is evaluated: it is cut into blocks, and somebody scores them.

A `Workplace` turns blocks into scores. Here is the simplest one, this process; `leader.Leader` is
the other one: processes on one host or on several. A cluster's own scheduler would be a third.

All blocks have one shape, that of one chunk of `xla.LANES` lanes, so that each is one run of the
same compiled program wherever it is scored: that is why scores do not depend, to the last bit, on
how many workers there are nor on who scores what.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import jax
import numpy as np

from mjx_revolve.episodes.config import Config
from mjx_revolve.numerics.xla import LANES, on_cpu

Scored = tuple[list[np.ndarray], list[str]]


class Workplace(Protocol):
    """Whoever scores blocks."""

    @property
    def hosts(self) -> list[dict[str, Any]]:
        """Who is at work: `node`, `cpu`, `xla_flags`, number of `workers`; empty: this process."""

    def score(self, blocks: Sequence[np.ndarray], key: jax.Array) -> Scored:
        """Scores blocks.

        Args:
            blocks: `[rows, genes]` float32 each, of one shape.
            key: draws the episodes' starts.

        Returns:
            `[1 + measures, rows]` float32 scores and measures of each block; the measures' names.
        """

    def close(self, reason: str | None = None) -> None:
        """Ends the work; `reason` says why, if it is not that all is done."""


class ThisProcess:
    """Scores blocks here, one after the other: two at once can lock XLA's CPU back end up."""

    def __init__(self, fitness: Any) -> None:
        self.fitness = fitness
        self.hosts: list[dict[str, Any]] = []

    def score(self, blocks: Sequence[np.ndarray], key: jax.Array) -> Scored:
        """See `Workplace`."""
        scored = [evaluate_block(self.fitness, block, key) for block in blocks]
        return [rows for rows, _ in scored], scored[-1][1]

    def close(self, reason: str | None = None) -> None:
        """There is nobody to send home."""


def evaluate_block(fitness: Any, block: np.ndarray, key: jax.Array) -> tuple[np.ndarray, list[str]]:
    """Scores one block.

    Args:
        fitness: the fitness.
        block: `[rows, genes]` float32.
        key: draws the episodes' starts.

    Returns:
        `[1 + measures, rows]` float32 scores and measures, and the measures' names.
    """
    scores, measures = fitness.evaluate(jax.numpy.asarray(block), key)
    rows = [np.asarray(values, np.float32) for values in (scores, *measures.values())]
    return np.stack(rows), list(measures)


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
