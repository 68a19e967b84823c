"""What a worker has to do, on this machine or another: a job, how it is opened, and shared out.

Imports stand inside functions: a worker's threads are set before NumPy and JAX are loaded.
"""

from __future__ import annotations

import contextlib
import json
import os
import pkgutil
import statistics
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from mjx_revolve.inputs.own_code import parse_own
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    import jax
    import numpy as np

    from mjx_revolve.episodes.config import Config
    from mjx_revolve.evolution.blocks import Block, Scored

# The real fitness, of one body's genes, and of bodies that evolve.
MAKE_FITNESS = "mjx_revolve.episodes.fitness:make_fitness"
MAKE_BODY_FITNESS = "mjx_revolve.evolution.body_fitness:make_body_fitness"
# How often a block is tried before it is given up (a choice).
TRIES = 3


class WorkerError(RuntimeError):
    """There is nobody left to score; the message says what is known of it."""


@dataclass(frozen=True)
class Limits:
    """How long a worker may be silent before it is given up [s] (choices).

    Attributes:
        ready: until it has built and compiled its fitness.
        block: for a block, and at least ...
        factor: ... this many times the median of those before it.
    """

    ready: float = 900.0
    block: float = 300.0
    factor: float = 50.0

    def patience(self, times: Sequence[float]) -> float:
        """For the next block, by what those before it took [s]."""
        return max(self.block, self.factor * statistics.median(times)) if times else self.block


LIMITS = Limits()


@dataclass(frozen=True)
class Job:
    """What to score: all that makes a fitness, as values that a process on any machine can be sent.

    Attributes:
        config: the configuration as JSON.
        source: what messages call it.
        files: robots and code that it names, by path; a world or modules file stays where it is,
            because it may refer to files beside it.
        make: the function that makes the fitness, `module:name`.
        limits: how long to wait.
    """

    config: str
    source: str
    files: tuple[tuple[str, bytes], ...]
    make: str
    limits: Limits


def choose_fitness(config: Config) -> str:
    """The name of the function that makes the real fitness of a configuration."""
    return MAKE_FITNESS if config.bodies is None else MAKE_BODY_FITNESS


def make_job(config: Config, make_fitness: Callable | None) -> Job:
    """A job.

    Args:
        config: of the run.
        make_fitness: a function that workers can import by its name; None: the real one.

    Raises:
        ValueError: the function cannot be imported by its name.
    """
    make = choose_fitness(config)
    if make_fitness is not None:
        make = f"{make_fitness.__module__}:{make_fitness.__qualname__}"
        if make_fitness.__module__ == "__main__" or "<" in make:
            raise ValueError(
                f"make_fitness: expected a function that can be imported; found {make}"
            )
    data = config.model_dump()
    files: dict[str, bytes] = {}

    def keep(text: str) -> str:
        own = parse_own(text)
        path = own.path if own else text
        if os.path.isabs(path) and os.path.isfile(path):
            files[path] = Path(path).read_bytes()
        return text

    _map_texts({key: data[key] for key in data if key not in ("world", "modules")}, keep)
    return Job(json.dumps(data), config.source, tuple(files.items()), make, LIMITS)


def _map_texts(value: Any, change: Callable[[str], str]) -> Any:
    """The same nested values with all texts changed."""
    if isinstance(value, dict):
        return {key: _map_texts(item, change) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_map_texts(item, change) for item in value]
    return change(value) if isinstance(value, str) else value


def open_job(job: Job, scratch: Path | None = None) -> Any:
    """The fitness of a job.

    Args:
        job: the job.
        scratch: an empty folder for copies of its files; None: one that is gone afterwards.

    Returns:
        The fitness.

    Raises:
        InputError: a file that its configuration names is missing or wrong here.
    """
    from mjx_revolve.episodes.config import make_config

    with contextlib.ExitStack() as made:
        folder = scratch or made.enter_context(tempfile.TemporaryDirectory(prefix="mjx_revolve_"))
        copies = {}
        for number, (path, content) in enumerate(job.files):
            copy = Path(folder) / str(number) / Path(path).name
            copy.parent.mkdir()
            copy.write_bytes(content)
            copies[path] = str(copy)

        def move(text: str) -> str:
            own = parse_own(text)
            if own and own.path in copies:
                return f"{copies[own.path]}:{own.function}"
            return copies.get(text, text)

        config = make_config(_map_texts(json.loads(job.config), move), "/", source=job.source)
        return pkgutil.resolve_name(job.make)(config)


def compile_job(job: Job, fitness: Any) -> None:
    """Has a fitness compiled; of a host's workers the first does, and the others read its cache."""
    import jax

    from mjx_revolve.evolution.blocks import evaluate_block, example_block
    from mjx_revolve.evolution.fingerprints import hash_text

    example = example_block(fitness, json.loads(job.config)["evolution"]["population_size"])
    with runtime.one_compiles(hash_text(job.make, job.config)):
        evaluate_block(fitness, example, jax.random.key(0))


def describe_error(error: BaseException) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}".rstrip(": ")


News = list[tuple[int, "Scored | str | None"]]
"""Numbers of blocks; the scores of each, or why it failed, or None: it was not even begun."""


class Crew(Protocol):
    """Workers as `share_out` sees them."""

    def free(self) -> Iterable[Any]:
        """Those that can take a block."""

    def send(self, worker: Any, number: int, block: Block, key: tuple[np.ndarray, str]) -> None:
        """Gives a block to one of them."""

    def attend(self) -> News:
        """Waits for news, but not for long."""


def share_out(crew: Crew, blocks: Sequence[Block], key: jax.Array) -> list[Scored | str]:
    """Has workers score blocks, whoever is free the next one; see `blocks.Workplace.score`.

    A block is a pure function, so one whose worker was lost is scored again, and gives the same.
    One that fails `TRIES` times is given up.
    """
    from mjx_revolve.evolution.blocks import key_as_data

    data = key_as_data(key)
    waiting = deque(range(len(blocks)))
    results: dict[int, Scored | str] = {}
    reasons: dict[int, list[str]] = {number: [] for number in waiting}
    while len(results) < len(blocks):
        for worker in crew.free():
            if waiting:
                number = waiting.popleft()
                crew.send(worker, number, blocks[number], data)
        for number, result in crew.attend():
            if isinstance(result, str):
                reasons[number].append(result)
                given_up = len(reasons[number]) == TRIES
                result = ", ".join(dict.fromkeys(reasons[number])) if given_up else None
            if result is None:
                waiting.appendleft(number)
            else:
                results[number] = result
    return [results[number] for number in range(len(blocks))]
