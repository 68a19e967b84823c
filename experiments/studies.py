"""Many evolutions that are one study, run as a sweep is: stopped and continued as one.

A study is a folder as `mjx_revolve.evolution.sweeps` describes it; what is compared, and how it is
reported, is for the experiments to say.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from experiments.common import as_numbers, make_folder, make_parser, write_results
from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.run_reader import RunReader
from mjx_revolve.episodes.scoring import WORST
from mjx_revolve.evolution.executor import make_executor
from mjx_revolve.evolution.generations import Champion
from mjx_revolve.evolution.run import Run
from mjx_revolve.evolution.sweeps import Plan, choose_steps, next_step, run_plans
from mjx_revolve.evolution.sweeps import make_plans as plan_runs
from mjx_revolve.inputs.commands import Parser, whole
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import short_path
from mjx_revolve.numerics.runtime import prepare_process
from mjx_revolve.view.convergence import draw_curves
from mjx_revolve.view.outcomes import Figures, Outcome, by_case, find_outcomes
from mjx_revolve.view.results import save_pictures
from mjx_revolve.view.statistics import interval

BASE = Path(__file__).with_name("studies.yaml")
MAKE_FITNESS = None  # the real one; see `executor.make_executor`
_KEY, _STARTS = 20_000, 8  # of the starts from which champions are judged; a choice


class Case(NamedTuple):
    """What is compared with others.

    Attributes:
        words: what it is, for reports.
        settings: in what it differs from the study's configuration, `KEY.PATH=VALUE` each.
    """

    words: str
    settings: tuple[str, ...]


def study_parser(name: str, description: str, cases: Mapping[str, Case]) -> Parser:
    """A parser with the options that studies share: seeds, cases, budget, whether to report only.

    Args:
        name: of the experiment's module.
        description: what it does, in a sentence.
        cases: what it compares.

    Returns:
        The parser.
    """

    def read_cases(text: str) -> list[str]:
        """Some of the cases, in their order."""
        names = text.split(",")
        if wrong := [n for n in names if n not in cases]:
            known = ", ".join(cases)
            raise argparse.ArgumentTypeError(f"expected any of {known}; found {wrong[0]!r}")
        return [n for n in cases if n in names]

    parser = make_parser(name, description)
    add = parser.add_argument
    add("--seeds", type=whole(1), default=5, metavar="N", help="runs of each case (default: 5)")
    add("--only", type=read_cases, default=list(cases), metavar="NAME,...", help=", ".join(cases))
    add("--generations", type=whole(1), metavar="N", help="replaces evolution.generations")
    add("--set", action="append", default=[], metavar="KEY.PATH=VALUE", dest="settings",
        help="replace one value of all configurations; may be repeated")  # fmt: skip
    add("--report", action="store_true", help="run nothing, report what is finished")
    return parser


def study_main(
    name: str,
    description: str,
    make_cases: Callable[[Sequence[str]], Mapping[str, Case]],
    write_report: Callable[[Path, Sequence[Outcome]], dict[str, Any]],
    argv: list[str] | None = None,
    add: Callable[[str, Figures], Figures] = lambda case, figures: {},
) -> int:
    """Runs a study, and reports it.

    Args:
        name: of the experiment's module.
        description: what it does, in a sentence.
        make_cases: what is compared, from what replaces values of the configuration.
        write_report: writes tables and pictures into a folder, from the outcomes; returns the
            numbers for a results file, `runs` among them.
        argv: the arguments; by default the command line's.
        add: as in `read_outcomes`.

    Returns:
        The exit code, see `run_study`.
    """
    argv = sys.argv[1:] if argv is None else argv
    options = study_parser(name, description, make_cases(())).parse_args(argv)
    folder, plans = make_plans(make_cases(given_settings(options)), options, name)
    if options.report:
        check_finished(plans)
    elif code := run_study(plans, name, argv):
        return code
    outcomes = judge_champions(read_outcomes(plans, add))
    if options.results and len(outcomes) < len(plans):
        raise InputError("--results", f"{len(plans)} finished runs", len(outcomes))
    numbers = write_report(folder, outcomes)
    for run in numbers["runs"]:
        print(f"{run['name']}: {run['score']['text']} body lengths/s, {run['seeds']} seeds")
    print(f"{len(outcomes)} of {len(plans)} runs; written: {name}.csv in {short_path(folder)}")
    if options.results:
        numbers = numbers | {"settings": [*given_settings(options)]}
        write_results(name, numbers, sorted({one.plan.seed for one in outcomes}))
    return 0


def check_finished(plans: Sequence[Plan]) -> None:
    """Raises `InputError` for a finished run of another configuration or of fewer generations."""
    for plan in plans:
        if RunReader(plan.folder).is_finished and next_step(plan) != "finished":
            raise InputError(plan.name, "a run of all generations", "a shorter one")


def given_settings(options: argparse.Namespace) -> tuple[str, ...]:
    """What the options of `study_parser` replace in all configurations, `KEY.PATH=VALUE` each."""
    if options.generations is None:
        return tuple(options.settings)
    return (*options.settings, f"evolution.generations={options.generations}")


def make_plans(
    cases: Mapping[str, Case], options: argparse.Namespace, name: str
) -> tuple[Path, list[Plan]]:
    """The evolutions of a study.

    Args:
        cases: what is compared.
        options: from `study_parser`.
        name: of the experiment's module.

    Returns:
        The study's folder, and the plans.

    Raises:
        InputError: the folder cannot be made.
    """
    folder = make_folder(options.out, name).resolve()
    given = given_settings(options)
    settings = {case: (*given, *cases[case].settings) for case in options.only}
    return folder, plan_runs(folder, BASE, settings, range(options.seeds))


def run_study(
    plans: Sequence[Plan],
    name: str,
    argv: Sequence[str],
    draw: Callable[[Run, Champion], None] | None = None,
) -> int:
    """Runs what is not finished; see `sweeps.run_plans`.

    Args:
        plans: the evolutions.
        name: of the experiment's module.
        argv: its arguments, for the hint how to go on.
        draw: writes the pictures of a run; by default those that each run has.

    Returns:
        The exit code.

    Raises:
        InputError: a run is wrong, or cannot go on.
    """
    prepare_process()
    again = shlex.join(["python", "-m", f"experiments.{name}", *argv])
    steps = choose_steps(plans, MAKE_FITNESS)
    return run_plans(
        steps,
        lambda config: make_executor(config, make_fitness=MAKE_FITNESS),
        draw or save_pictures,
        again,
    )


def read_outcomes(
    plans: Sequence[Plan], add: Callable[[str, Figures], Figures] = lambda case, figures: {}
) -> list[Outcome]:
    """What the finished runs have found.

    Args:
        plans: the runs; those that are not finished are left out.
        add: (case, figures of an individual) → more figures of it.

    Returns:
        The outcomes.

    Raises:
        InputError: none is finished, or a run is damaged.
    """
    found, lost = find_outcomes(plans, add)
    if lost:
        raise InputError(lost[0])
    if not found:
        raise InputError("--report", "runs that are finished", "none")
    return found


def judge_champions(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Scores the champions as they were not selected: with all joints at rest, and for longer.

    A body that starts in another attitude than that in which it hangs in the water turns, and its
    core moves; what it scores by that is not swimming. A score that is extrapolated to a horizon
    (`task.horizon`) supposes that a robot goes on turning as it did; to swim as long shows it.

    Args:
        outcomes: of the finished runs.

    Returns:
        The same with `still_score` and `swum_score` among the champions' figures, means over a few
        fresh starts; without a horizon the second is over the task's own time.
    """
    prepare_process()
    found = []
    for some in by_case(outcomes, dict.fromkeys(o.plan.case for o in outcomes)).values():
        config = some[0].plan.config
        seconds = config.task.horizon or config.task.duration
        task = config.task.model_copy(update={"duration": seconds, "horizon": None})
        still = _champion_scores(config, some, 0.0)
        swum = _champion_scores(config.model_copy(update={"task": task}), some, 1.0)
        found += [
            o._replace(champion={**o.champion, "still_score": a, "swum_score": b})
            for o, a, b in zip(some, still.tolist(), swum.tolist(), strict=True)
        ]
    return found


