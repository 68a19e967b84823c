"""A fitness spread over cores and hosts: the same scores, sooner.

    with make_pool("configs/lake_swim.yaml") as fitness:
        scores, measures = fitness.evaluate(population, key)

A population is cut into blocks of as many individuals as fill one chunk of `xla.LANES` lanes, the
last one padded with copies of its first row. Each block is scored by one run of the same compiled
program, in this process or in a worker's, so that scores do not depend, to the last bit, on how
many workers there are nor on who scores what. Each process runs one block at a time: two at once in
one process can lock XLA's CPU back end up.
"""

from __future__ import annotations

import secrets
import socket
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from mjx_revolve.evolution.crew import Crew
from mjx_revolve.evolution.worker import load_function, program_versions
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    import jax
    import numpy as np

    from mjx_revolve.episodes.config import Config
    from mjx_revolve.evolution.hosts import Place
    from mjx_revolve.evolution.leader import Leader, Limits

_MAKE_FITNESS = "mjx_revolve.episodes.fitness:make_fitness"


class Pool:
    """A fitness that scores in blocks. Whatever else it is asked for, its `fitness` answers.

    Attributes:
        fitness: this process's own, for replays, and for scores if there are no workers.
        block: individuals in a block; None: the whole population, whatever its size.
        workers: how many processes score, on all hosts.
    """

    def __init__(self, fitness: Any, block: int | None, leader: Leader | None = None) -> None:
        self.fitness = fitness
        self.block = block
        self._leader = leader
        self._closed = False
        self.hosts: list[dict[str, Any]] = leader.describe() if leader else []
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

        if self._closed:
            raise RuntimeError("expected an open pool; found it closed")
        population = np.asarray(population, np.float32)
        if population.ndim != 2 or population.shape[1] != self.num_genes or len(population) < 1:
            raise InputError(
                f"population: expected [P, {self.num_genes}]; found {list(population.shape)}"
            )
        blocks = split_blocks(population, self.block or len(population))
        try:
            results, names = self._score(blocks, key)
        except BaseException as error:
            # Interrupted anywhere: what the workers are at, and how far a message has come, is
            # unknown.
            self.close(_reason(error))
            raise
        rows = np.concatenate(results, 1)[:, : len(population)]
        return rows[0].copy(), dict(zip(names, rows[1:], strict=True))

    def _score(
        self, blocks: Sequence[np.ndarray], key: jax.Array
    ) -> tuple[list[np.ndarray], list[str]]:
        import jax
        import numpy as np

        if self._leader is not None:
            return self._leader.score(blocks, *_plain_key(key))
        results, names = [], []
        for block in blocks:
            scores, measures = self.fitness.evaluate(jax.numpy.asarray(block), key)
            rows = [np.asarray(values, np.float32) for values in (scores, *measures.values())]
            results.append(np.stack(rows))
            names = list(measures)
        return results, names

    def describe(self) -> dict[str, Any]:
        """Who scores, for `run.json`."""
        hosts = [{k: v for k, v in host.items() if k != "xla_flags"} for host in self.hosts]
        return {"count": self.workers, "block": self.block} | ({"hosts": hosts} if hosts else {})

    def close(self, reason: str | None = None) -> None:
        """Ends the workers.

        Args:
            reason: why, if it is not that all is done; workers of other hosts print it.
        """
        if not self._closed and self._leader is not None:
            self._leader.close(reason)
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


def _plain_key(key: jax.Array) -> tuple[list[int], str]:
    """A key as plain values: its data, and its implementation's name."""
    import jax
    import numpy as np

    return np.asarray(jax.random.key_data(key)).tolist(), str(jax.random.key_impl(key))


def split_blocks(population: np.ndarray, size: int) -> list[np.ndarray]:
    """Cuts a population into blocks of one shape.

    Args:
        population: `[P, G]`.
        size: rows of a block.

    Returns:
        `[size, G]` each; the last one is padded with copies of its first row.
    """
    import numpy as np

    blocks = [population[start : start + size] for start in range(0, len(population), size)]
    short = size - len(blocks[-1])
    if short:
        blocks[-1] = np.concatenate([blocks[-1], np.repeat(blocks[-1][:1], short, 0)])
    return blocks


