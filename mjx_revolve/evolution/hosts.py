"""What a host does that serves another one's run.

Host 0 leads: it runs the strategy and writes the run folder. The others are given the same command
line; they build the same fitness, start their workers, which report to the leader, and serve until
it says to stop.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from mjx_revolve.episodes.config import Config, load_config, override_config
from mjx_revolve.evolution.crew import Crew, WorkerError, make_job
from mjx_revolve.evolution.interrupts import Interrupts
from mjx_revolve.evolution.place import Place
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime

# How often workers are looked after [s].
_TICK = 0.2
# How long the leader may take to appear [s].
_PATIENCE = 300.0


def load_served_config(path: str | None, resume: str | None, settings: Sequence[str]) -> Config:
    """The leader's configuration, from the same command line.

    Raises:
        InputError: it is wrong, or there is none.
    """
    if resume is not None:
        kept = Path(resume) / "config.yaml"
        if kept.is_file():
            return override_config(load_config(kept), settings)
        if path is None:
            raise InputError(
                f"--resume {resume}: expected the run folder, or CONFIG beside it, on each host; "
                "found neither"
            )
    if path is None:
        raise InputError("expected a CONFIG, or --resume DIR; found neither")
    return load_config(path, settings)


def start_crew(
    config: Config, make_fitness: Callable | None, workers: int | None, place: Place
) -> Crew:
    """Starts this host's workers, which report to the leader; see `pool.make_pool`.

    Raises:
        WorkerError: they cannot be started.
    """
    cache = runtime.prepare_process()
    job = make_job(config, make_fitness, place, cache, _PATIENCE)
    return Crew(workers or runtime.usable_cores(), job)


def serve(crew: Crew) -> int:
    """Waits until the leader stops the workers, and ends them all as soon as one fails.

    Returns:
        The exit code: 0 when the run is done, 130 or 143 when interrupted.

    Raises:
        InputError: the leader has another configuration, another program or another secret.
        WorkerError: a worker died, the leader is gone, or it ended the run.
    """
    try:
        # Schedulers and launchers signal all processes of a job: the leader is to decide.
        with Interrupts("serving until the leader stops") as interrupts:
            _watch(crew)
            return interrupts.exit_code
    finally:
        crew.close(0.0)


def _watch(crew: Crew) -> None:
    """Waits for the workers to end."""
    while None in (codes := _exit_codes(crew)) and not any(codes):
        time.sleep(_TICK)
    if not any(codes):
        return
    # Of several that fail together, those that were refused know best why.
    time.sleep(_TICK)
    codes = _exit_codes(crew)
    index = codes.index(2) if 2 in codes else next(i for i, code in enumerate(codes) if code)
    worker = crew.workers[index]
    words = worker.last_words()
    if codes[index] == 2:
        raise InputError(words)
    if codes[index] != 1 or not words:
        words = f"worker {index + 1} of {len(codes)} died ({worker.describe_end()})"
    raise WorkerError(words)


def _exit_codes(crew: Crew) -> list[int | None]:
    return [worker.process.poll() for worker in crew.workers]
