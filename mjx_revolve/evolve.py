"""Command line: evolves a robot and documents the run in a folder.

    python -m mjx_revolve.evolve lake_swim [--seed N] [--out DIR]
    python -m mjx_revolve.evolve --resume DIR

The population is spread over this machine's cores, or over the workers of a Dask cluster with
`--cluster` (see `mjx_revolve.evolution.executor`); results do not depend on it.

Heavy imports stand inside functions: thread settings must be made before NumPy and JAX are loaded,
and `--help` is there at once.
"""

from __future__ import annotations

import argparse
import contextlib
import shlex
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from mjx_revolve.evolution.interrupts import Interrupts
from mjx_revolve.evolution.jobs import WorkerError
from mjx_revolve.inputs.commands import (
    Parser,
    add_run_arguments,
    check_no_fit,
    check_run_arguments,
    describe_refusal,
    program,
    program_again,
    read_path,
    read_seed,
    run_command,
    say,
)
from mjx_revolve.inputs.errors import InputError, plain
from mjx_revolve.inputs.files import short_path
from mjx_revolve.inputs.shipped import find_shipped, list_shipped
from mjx_revolve.inputs.trust import add_trust_argument, opening, opening_config
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import Config
    from mjx_revolve.evolution.executor import Executor
    from mjx_revolve.evolution.generations import Champion
    from mjx_revolve.evolution.processes import LocalWorker
    from mjx_revolve.evolution.run import Run


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=program("evolve"),
        description="Evolves the controller of one robot; or, where the configuration has "
        "`bodies`, bodies together with their brains; or, where it has `colony` as well, robots "
        "that meet, mate, are born and die in one world. All of it is documented in a run folder.",
        epilog=f"Configurations that come with the package: {', '.join(list_shipped('configs'))}. "
        "lake_coevolve, bed_coevolve and lake_map_elites evolve bodies, lake_colony is a colony. "
        "docs/settings.md lists all settings.",
        examples=(
            "evolve lake_swim --set task.duration=8 --out runs/mine",
            "evolve --resume runs/mine",
            "evolve lake_coevolve --seed 1",
        ),
    )
    add = parser.add_argument
    add("config", nargs="?", type=read_path, metavar="CONFIG",
        help="a YAML file, or a shipped configuration's name, see configs/")  # fmt: skip
    add("--seed", type=read_seed, metavar="N", help="replaces evolution.seed")
    add("--out", type=read_path, metavar="DIR", help="run folder (default: runs/CONFIG-TIME)")
    add("--resume", type=read_path, metavar="DIR", help="continue this run folder, bit for bit")
    add("--set", action="append", default=[], metavar="KEY.PATH=VALUE", dest="settings",
        help="replace one value of the configuration; may be repeated")  # fmt: skip
    add_run_arguments(parser)
    add_trust_argument(parser)
    return parser


def main(argv: list[str] | None = None, make_fitness: Callable | None = None) -> int:
    """Runs the command.

    Args:
        argv: the arguments; None: `sys.argv[1:]`.
        make_fitness: makes a fitness from a `Config` (see `executor.make_executor`); None: the real
            one.

    Returns:
        The exit code: 0 when the run is finished, 130, 143 or 129 when it was interrupted, 1 when
        the disk refused a file or no worker was left.

    Raises:
        InputError: the arguments, the configuration or the run folder are wrong.
    """
    arguments = _parser().parse_args(argv)
    check_run_arguments(arguments)
    if arguments.seed is not None:
        arguments.settings.append(f"evolution.seed={arguments.seed}")
    try:
        # From the first heavy import on: some of them swallow a KeyboardInterrupt, or die of it.
        with Interrupts() as interrupts, contextlib.ExitStack() as executors:
            runtime.fix_environment()
            return _lead(arguments, make_fitness, executors, interrupts)
    except WorkerError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _lead(
    arguments: argparse.Namespace,
    make_fitness: Callable | None,
    executors: contextlib.ExitStack,
    interrupts: Interrupts,
) -> int:
    """A whole run; `executors` ends its workers."""
    with runtime.few_collections():
        run = _start(arguments, make_fitness, executors, interrupts)
    try:
        return _evolve(run, interrupts)
    except WorkerError as error:
        raise WorkerError(f"{error}\n{_resume_hint(run)}") from None
    except BrokenPipeError:
        raise  # standard output is closed: no fault of the disk
    except OSError as error:
        print(f"error: {describe_refusal(error)}", file=sys.stderr)
        if saved := run.folder.checkpoints():
            last = f"the last checkpoint, {short_path(saved[0])}, is intact"
            print(f"{last}\n{_resume_hint(run)}", file=sys.stderr)
        return 1
    finally:
        run.close()