def _champion_scores(config: Config, outcomes: Sequence[Outcome], share: float) -> np.ndarray:
    """`[n]` of one case, with a share of each champion's genes."""
    import jax

    from mjx_revolve.episodes.fitness import make_fitness
    from mjx_revolve.evolution.body_fitness import make_body_fitness
    from mjx_revolve.evolution.executor import Executor
    from mjx_revolve.evolution.individuals import Individual
    from mjx_revolve.evolution.learning import score_brains

    keys = jax.random.split(jax.random.key(_KEY), _STARTS)
    make = MAKE_FITNESS or (make_fitness if config.bodies is None else make_body_fitness)
    fitness = make(config)
    genes = [share * RunReader(o.plan.folder).load_champion().genes for o in outcomes]
    if config.bodies is None:
        brains = np.array(genes, np.float32)
        return _means([fitness.evaluate(brains, key)[0] for key in keys], outcomes)
    executor = Executor(fitness, fitness.block_size)
    some = [Individual(k, (), 0, "champion", None, o.body, None) for k, o in enumerate(outcomes)]
    rows = [np.zeros((1, fitness.num_genes), np.float32) for _ in some]
    for row, own, one in zip(rows, genes, some, strict=True):
        row[0, fitness.layout(one.body).columns] = own
    scores = [[s[0] for s, _ in score_brains(executor, some, rows, key)] for key in keys]
    return _means(scores, outcomes)


