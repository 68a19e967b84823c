"""The executor of a configuration: one process, its cores, or the workers of a cluster.

    with make_executor("configs/lake_swim.yaml") as executor:
        scores, measures = executor.evaluate(population, key)

Imports stand inside functions: `make_executor` sets threads before NumPy and JAX are imported, and
workers start at the same time.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mjx_revolve.evolution.block_executor import Executor as Executor
from mjx_revolve.evolution.jobs import MakeFitness, choose_fitness
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import Config
    from mjx_revolve.evolution.processes import LocalWorker


def choose_workers(config: Config) -> int:
    """Number of workers of a run on CPUs: one for each core, but no more than blocks.

    It imports no JAX.
    """
    if config.colony is not None:  # a world is stepped as a whole
        return 1
    block = max(1, runtime.LANES // config.task.trials)
    blocks = -(-config.evolution.population_size // block)
    if config.bodies is not None:
        count = config.bodies.selection.offspring or config.evolution.population_size
        learning = config.bodies.learning
        own = count * learning.blocks_of_body(block)
        blocks = own or -(-count * learning.population_size // block)
    return min(runtime.usable_cores(), blocks)


def make_executor(
    config: Config | str | Path,
    workers: int | None = None,
    make_fitness: MakeFitness | None = None,
    cluster: str | None = None,
    started: list[LocalWorker] | None = None,
) -> Executor:
    """Builds a fitness and starts the workers that share its work, or finds them.

    Args:
        config: the configuration, or the path of its file.
        workers: how many processes are to score on this machine; None: one for each core on a CPU,
            and this one alone on an accelerator. With 1, this process does it itself.
        make_fitness: makes the fitness, here and in each worker: a function that can be imported by
            its name, see `jobs.MakeFitness`. None: the package's own. By default another one has no
            workers.
        cluster: a Dask scheduler's address, or the path of its scheduler file: its workers score.
        started: from `processes.start_workers`; used if their number is `workers`.

    Returns:
        The executor; to be closed, or used in a `with`.

    Raises:
        InputError: the configuration is wrong, or there is no scheduler.
        WorkerError: workers cannot be started.
    """
    cache = runtime.prepare_process()
    from mjx_revolve.episodes.config import load_config
    from mjx_revolve.numerics.xla import on_cpu

    if isinstance(config, str | Path):
        config = load_config(config)
    if workers is None:
        workers = 1 if make_fitness or not on_cpu() else choose_workers(config)
    if workers < 1:
        raise InputError("workers", "a whole number >= 1, or None", workers)
    if started and (len(started) != workers or cluster):
        for worker in started:
            worker.end()
        started = None
    if workers == 1 and cluster is None:
        from mjx_revolve.evolution.blocks import choose_block

        fitness = (make_fitness or choose_fitness(config))(config)
        return Executor(fitness, choose_block(fitness))
    if not on_cpu():
        import jax

        cpu = "JAX to run on the CPU (JAX_PLATFORMS=cpu), where work is spread over cores"
        found = f"{jax.default_backend()}, which takes the whole population"
        raise InputError("--cluster" if cluster else "--workers", cpu, found)
    if cluster:
        from mjx_revolve.evolution.cluster import ClusterExecutor

        return ClusterExecutor(config, make_fitness, cluster)
    from mjx_revolve.evolution.processes import ProcessExecutor, start_workers

    return ProcessExecutor(config, make_fitness, started or start_workers(workers, cache), cache)
