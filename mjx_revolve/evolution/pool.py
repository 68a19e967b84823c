"""A fitness spread over cores and hosts: the same scores, sooner.

    with make_pool("configs/lake_swim.yaml") as fitness:
        scores, measures = fitness.evaluate(population, key)

Imports stand inside functions: `make_pool` sets threads before NumPy and JAX are loaded, and
workers start while the rest is.
"""

from __future__ import annotations

import contextlib
import logging
import pkgutil
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from mjx_revolve.evolution.crew import MAKE_FITNESS, Crew, make_job
from mjx_revolve.evolution.place import Place, alone
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    import jax
    import numpy as np

    from mjx_revolve.episodes.config import Config
    from mjx_revolve.evolution.blocks import Workplace
    from mjx_revolve.evolution.leader import Leader, Limits

_log = logging.getLogger(__name__)


class Pool:
    """A fitness that scores in blocks. Whatever else it is asked for, its `fitness` answers.

    Attributes:
        fitness: this process's own, for replays, and for scores if there are no workers.
        block: individuals in a block; None: the whole population, whatever its size.
        hosts: who scores; see `blocks.Workplace`.
        workers: how many processes score, on all hosts.
    """

    def __init__(self, fitness: Any, block: int | None, workplace: Workplace | None = None) -> None:
        """Opens a pool.

        Args:
            fitness: this process's own.
            block: individuals in a block; None: the whole population, whatever its size.
            workplace: scores blocks, and is closed with the pool; None: this process.
        """
        from mjx_revolve.evolution.blocks import ThisProcess

        self.fitness = fitness
        self.block = block
        self._workplace: Workplace = workplace or ThisProcess(fitness)
        self._closed = False
        self.hosts = self._workplace.hosts
        self.workers: int = sum(host["workers"] for host in self.hosts) or 1

    def __getattr__(self, name: str) -> Any:
        return getattr(self.fitness, name)

    @property
    def num_genes(self) -> int:
        """Length of an individual's genes."""
        return self.fitness.num_genes

    def __call__(self, population: Any, key: jax.Array) -> np.ndarray:
        """Scores a population: `[P]`; see `evaluate`."""
        return self.evaluate(population, key)[0]

    def evaluate(self, population: Any, key: jax.Array) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Scores a population and says how it moved.

        Args:
            population: `[P, num_genes]`.
            key: draws the episodes' starts, the same for every individual.

        Returns:
            `[P]` scores and `[P]` measures, float32.

        Raises:
            WorkerError: a worker died, failed or hangs; the pool is closed.
            InputError: the population has another shape.
        """
        import numpy as np

        from mjx_revolve.evolution.blocks import split_blocks

        if self._closed:
            raise RuntimeError("expected an open pool; found it closed")
        population = np.asarray(population, np.float32)
        if population.ndim != 2 or population.shape[1] != self.num_genes or len(population) < 1:
            raise InputError(
                f"population: expected [P, {self.num_genes}]; found {list(population.shape)}"
            )
        blocks = split_blocks(population, self.block or len(population))
        try:
            results, names = self._workplace.score(blocks, key)
        except BaseException as error:
            # Interrupted anywhere: what the workers are at, and how far a message has come, is
            # unknown.
            self.close(_reason(error))
            raise
        rows = np.concatenate(results, 1)[:, : len(population)]
        return rows[0].copy(), dict(zip(names, rows[1:], strict=True))

    def describe(self) -> dict[str, Any]:
        """Who scores, for `run.json`."""
        hosts = [{k: v for k, v in host.items() if k != "xla_flags"} for host in self.hosts]
        return {"count": self.workers, "block": self.block} | ({"hosts": hosts} if hosts else {})

    def close(self, reason: str | None = None) -> None:
        """Ends the workers.

        Args:
            reason: why, if it is not that all is done; workers of other hosts print it.
        """
        if not self._closed:
            self._workplace.close(reason)
        self._closed = True

    def __enter__(self) -> Pool:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close(None if error is None else _reason(error))


def _reason(error: BaseException) -> str:
    """An error in one line."""
    return str(error).partition("\n")[0] or type(error).__name__


def choose_workers(config: Config) -> int:
    """How many workers a run gets: one for each core, but none without a block of its own."""
    from mjx_revolve.evolution.blocks import block_size

    block = block_size(config.task.trials)
    if block is None:
        return 1
    return min(runtime.usable_cores(), -(-config.evolution.population_size // block))


def make_pool(
    config: Config | str | Path,
    workers: int | None = None,
    make_fitness: Callable[[Config], Any] | None = None,
    place: Place | None = None,
    limits: Limits | None = None,
) -> Pool:
    """Builds a fitness and starts the workers that share its work.

    Args:
        config: the configuration, or the path of its file.
        workers: how many processes are to score on this host; None: one for each core on a CPU, and
            this one alone on an accelerator. With 1, this process does it itself.
        make_fitness: makes the fitness, here and in each worker: a function that can be imported by
            its name. It is any object with `num_genes` and `evaluate`; `block_size` says how many
            individuals it takes at a time. None: the real one. By default another one has no
            workers.
        place: this host's place among several.
        limits: how long to wait for workers.

    Returns:
        The pool; to be closed, or used in a `with`.

    Raises:
        InputError: the configuration is wrong, or one of the workers has another.
        WorkerError: workers cannot be started, or one died or never came.
    """
    cache = runtime.prepare_process()
    from mjx_revolve.episodes.config import load_config
    from mjx_revolve.evolution.blocks import choose_block

    if isinstance(config, str | Path):
        config = load_config(config)
    if workers is None:
        workers = 1 if make_fitness else runtime.usable_cores() if place else choose_workers(config)
    if workers == 1 and place is None:
        fitness = (make_fitness or pkgutil.resolve_name(MAKE_FITNESS))(config)
        return Pool(fitness, choose_block(fitness))
    _expect_cpu("--hosts" if place else "--workers")
    fitness, leader = _start_workers(config, workers, make_fitness, place or alone(), limits, cache)
    _note_differences(leader.hosts)
    return Pool(fitness, choose_block(fitness) or config.evolution.population_size, leader)


def _expect_cpu(option: str) -> None:
    import jax

    if jax.default_backend() != "cpu":
        raise InputError(
            f"{option}: expected JAX to run on the CPU (JAX_PLATFORMS=cpu), where work is spread "
            f"over cores; found {jax.default_backend()}, which takes the whole population"
        )


def _start_workers(
    config: Config,
    workers: int,
    make_fitness: Callable[[Config], Any] | None,
    place: Place,
    limits: Limits | None,
    cache: Path | None,
) -> tuple[Any, Leader]:
    """Starts this host's workers, builds the fitness meanwhile, and waits for all to report."""
    from mjx_revolve.evolution import leader

    limits = limits or leader.LIMITS
    with contextlib.ExitStack() as undo:
        listener = undo.enter_context(place.listen())
        job = make_job(config, make_fitness, place.seen_from_here(listener), cache, limits.start)
        crew = Crew(workers, job)
        undo.callback(crew.close, 0.0)
        from mjx_revolve.evolution.blocks import choose_block
        from mjx_revolve.evolution.fingerprints import identify

        fitness = pkgutil.resolve_name(job["make"])(config)
        identity = identify(config, fitness)
        lead = leader.Leader(listener, crew, place.secret, identity, place.hosts, limits)
        undo.pop_all()
    try:
        lead.gather(choose_block(fitness) or config.evolution.population_size, fitness.num_genes)
    except BaseException as error:
        lead.close(_reason(error))
        raise
    return fitness, lead


def _note_differences(hosts: list[dict[str, Any]]) -> None:
    for name, what in (("cpu", "CPUs"), ("xla_flags", "XLA_FLAGS")):
        found = sorted({host[name] for host in hosts})
        if len(found) > 1:
            _log.warning(
                "the hosts have different %s (%s): the last bits of scores may depend on which "
                "host computes them", what, "; ".join(found),
            )  # fmt: skip
