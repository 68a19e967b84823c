"""A job: the values from which a worker, on this machine or another, makes a fitness.

Imports stand inside functions: a worker's threads are set before NumPy and JAX are loaded.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import Config

MakeFitness = Callable[["Config"], Any]
"""Makes a fitness: any object with `evaluate(*block, key)`.

It has `num_genes` where that takes genes alone, or else `example_block()`, a block to compile for;
it may have `block_size`, the individuals in a block.
"""


class WorkerError(RuntimeError):
    """No worker is left to score; the message says what is known of the reason."""


@dataclass(frozen=True)
class Limits:
    """Time limits of workers [s] (choices).

    Attributes:
        ready: until it has built and compiled its fitness.
        block: for a block, and at least ...
        factor: ... this many times the median of those before it; `ready` for the first.
        tries: number of attempts to score a block [-].
    """

    ready: float = 900.0
    block: float = 300.0
    factor: float = 50.0
    tries: int = 3

    def timeout(self, times: Sequence[float]) -> float:
        """For the next block, by the times of those before it [s].

        The first has as long as a worker to be ready: that may have scored an example.
        """
        usual = self.factor * statistics.median(times) if times else self.ready
        return max(self.block, usual)


LIMITS = Limits()
SCRATCH = "mjx_revolve_"
"""The beginning of the names of workers' temporary folders."""


@dataclass(frozen=True)
class Job:
    """Everything a fitness is made from, as values that can be sent to a process on any machine.

    Attributes:
        config: the configuration's settings, as they are; JSON has other keys than YAML.
        source: its name in messages.
        files: the files that it names, by the relative paths in it.
        make_fitness: makes the fitness; pickled by its name.
        keeps_programs: whether the fitness is one of ours that keeps its programs on disk.
        limits: of the workers.
    """

    config: Mapping[str, Any]
    source: str
    files: tuple[tuple[str, bytes], ...]
    make_fitness: MakeFitness
    keeps_programs: bool
    limits: Limits


def choose_fitness(config: Config) -> MakeFitness:
    """The function that makes the package's own fitness of a configuration."""
    if config.bodies is None:
        from mjx_revolve.episodes.fitness import make_fitness

        return make_fitness
    from mjx_revolve.evolution.body_fitness import make_body_fitness

    return make_body_fitness


def function_name(function: Callable[..., Any]) -> str:
    """`module:name` of a function."""
    return f"{function.__module__}:{function.__qualname__}"


def make_job(config: Config, make_fitness: MakeFitness | None = None) -> Job:
    """A job.

    Args:
        config: of the run.
        make_fitness: a function that workers can import by its name; None: the package's own.

    Raises:
        ValueError: the function cannot be imported by its name.
    """
    from mjx_revolve.episodes.config import Config
    from mjx_revolve.episodes.settings import copy_files

    own = choose_fitness(config)
    make = make_fitness or own
    name = function_name(make)
    if make.__module__ == "__main__" or "<" in name:
        raise ValueError(f"make_fitness: expected a function that can be imported; found {name}")
    settings, files = copy_files(config.model_dump(), Config)
    keeps = make is own and not config.has_user_code
    return Job(settings, config.source, tuple(files.items()), make, keeps, LIMITS)


def open_job(job: Job, scratch: str | Path) -> Any:
    """The fitness of a job.

    Args:
        job: the job.
        scratch: an empty folder for copies of its files, which users' functions may read later.

    Raises:
        InputError: a file that its configuration names is wrong.
    """
    from mjx_revolve.episodes.config import make_config
    from mjx_revolve.episodes.settings import locate_files

    places = {}
    for name, content in job.files:
        places[name] = Path(scratch) / name
        write_atomic(places[name], content)
    settings = locate_files(job.config, places)
    return job.make_fitness(make_config(settings, "/", source=job.source))


def compile_job(job: Job, fitness: Any) -> None:
    """Compiles a fitness; of a host's workers the first does, and the others read its cache.

    What keeps its programs on disk has a lock for each: all workers read them at once, and none
    needs to call them.
    """
    import jax

    from mjx_revolve.evolution.blocks import evaluate_block, example_block
    from mjx_revolve.evolution.fingerprints import hash_text

    example = example_block(fitness, job.config["evolution"]["population_size"])
    if job.keeps_programs:
        fitness.precompile(*example, jax.random.key(0))
        return
    name = hash_text(function_name(job.make_fitness), repr(job.config))
    with runtime.compile_lock("job", name):
        evaluate_block(fitness, example, jax.random.key(0))


def describe_error(error: BaseException) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}".rstrip(": ")
