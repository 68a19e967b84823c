"""Command line: a grid of runs, with as many seeds each, and one report over all of them.

    python -m mjx_revolve.sweep lake_swim --seeds 10 --set morphology=spider,gecko [--out DIR]

The same command goes on with a sweep that was stopped or killed: finished runs are skipped, the one
that was under way continues at its checkpoint, bit for bit. Each run is an ordinary run folder,
`DIR/CASE/seed_K`. The runs take turns, each with all workers (see `mjx_revolve.evolve`).
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mjx_revolve.inputs.commands import (
    Parser,
    add_run_arguments,
    check_run_arguments,
    program,
    program_again,
    read_path,
    run_command,
    say,
    whole,
)
from mjx_revolve.inputs.errors import InputError, plain
from mjx_revolve.inputs.files import short_path
from mjx_revolve.inputs.grids import MOST_SEEDS, combine, read_axes
from mjx_revolve.inputs.shipped import find_shipped
from mjx_revolve.inputs.trust import add_trust_argument, opening_config
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.evolution.sweeps import Sweep


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=program("sweep"),
        description="Runs a grid of evolutions, several seeds of each, and reports on all of them. "
        "Started again, it skips what is finished and goes on with the rest.",
        examples=(
            "sweep lake_swim --seeds 10 --set morphology=spider,gecko --out runs/bodies_by_hand",
        ),
    )
    add = parser.add_argument
    add("config", type=read_path, metavar="CONFIG",
        help="a YAML file, or a shipped configuration's name, see configs/")  # fmt: skip
    add("--seeds", type=whole(1, MOST_SEEDS), default=5, metavar="N",
        help="runs of each case (default: 5)")  # fmt: skip
    add("--first-seed", type=whole(0, 2**32 - 1 - MOST_SEEDS), default=0, metavar="K",
        help="their seeds are K, K + 1, ... (default: 0)")  # fmt: skip
    add("--set", action="append", default=[], metavar="KEY.PATH=VALUE,...", dest="settings",
        help="values of one setting, with commas between them; may be repeated: all combinations "
        "are run")  # fmt: skip
    add("--out", type=read_path, metavar="DIR",
        help="the sweep's folder (default: runs/CONFIG-sweep-X, X by --set)")  # fmt: skip
    add_run_arguments(parser)
    add_trust_argument(parser)
    return parser


def main(argv: list[str] | None = None, make_fitness: Callable | None = None) -> int:
    """Runs the command.

    Args:
        argv: the arguments; None: `sys.argv[1:]`.
        make_fitness: see `mjx_revolve.evolve.main`.

    Returns:
        The exit code: 0 when all runs are finished, 130 or 143 when interrupted, 1 when the disk
        refused a file or no worker was left.

    Raises:
        InputError: the arguments, a configuration or a run folder are wrong.
    """
    argv = sys.argv[1:] if argv is None else argv
    arguments = _parser().parse_args(argv)
    check_run_arguments(arguments)
    path = find_shipped(arguments.config, "configs").absolute()
    runtime.fix_environment()
    _check_configs(path, arguments.settings, arguments.trust)
    print(plain(f"loading {arguments.config}"), flush=True)  # it takes seconds
    runtime.prepare_process()
    from mjx_revolve.evolution.executor import make_executor
    from mjx_revolve.evolution.sweeps import (
        Sweep,
        check_folder,
        choose_steps,
        run_plans,
        write_sweep,
    )
    from mjx_revolve.view.report.page import default_page
    from mjx_revolve.view.report.sweep import write_report
    from mjx_revolve.view.results import save_pictures

    sweep = Sweep(str(path), arguments.seeds, tuple(arguments.settings), arguments.first_seed)
    folder = Path(arguments.out) if arguments.out else _usual_folder(sweep)
    check_folder(folder, sweep)
    default_page(folder)  # refuses now what it would refuse after days
    steps = choose_steps(sweep.plans(folder.absolute()), make_fitness, arguments.trust)
    write_sweep(folder, sweep)
    cases = len(sweep.cases)
    print(f"{cases} case{'s' * (cases > 1)}, {sweep.seeds} seed{'s' * (sweep.seeds > 1)} each | "
          f"{short_path(folder)}", flush=True)  # fmt: skip
    again = f"{program_again('sweep')} {shlex.join(argv)}"
    workers, cluster = arguments.workers, arguments.cluster
    make = lambda config: make_executor(config, workers, make_fitness, cluster)  # noqa: E731
    code = run_plans(steps, make, save_pictures, again, arguments.trust)
    if code not in (0, 2):  # runs that failed by themselves leave the others to report on
        return code
    say("writing the report")
    report = write_report(folder)
    for line in report.lost:
        print(f"warning: {line}", file=sys.stderr)
    say(f"report: {short_path(report.page)}; {short_path(report.table)}")
    return code


def _check_configs(path: Path, settings: Sequence[str], trust: bool) -> None:
    """Refuses wrong configurations before JAX is imported."""
    from mjx_revolve.episodes.config import load_config
    from mjx_revolve.episodes.strategy_names import check_strategies

    cases = combine(read_axes(settings), path.stem)
    for case, own in cases.items():
        try:
            with opening_config(path, trust):
                check_strategies(load_config(path, own))
        except InputError as error:
            raise InputError(f"{case}: {error}" if len(cases) > 1 else str(error)) from None


def _usual_folder(sweep: Sweep) -> Path:
    """The same for the same command, so that it goes on; more seeds make it a longer one."""
    from mjx_revolve.evolution.fingerprints import hash_text

    first = (f"first seed {sweep.first_seed}",) if sweep.first_seed else ()
    digest = hash_text(sweep.config, *sweep.settings, *first)[:6]
    return Path("runs") / f"{Path(sweep.config).stem}-sweep-{digest}"


if __name__ == "__main__":
    sys.exit(run_command(main))