def block_size(trials: int) -> int | None:
    """Individuals in a block: as many as fill a chunk of lanes; None: all, on an accelerator."""
    from mjx_revolve.numerics.xla import LANES, on_cpu

    return max(1, LANES // trials) if on_cpu() else None


def choose_workers(config: Config) -> int:
    """How many workers a run gets: one for each core, but none without a block of its own."""
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
    from mjx_revolve.episodes.config import load_config

    cache = runtime.prepare_process()
    if isinstance(config, str | Path):
        config = load_config(config)
    if workers is None:
        workers = 1 if make_fitness else runtime.usable_cores() if place else choose_workers(config)
    if workers > 1 or place is not None:
        _expect_cpu("--hosts" if place else "--workers")
        return _start_pool(config, workers, make_fitness, place, limits, cache)
    fitness = (make_fitness or load_function(_MAKE_FITNESS))(config)
    return Pool(fitness, _block_of(fitness))


def _expect_cpu(option: str) -> None:
    import jax

    if jax.default_backend() != "cpu":
        raise InputError(
            f"{option}: expected JAX to run on the CPU (JAX_PLATFORMS=cpu), where work is spread "
            f"over cores; found {jax.default_backend()}, which takes the whole population"
        )


def _block_of(fitness: Any) -> int | None:
    own = getattr(fitness, "block_size", None)
    config = getattr(fitness, "config", None)
    return own if own or config is None else block_size(config.task.trials)


def name_function(make_fitness: Callable[[Config], Any] | None) -> str:
    """The name by which workers import a function.

    Args:
        make_fitness: a function, or None for the real one.

    Returns:
        `MODULE:NAME`.

    Raises:
        ValueError: it cannot be imported by its name.
    """
    if make_fitness is None:
        return _MAKE_FITNESS
    name = f"{make_fitness.__module__}:{make_fitness.__qualname__}"
    if make_fitness.__module__ == "__main__" or "<" in name:
        raise ValueError(f"make_fitness: expected a function that can be imported; found {name}")
    return name


def make_job(config: Config, make: str, address: tuple[str, int], secret: bytes, cache: Path | None,
             host: int, hosts: int, patience: float) -> dict[str, Any]:  # fmt: skip
    """What a worker is told on its standard input; `Crew` adds its number and core."""
    return {
        "config": config.model_dump(),
        "source": config.source,
        "make": make,
        "address": address,
        "secret": secret.decode(),
        "cache": str(cache) if cache else None,
        "host": host,
        "hosts": hosts,
        "patience": patience,
    }


def _start_pool(
    config: Config,
    workers: int,
    make_fitness: Callable[[Config], Any] | None,
    place: Place | None,
    limits: Limits | None,
    cache: Path | None,
) -> Pool:
    """Starts this host's workers, builds the fitness meanwhile, and waits for all to report."""
    import jax

    from mjx_revolve.evolution import leader
    from mjx_revolve.evolution.fingerprints import model_hash, settings_hash

    limits = limits or leader.LIMITS
    make = name_function(make_fitness)
    secret = place.secret if place else secrets.token_hex(32).encode()
    hosts = place.hosts if place else 1
    listener = place.listen() if place else socket.create_server(("127.0.0.1", 0), backlog=1024)
    address = place.reach(listener) if place else listener.getsockname()[:2]
    try:
        job = make_job(config, make, address, secret, cache, 0, hosts, limits.start)
        crew = Crew(workers, job)
    except BaseException:
        listener.close()
        raise
    lead = None
    try:
        fitness = load_function(make)(config)
        identity = {
            "versions": program_versions(),
            "settings_hash": settings_hash(config),
            "model_hash": model_hash(fitness),
        }
        lead = leader.Leader(listener, crew, secret, identity, hosts, limits)
        block = _block_of(fitness) or config.evolution.population_size
        lead.gather(block, fitness.num_genes, *_plain_key(jax.random.key(0)))
    except BaseException as error:
        if lead is not None:
            lead.close(_reason(error))
        else:
            listener.close()
            crew.close(0.0)
        raise
    pool = Pool(fitness, block, lead)
    _note_differences(pool)
    return pool


def _note_differences(pool: Pool) -> None:
    for name, what in (("cpu", "CPUs"), ("xla_flags", "XLA_FLAGS")):
        found = sorted({host[name] for host in pool.hosts})
        if len(found) > 1:
            print(
                f"note: the hosts have different {what} ({'; '.join(found)}): the last bits of "
                "scores may depend on which host computes them",
                file=sys.stderr,
            )