def _means(scores: Sequence[Any], outcomes: Sequence[Outcome]) -> np.ndarray:
    """`[n]` means over starts, which a champion that fails in one has not."""
    found = np.asarray(scores, float)
    failed = ~np.isfinite(found) | (found <= WORST)
    for outcome, starts in zip(outcomes, failed.sum(0).tolist(), strict=True):
        if starts:
            each = f"finite scores from {_STARTS} starts"
            raise InputError(outcome.plan.name, each, f"{starts} that failed")
    return found.mean(0)


def describe_runs(
    cases: Mapping[str, Sequence[Outcome]], known: Mapping[str, Case]
) -> list[dict[str, Any]]:
    """What was run, how often, for how long, and the champions' scores, for a results file.

    Args:
        cases: outcomes by case.
        known: the cases by name.

    Returns:
        An entry for each case.
    """
    return [
        {
            "name": name,
            "what": known[name].words,
            "seeds": len(outcomes),
            "trials": int(np.mean([o.metrics["evaluations"][-1] for o in outcomes])),
            "seconds": float(np.mean([o.metrics["seconds"][-1] for o in outcomes])),
            **{
                figure: as_numbers(interval([o.champion.get(figure, np.nan) for o in outcomes]))
                for figure in ("score", "swum_score", "still_score", "speed_m_s")
            },
        }
        for name, outcomes in cases.items()
    ]


def draw_outcomes(axes: Axes, cases: Mapping[str, Sequence[Outcome]], label: str) -> None:
    """Draws `draw_curves` of runs by case over evaluated individuals; `label` names the score."""
    curves = {name: [(o.metrics["evaluations"], o.metrics["champion"]) for o in outcomes]
              for name, outcomes in cases.items()}  # fmt: skip
    draw_curves(axes, curves)
    axes.set(xlabel="evaluated individuals", ylabel=label)
    axes.legend(loc="best")
