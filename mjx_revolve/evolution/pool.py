"""A fitness spread over cores, or the machines of a cluster: the same scores, sooner.

    with make_pool("configs/lake_swim.yaml") as fitness:
        scores, measures = fitness.evaluate(population, key)

Imports stand inside functions: `make_pool` sets threads before NumPy and JAX are loaded, and
workers start while the rest is.
"""

from __future__ import annotations

import logging
import pkgutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from mjx_revolve.evolution.jobs import Job, WorkerError, choose_fitness, make_job
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    import jax
    import numpy as np

    from mjx_revolve.episodes.config import Config
    from mjx_revolve.evolution.blocks import Block, Scored, Workplace

_log = logging.getLogger(__name__)


class Pool:
    """A fitness that scores in blocks. Whatever else it is asked for, its `fitness` answers.

    Attributes:
        fitness: this process's own, for replays, and for scores if there are no workers.
        block: individuals in a block; None: the whole population, whatever its size.
        folder: where blocks that had to be given up are kept.
    """

    def __init__(
        self,
        fitness: Any,
        block: int | None,
        workplace: Workplace | None = None,
        job: Job | None = None,
    ) -> None:
        """Opens a pool.

        Args:
            fitness: this process's own.
            block: individuals in a block; None: the whole population, whatever its size.
            workplace: scores blocks, and is closed with the pool; None: this process.
            job: what it does.
        """
        from mjx_revolve.evolution.blocks import ThisProcess

        self.fitness = fitness
        self.block = block
        self.folder = Path(tempfile.gettempdir()) / "mjx_revolve"
        self._workplace: Workplace = workplace or ThisProcess(fitness)
        self._job = job
        self._closed = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.fitness, name)

    @property
    def num_genes(self) -> int:
        """Length of an individual's genes."""
        return self.fitness.num_genes

    @property
    def closed(self) -> bool:
        """Whether it scores no more."""
        return self._closed

    @property
    def workers(self) -> int:
        """How many processes score."""
        return self._workplace.workers

    @property
    def place(self) -> str:
        """The address of the cluster; nothing on this machine."""
        return self._workplace.place

    def __call__(self, population: Any, key: jax.Array) -> np.ndarray:
        """Scores a population: `[P]`; see `evaluate`."""
        return self.evaluate(population, key)[0]

    def evaluate(self, population: Any, key: jax.Array) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Scores a population and says how it moved.

        Args:
            population: `[P, num_genes]`.
            key: draws the episodes' starts, the same for every individual.

        Returns:
            `[P]` scores and `[P]` measures, float32; see `score` for NaN.

        Raises:
            WorkerError: see `score`.
            InputError: the population has another shape.
        """
        import numpy as np

        from mjx_revolve.evolution.blocks import split_blocks

        population = np.asarray(population, np.float32)
        if population.ndim != 2 or population.shape[1] != self.num_genes or len(population) < 1:
            raise InputError(
                f"population: expected [P, {self.num_genes}]; found {list(population.shape)}"
            )
        blocks = split_blocks(population, self.block or len(population))
        scores, measures = zip(*self.score([(block,) for block in blocks], key), strict=True)
        size = len(population)
        return np.concatenate(scores)[:size], {
            name: np.concatenate([each[name] for each in measures])[:size] for name in measures[0]
        }

    def score(self, blocks: Sequence[Block], key: jax.Array) -> list[Scored]:
        """Scores blocks, whatever the fitness takes.

        Args:
            blocks: arguments of `fitness.evaluate` before the key, which can be pickled; the first
                has one entry per individual.
            key: draws the episodes' starts, the same for every individual.

        Returns:
            `[rows]` scores and measures of each. Those of a block that brings down worker after
            worker are NaN; the log names the file from which it can be scored again.

        Raises:
            WorkerError: no worker is left, or not one block could be scored; the pool is closed.
        """
        import numpy as np

        if self._closed:
            raise RuntimeError("expected an open pool; found it closed")
        try:
            results = self._workplace.score(blocks, key)
            names = [tuple(result[1]) for result in results if not isinstance(result, str)]
            if not names:
                raise WorkerError(f"expected scores; every block failed: {results[0]}")
        except BaseException:
            # Interrupted anywhere: what the workers are at is unknown.
            self.close()
            raise
        whole: list[Scored] = []
        for block, result in zip(blocks, results, strict=True):
            if isinstance(result, str):
                self._report(block, key, result)
                nothing = np.full(len(block[0]), np.nan, np.float32)
                result = nothing, dict.fromkeys(names[0], nothing)
            whole.append(result)
        return whole

    def _report(self, block: Block, key: jax.Array, reason: str) -> None:
        """Says what became of a block that was given up, and keeps it."""
        from mjx_revolve.evolution.lost import save_lost

        assert self._job is not None  # without workers no block is given up
        path = save_lost(self.folder, self._job, block, key)
        _log.warning(
            "%d individuals count as failed, because their workers do (%s); to see why: "
            "python -m mjx_revolve.evolution.lost %s", len(block[0]), reason, path,
        )  # fmt: skip

    def describe(self) -> dict[str, Any]:
        """Who scores, for `run.json`."""
        # Workers of a cluster come and go.
        who = {"cluster": self.place} if self.place else {"count": self.workers}
        return who | {"block": self.block}

    def close(self) -> None:
        """Ends the workers."""
        if not self._closed:
            self._workplace.close()
        self._closed = True

    def __enter__(self) -> Pool:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def choose_workers(config: Config) -> int:
    """How many workers a run gets: one for each core, but none without a block of its own."""
    from mjx_revolve.evolution.blocks import block_size

    block = block_size(config.task.trials)
    if block is None or config.colony is not None:  # a world is stepped as a whole
        return 1
    blocks = -(-config.evolution.population_size // block)
    if config.bodies is not None:
        count = config.bodies.selection.offspring or config.evolution.population_size
        tried = config.bodies.learning.population_size
        blocks = -(-count * tried // block)
    return min(runtime.usable_cores(), blocks)


def make_pool(
    config: Config | str | Path,
    workers: int | None = None,
    make_fitness: Callable[[Config], Any] | None = None,
    cluster: str | None = None,
) -> Pool:
    """Builds a fitness and starts the workers that share its work, or finds them.

    Args:
        config: the configuration, or the path of its file.
        workers: how many processes are to score on this machine; None: one for each core on a CPU,
            and this one alone on an accelerator. With 1, this process does it itself.
        make_fitness: makes the fitness, here and in each worker: a function that can be imported by
            its name. It is any object with `evaluate`, and `num_genes` where that takes genes alone
            or `example_block()`, a block to compile for; `block_size` says how many individuals it
            takes at a time. None: the real one. By default another one has no workers.
        cluster: a Dask scheduler's address, or the path of its scheduler file: its workers do it.

    Returns:
        The pool; to be closed, or used in a `with`.

    Raises:
        InputError: the configuration is wrong, or there is no scheduler.
        WorkerError: workers cannot be started.
    """
    cache = runtime.prepare_process()
    from mjx_revolve.episodes.config import load_config
    from mjx_revolve.evolution.blocks import choose_block
    from mjx_revolve.evolution.fingerprints import identify

    if isinstance(config, str | Path):
        config = load_config(config)
    if workers is None:
        workers = 1 if make_fitness else choose_workers(config)
    if workers == 1 and cluster is None:
        fitness = (make_fitness or pkgutil.resolve_name(choose_fitness(config)))(config)
        return Pool(fitness, choose_block(fitness))
    _expect_cpu("--cluster" if cluster else "--workers")
    job = make_job(config, make_fitness)
    crew: Cluster | Processes
    if cluster:
        from mjx_revolve.evolution.cluster import Cluster

        crew = Cluster(cluster, job)
    else:
        from mjx_revolve.evolution.processes import Processes

        crew = Processes(workers, job, cache)
    try:
        fitness = pkgutil.resolve_name(job.make)(config)
        crew.identity = identify(fitness)
    except BaseException:
        crew.close()
        raise
    return Pool(fitness, choose_block(fitness) or config.evolution.population_size, crew, job)


def _expect_cpu(option: str) -> None:
    import jax

    if jax.default_backend() != "cpu":
        raise InputError(
            f"{option}: expected JAX to run on the CPU (JAX_PLATFORMS=cpu), where work is spread "
            f"over cores; found {jax.default_backend()}, which takes the whole population"
        )
