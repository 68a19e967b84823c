"""Executors score a population in blocks: in this process, or with workers.

Imports stand inside functions: workers start while NumPy and JAX are loaded.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from mjx_revolve.evolution.jobs import MakeFitness, WorkerError, make_job
from mjx_revolve.inputs.errors import InputError

if TYPE_CHECKING:
    import jax
    import numpy as np
    from numpy.typing import ArrayLike

    from mjx_revolve.episodes.config import Config
    from mjx_revolve.evolution.blocks import Block, KeyData, Scored

_log = logging.getLogger(__name__)
AnyWorker = TypeVar("AnyWorker")


class Executor:
    """Scores a population in blocks, one after the other, in this process.

    One after the other, because two at once can lock XLA's CPU back end up.

    Attributes:
        fitness: this process's own, for replays, and for scores if there are no workers.
        block: individuals in a block; None: the whole population.
        closed: whether it has ended.
    """

    place = ""
    """The address of the cluster; "" on this machine."""

    def __init__(self, fitness: Any, block: int | None = None) -> None:
        """Makes an executor of a fitness; see `jobs.MakeFitness`."""
        self.fitness = fitness
        self.block = block
        self.closed = False

    @property
    def num_genes(self) -> int:
        """Length of an individual's genes."""
        return self.fitness.num_genes

    @property
    def worst_score(self) -> float:
        """The score of a failed rollout; -inf for a fitness that has none."""
        return self.fitness.worst_score if hasattr(self.fitness, "worst_score") else float("-inf")

    @property
    def num_workers(self) -> int:
        """How many processes score."""
        return 1

    def __call__(self, population: ArrayLike, key: jax.Array) -> np.ndarray:
        """Scores a population: `[P]`; see `evaluate`."""
        return self.evaluate(population, key)[0]

    def evaluate(self, population: ArrayLike, key: jax.Array) -> Scored:
        """Scores a population and measures how it moved.

        Args:
            population: `[P, num_genes]`.
            key: draws the episodes' starts, the same for every individual.

        Returns:
            `[P]` scores and `[P]` measures, float32; see `score` for NaN.

        Raises:
            WorkerError: see `score`.
            InputError: the population has another shape, or the key is none.
        """
        import numpy as np

        from mjx_revolve.evolution.blocks import join, split_blocks, take

        population = np.asarray(population, np.float32)
        if population.ndim != 2 or population.shape[1] != self.num_genes or len(population) < 1:
            raise InputError("population", f"[P, {self.num_genes}]", list(population.shape))
        blocks = split_blocks(population, self.block or len(population))
        scored = self.score([(block,) for block in blocks], key)
        return take(join(scored), slice(len(population)))

    def score(self, blocks: Sequence[Block], key: jax.Array) -> list[Scored]:
        """Scores blocks of the fitness's arguments.

        Args:
            blocks: arguments of `fitness.evaluate` before the key, which can be pickled; the first
                has one entry per individual.
            key: draws the episodes' starts, the same for every individual.

        Returns:
            `[rows]` scores and measures of each. Those of a block that makes `Limits.tries` workers
            fail are NaN; the log has the reason.

        Raises:
            WorkerError: no worker is left, or not one block could be scored; the executor is
                closed.
            InputError: the key is none.
        """
        from mjx_revolve.episodes.starts import check_key

        if self.closed:
            raise RuntimeError("expected an open executor; found it closed")
        check_key(key)  # a seed instead is no reason to end the workers
        try:
            return self._score(blocks, key)
        except BaseException:
            # Interrupted anywhere: the state of the workers is unknown.
            self.close()
            raise

    def _score(self, blocks: Sequence[Block], key: jax.Array) -> list[Scored]:
        from mjx_revolve.evolution.blocks import evaluate_block

        return [evaluate_block(self.fitness, block, key) for block in blocks]

    def describe(self) -> dict[str, object]:
        """The executor's kind and size, for `run.json`."""
        return {"count": self.num_workers, "block": self.block}

    def close(self) -> None:
        """Ends the workers."""
        self.closed = True

    def __enter__(self) -> Executor:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class WorkerExecutor(Executor, ABC, Generic[AnyWorker]):
    """An executor with workers: processes that score one block after the other.

    Scoring a block is a pure function: after the loss of its worker it is scored again, with the
    same result. A block that fails `Limits.tries` times has no scores.

    Attributes:
        job: of the workers.
        identity: program, precision, robot and world, which must equal the workers'; see
            `fingerprints.identify`.
    """

    def __init__(self, config: Config, make_fitness: MakeFitness | None) -> None:
        """Makes this process's own fitness, while the workers make theirs.

        Args:
            config: of the run.
            make_fitness: see `executor.make_executor`.
        """
        from mjx_revolve.evolution.blocks import choose_block
        from mjx_revolve.evolution.fingerprints import identify

        try:
            self.job = make_job(config, make_fitness)
            self.begin()
            fitness = self.job.make_fitness(config)
            super().__init__(fitness, choose_block(fitness) or config.evolution.population_size)
            self.identity = identify(fitness)
        except BaseException:
            self.close()
            raise

    @abstractmethod
    def begin(self) -> None:
        """Gives the workers their job."""

    @abstractmethod
    def free(self) -> list[AnyWorker]:
        """The workers that can take a block."""

    @abstractmethod
    def send(self, worker: AnyWorker, number: int, block: Block, key: KeyData) -> None:
        """Gives a block to a worker."""

    @abstractmethod
    def attend(self) -> list[tuple[int, Scored | str | None]]:
        """Waits for results, for a short time at most.

        Returns:
            Numbers of blocks, with the scores of each, or why it failed, or None: it was not begun.
        """

    def _score(self, blocks: Sequence[Block], key: jax.Array) -> list[Scored]:
        import numpy as np

        from mjx_revolve.evolution.blocks import key_as_data

        data = key_as_data(key)
        waiting = deque(range(len(blocks)))
        scored: dict[int, Scored] = {}
        reasons: dict[int, list[str]] = {}
        lost: dict[int, str] = {}
        while len(scored) + len(lost) < len(blocks):
            for worker in self.free():
                if waiting:
                    number = waiting.popleft()
                    self.send(worker, number, blocks[number], data)
            for number, result in self.attend():
                if result is None:
                    waiting.appendleft(number)
                elif not isinstance(result, str):
                    scored[number] = result
                else:
                    failed = reasons.setdefault(number, [])
                    failed.append(result)
                    if len(failed) < self.job.limits.tries:
                        waiting.appendleft(number)
                    else:
                        lost[number] = ", ".join(dict.fromkeys(failed))
        if not scored:
            raise WorkerError(f"expected scores; every block failed: {lost[0]}")
        names = next(iter(scored.values()))[1]
        for number, reason in sorted(lost.items()):
            nothing = np.full(len(blocks[number][0]), np.nan, np.float32)
            _log.warning("%d individuals count as failed, because their workers do (%s)",
                         len(nothing), reason)  # fmt: skip
            scored[number] = nothing, dict.fromkeys(names, nothing)
        return [scored[number] for number in range(len(blocks))]
