"""A run from its first generation, or a later one, to its champion: what is saved, and when."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, TextIO

from mjx_revolve.evolution.fingerprints import model_hash, settings_hash
from mjx_revolve.evolution.interrupts import Interrupts
from mjx_revolve.evolution.jobs import WorkerError
from mjx_revolve.evolution.loop import Champion
from mjx_revolve.evolution.progress import Progress
from mjx_revolve.evolution.runs import Run
from mjx_revolve.evolution.start import Start, describe_host, timestamp
from mjx_revolve.evolution.tensorboard import TensorBoardLog


def write_start(start: Start) -> None:
    """Writes down who evolves what; a run that goes on forgets what came after its checkpoint."""
    run = start.run
    if start.resumed:
        run.rewind(start.checkpoint)
        run.save_config(start.config)
        done = 0 if start.search is None else start.search.generation
        resumption = {"time": timestamp(), "generation": done, "argv": sys.argv}
        resumed = [*run.info.get("resumed", []), resumption]
        run.update_info(resumed=resumed, finished=None, champion=None)
    start.fitness.folder = run.folder / "lost"
    run.update_info(workers=start.fitness.describe())
    # Where the body is the same for all, it is there from the start.
    robot = getattr(start.fitness, "robot", None)
    if robot is not None:
        run.write("champion/morphology.yaml", robot.morphology.save)


def run_to_end(
    start: Start,
    interrupts: Interrupts,
    draw: Callable[[Champion], None],
    out: TextIO | None = None,
) -> tuple[Any, Champion | None]:
    """A whole run, or as much of it as there is before an interrupt; either way it is saved.

    Args:
        start: the run.
        interrupts: looked at after each generation.
        draw: draws the run's pictures; see `finish_run`.
        out: where progress is told; None: standard output.

    Returns:
        The search, and its champion; None where generations are left.

    Raises:
        WorkerError: see `run_generations`.
        OSError: likewise.
    """
    with interrupts.writing:
        write_start(start)
    search = run_generations(start, interrupts, out)
    if interrupts.signal and search.generation < start.config.evolution.generations:
        return search, None
    return search, finish_run(start, search, draw)


def run_generations(start: Start, interrupts: Interrupts, out: TextIO | None = None) -> Any:
    """All generations, or as many as there are before an interrupt or the loss of all workers.

    Args:
        start: the run.
        interrupts: looked at after each generation.
        out: where progress is told; None: standard output.

    Returns:
        The search, which is saved.

    Raises:
        WorkerError: nobody is left to score; what was done until then is saved.
        OSError: the disk is full.
    """
    run, evolution, method = start.run, start.config.evolution, start.method
    search = start.search
    before = 0 if search is None else search.generation
    log = _open_log(run, before) if evolution.tensorboard else None
    progress = Progress(before, evolution.generations, out)
    unsaved: Any = None

    def save() -> None:
        nonlocal unsaved
        if unsaved is not None:
            _save(start, unsaved)
            unsaved = None

    interrupts.rescue = save
    try:
        for search, row in method.advance(start.search):
            done = search.generation
            last = done == evolution.generations
            with interrupts.writing:
                run.append_metrics(row)
                method.record(run, search)
                if log is not None:
                    log.add(row)
                unsaved = search
                if last or done % evolution.checkpoint_every == 0:
                    save()
            progress.show(row)
            if interrupts.signal:
                with interrupts.writing:
                    save()
                break
    except WorkerError as error:
        if search is None:
            search = method.start()
        with interrupts.writing:
            _save(start, search)
            unsaved = None
        done = search.generation
        what = f"generation {done}" if done else "the start, before any generation,"
        raise WorkerError(f"{error}; {what} is saved") from None
    finally:
        progress.close()
        if log is not None:
            log.close()
    assert search is not None  # there is at least one generation, or a checkpoint
    return search


def _open_log(run: Run, done: int) -> TensorBoardLog:
    """TensorBoard's copy of the metrics."""
    table = run.load_metrics() if done else {}
    rows = [dict(zip(table, values, strict=True)) for values in zip(*table.values(), strict=True)]
    return TensorBoardLog(run.folder / "tensorboard", done, rows)


def _save(start: Start, search: Any) -> None:
    """A checkpoint, and the champion so far."""
    config, fitness = start.config, start.fitness
    meta = {
        "settings_hash": settings_hash(config),
        "model_hash": model_hash(fitness),
        "chunk_shape": [fitness.block or config.evolution.population_size, fitness.num_genes],
        "strategy": config.evolution.strategy if config.bodies is None else config.bodies.name,
        "host": describe_host(),
    }
    keep = config.evolution.keep_checkpoints
    start.run.save_checkpoint(search.generation, start.method.to_arrays(search), meta, keep)
    if search.generation:
        start.method.save_best(start.run, search)


def finish_run(start: Start, search: Any, draw: Callable[[Champion], None]) -> Champion:
    """Judges the champion, and closes the books.

    Args:
        start: the run.
        search: after the last generation.
        draw: draws the run's pictures; the run counts as finished once they are there.

    Returns:
        The champion.
    """
    config = start.config
    champion = start.method.judge(search)
    facts: dict[str, Any] = {
        "score": champion.score,
        "score_std": champion.std,
        "origin": champion.origin,
        "controller": config.controller.name,
        "task": config.task.name,
        "measures": champion.measures,
    }
    if champion.individual is not None:
        facts["individual"] = champion.individual
    start.run.save_champion(champion.genes, champion.body, final=True, **facts)
    draw(champion)
    start.run.update_info(finished=timestamp(), generations=search.generation, champion=facts)
    return champion