def _start(
    arguments: argparse.Namespace,
    make_fitness: Callable | None,
    executors: contextlib.ExitStack,
    interrupts: Interrupts,
) -> Run:
    """The run, new or resumed, with its workers."""
    started: list[LocalWorker] = []

    def make(config: Config) -> Executor:
        from mjx_revolve.evolution.executor import make_executor

        workers, cluster = arguments.workers, arguments.cluster
        made = make_executor(config, workers, make_fitness, cluster, started)
        return executors.enter_context(made)

    path, folder, settings = arguments.config, arguments.resume, arguments.settings
    if path is None and folder is None:
        raise InputError("expected a CONFIG, or --resume DIR; found neither")
    if folder is not None and arguments.out is not None:
        raise InputError(f"--resume {folder}", "no --out beside it", arguments.out)
    trust = arguments.trust
    config = _check(arguments, files=make_fitness is None)
    say(plain(f"loading {folder or path}"))  # it takes seconds
    count = 1
    if make_fitness is None and not arguments.cluster and runtime.expects_cpu():
        from mjx_revolve.evolution.executor import choose_workers

        count = arguments.workers or choose_workers(config)
    from mjx_revolve.evolution.processes import can_fork, start_workers

    # A user's code may start threads when it is imported.
    forks = can_fork() and not config.has_user_code
    if count > 1 and not forks:  # they import JAX and the rest while this process does
        started += start_workers(count, runtime.find_cache())
    cache = runtime.prepare_process()
    from mjx_revolve.evolution.run import Run

    if count > 1 and forks:
        started += start_workers(count, cache, fork=True)
    for worker in started:
        executors.callback(worker.end)
    if folder is None:
        with opening_config(path, trust):
            return Run.begin(path, settings, arguments.out, make, interrupts.writing)
    with opening(folder, *([path] if path else []), trust=trust):
        return Run.resume(folder, path, settings, make)


def _check(arguments: argparse.Namespace, files: bool) -> Config:
    """The configuration; a wrong one, or a wrong folder, is refused before JAX is imported.

    `files`: whether those that it names are read, too; another fitness may have others.
    """
    path, folder = arguments.config, arguments.resume
    from mjx_revolve.episodes.config import load_config
    from mjx_revolve.episodes.named_files import check_files
    from mjx_revolve.episodes.strategy_names import check_strategies
    from mjx_revolve.evolution.run_folder import check_new_folder, check_run_folder

    if folder is None:
        with opening_config(path, arguments.trust):
            config = load_config(path, arguments.settings)
            check_strategies(config)
            if files:
                check_files(config)
            if arguments.out is not None:
                check_new_folder(arguments.out)
            return config
    if path is not None:
        find_shipped(path, "configs")  # a name that there is not is known at once
    found = check_run_folder(folder) / "config.yaml"
    check_no_fit(folder)
    with opening(folder, *([path] if path else []), trust=arguments.trust):
        return load_config(found, () if path else arguments.settings)


def _evolve(run: Run, interrupts: Interrupts) -> int:
    """Evolves a run with checked arguments."""
    config, place = run.config, short_path(run.folder.path)
    if run.is_finished:
        say(
            f"{place}: finished after {run.generation} {run.unit}s; to go on: "
            f"--set evolution.generations={2 * run.generation}"
        )
        return 0
    say(plain(_describe(run)))
    if run.resumed:
        say(f"resuming {run.resumption}")
    interrupts.finish_first("finishing what is under way")
    champion = run.evolve(interrupts, _save_pictures)
    if champion is None:
        saved = f"stopped after {run.unit} {run.generation}; all of it is saved"
        say(f"{saved}\n{_resume_hint(run)}")
        return interrupts.exit_code
    from mjx_revolve.view.results import describe_score

    say(f"champion: {describe_score(champion, config)} ({champion.origin})")
    if champion.measures:
        figures = (f"{name} {value:.3g}" for name, value in champion.measures.items())
        say(f"measures: {', '.join(figures)}")
    say(f"run folder: {place}")
    return 0


def _save_pictures(run: Run, champion: Champion) -> None:
    """What draws takes seconds to import: not before the first generation."""
    from mjx_revolve.view.results import save_pictures

    save_pictures(run, champion)


def _describe(run: Run) -> str:
    """The first line of a run."""
    import jax

    from mjx_revolve.episodes.fitness import Fitness

    executor, config = run.executor, run.config
    body = ""
    if isinstance(executor.fitness, Fitness):
        robot = executor.fitness.robot
        body = f"{robot.morphology.name} ({robot.morphology.counts}), "
    if config.bodies is not None:
        body = f"bodies ({config.bodies.name}, at most {config.bodies.max_modules} modules), "
    evolution = config.evolution
    device = jax.devices()[0].device_kind
    if device == "cpu":
        device = f"cpu with {runtime.usable_cores()} cores"
    if executor.place:
        device = f"workers at {executor.place}"
    elif executor.num_workers > 1:
        device += f", {executor.num_workers} workers"
    return (
        f"{body}{executor.num_genes} genes | {config.subject} | "
        f"{_search_words(config)}, seed {evolution.seed} | {device} | {short_path(run.folder.path)}"
    )


def _search_words(config: Config) -> str:
    """How it is searched, and for how long."""
    size, generations = config.evolution.population_size, config.evolution.generations
    if config.colony is not None:
        return f"at most {size} robots, {generations} intervals"
    if config.bodies is None:
        return f"{config.evolution.strategy} {size} x {generations}"
    selection, learning = config.bodies.selection, config.bodies.learning
    learns = f", {learning.trials} trials a life" if learning.trials > 1 else ""
    return f"{selection.type}{learns}, {size} x {generations}"


def _resume_hint(run: Run) -> str:
    place = shlex.quote(short_path(run.folder.path))
    return f"resume: {program_again('evolve')} --resume {place}"


if __name__ == "__main__":
    sys.exit(run_command(main))
