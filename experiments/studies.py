"""Many evolutions that are one study: made by the ordinary command, and continued where stopped.

A study is a folder: `CASE/seed_K/` is a run folder, `CASE/seed_K.log` is what its command printed.
Runs that are finished are left alone, so a study is continued by starting it again.
"""

from __future__ import annotations

import argparse
import csv
import io
import os
import shlex
import shutil
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.common import ROOT, make_folder, make_parser, shown
from experiments.statistics import interval
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.body.tree import Morphology
from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.evolution.interrupts import Interrupts
from mjx_revolve.evolution.runs import Run, open_run
from mjx_revolve.evolution.start import check_unchanged
from mjx_revolve.inputs.commands import Parser, whole
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.view.population import read_population

BASE = Path(__file__).with_name("studies.yaml")
COMMAND = (sys.executable, "-m", "mjx_revolve.evolve")
_STILL_KEY, _STARTS = 20_000, 8  # of the starts from which champions are scored at rest; a choice
_LOOK = 0.2  # how often a running command is looked after [s]


class Case(NamedTuple):
    """What is compared with others.

    Attributes:
        words: what it is, for reports.
        settings: in what it differs from the study's configuration, `KEY.PATH=VALUE` each.
    """

    words: str
    settings: tuple[str, ...]


class Plan(NamedTuple):
    """One evolution of a study.

    Attributes:
        case: the name of its case.
        seed: its seed.
        folder: its run folder.
        settings: what replaces values of `BASE`.
    """

    case: str
    seed: int
    folder: Path
    settings: tuple[str, ...]

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.case}/{self.folder.name}"

    @property
    def config(self) -> Config:
        """The configuration, everything replaced.

        Raises:
            InputError: it is wrong.
        """
        return load_config(BASE, [*self.settings, f"evolution.seed={self.seed}"])


class Outcome(NamedTuple):
    """What a finished evolution has found.

    Attributes:
        plan: of the evolution.
        champion: figures of its champion by name: `score` and measures on fresh starts, descriptors
            of its body.
        population: means over those who lived at the end, as their lives went; empty where only
            brains evolve.
        metrics: the columns of `metrics.csv`.
        body: the champion's.
    """

    plan: Plan
    champion: Mapping[str, float]
    population: Mapping[str, float]
    metrics: Mapping[str, np.ndarray]
    body: Morphology


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


def given_settings(options: argparse.Namespace) -> tuple[str, ...]:
    """What the options of `study_parser` replace in all configurations, `KEY.PATH=VALUE` each."""
    if options.generations is None:
        return tuple(options.settings)
    return (*options.settings, f"evolution.generations={options.generations}")


def make_plans(
    cases: Mapping[str, Case], options: argparse.Namespace, name: str
) -> tuple[Path, list[Plan]]:
    """The evolutions of a study, the first seeds of all cases first.

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
    return folder, [
        Plan(case, seed, folder / case / f"seed_{seed}", (*given, *cases[case].settings))
        for seed in range(options.seeds)
        for case in options.only
    ]


def next_command(plan: Plan) -> list[str] | None:
    """Arguments of the command that begins a run or goes on with it.

    A run without a checkpoint is forgotten, as nothing of it is worth keeping.

    Args:
        plan: the run.

    Returns:
        The arguments; None where it is finished.

    Raises:
        InputError: the folder holds something else, or a run that another process writes, of
            another configuration, or with more generations.
    """
    folder, wanted = plan.folder, plan.config
    if folder.exists() and any(folder.iterdir()):
        run = open_run(folder)
        try:
            check_unchanged(run.load_config(), wanted, shown(folder))
            found, length = _generations(run), wanted.evolution.generations
            finished, checkpoints = "finished" in run.info, run.checkpoints()
        finally:
            run.close()
        if found > length:
            raise InputError(
                f"{shown(folder)}: expected a run of {length} generations at most; found {found} "
                "(choose another --out)"
            )
        if finished and found == length:
            return None
        if checkpoints:
            return ["--resume", str(folder), "--set", f"evolution.generations={length}"]
        shutil.rmtree(folder)
    settings = [word for setting in plan.settings for word in ("--set", setting)]
    new = [str(BASE), "--seed", str(plan.seed), "--out", str(folder)]
    return [*new, *settings]


def _generations(run: Run) -> int:
    """How many a run has done."""
    metrics = run.load_metrics() if run.metrics_path.exists() else {}
    return int(metrics["generation"][-1]) if len(metrics.get("generation", ())) else 0


def run_study(plans: Sequence[Plan], name: str, argv: Sequence[str]) -> int:
    """Runs what is not finished, one evolution after the other, with a line for each.

    Ctrl-C ends the evolution under way after its generation, and the study with it.

    Args:
        plans: the evolutions.
        name: of the experiment's module.
        argv: its arguments, for the hint how to go on.

    Returns:
        The exit code: 0 when all are finished, 130 or 143 when interrupted, 1 when one failed.

    Raises:
        InputError: see `next_command`.
    """
    began, ran = time.perf_counter(), 0
    commands = {plan: next_command(plan) for plan in plans}  # what is wrong is said at once
    left = sum(command is not None for command in commands.values())
    with Interrupts("stopping after the generation under way") as interrupts:
        for k, (plan, command) in enumerate(commands.items()):
            print(f"[{k + 1:{len(str(len(plans)))}}/{len(plans)}] {plan.name}: ", end="")
            if command is None:
                print(_result(plan, "finished before"))
                continue
            print("running ... ", end="", flush=True)
            started, log = time.perf_counter(), plan.folder.with_suffix(".log")
            code = _run(command, log, interrupts)
            seconds = time.perf_counter() - started
            if interrupts.signal:
                words = ["python", "-m", f"experiments.{name}", *argv]
                print(f"stopped\ngo on: {shlex.join(words)}", flush=True)
                return interrupts.exit_code
            if code:
                print(f"failed: exit code {code} after {seconds:.0f} s", flush=True)
                print(f"error: {_last_line(log)} (all of it: {shown(log)})", file=sys.stderr)
                return 1
            ran += 1
            left -= 1
            rest = left * (time.perf_counter() - began) / ran
            more = f", some {max(1, round(rest / 60))} min left" if left else ""
            print(_result(plan, f"{seconds:.0f} s{more}"), flush=True)
    return 0


def _run(arguments: Sequence[str], log: Path, interrupts: Interrupts) -> int:
    """Runs the command; what it prints goes to a file."""
    log.parent.mkdir(parents=True, exist_ok=True)
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    with log.open("ab") as file:
        # A session of its own: Ctrl-C is ours to pass on, once.
        process = subprocess.Popen(
            [*COMMAND, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONPATH": paths},
            start_new_session=True,
        )
    told = False
    while True:
        try:
            return process.wait(_LOOK)
        except subprocess.TimeoutExpired:
            if interrupts.signal and not told:
                process.send_signal(interrupts.signal)
                told = True


def _result(plan: Plan, words: str) -> str:
    """What became of a run, and a remark."""
    champion = Run(plan.folder).info.get("champion", {})
    return f"{champion.get('score', float('nan')):.3g}, {words}"


def _last_line(log: Path) -> str:
    """The last that a command said."""
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1].removeprefix("error: ") if lines else "it said nothing"


# --- what has come of them ------------------------------------------------------------------------

Figures = dict[str, float]


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
    found = []
    for plan in plans:
        run = Run(plan.folder)
        if not (plan.folder / "run.json").is_file() or "finished" not in run.info:
            continue
        try:
            found.append(_read_outcome(plan, run, add))
        except (OSError, KeyError, ValueError, TypeError, IndexError) as error:
            raise InputError(
                f"{shown(plan.folder)}: expected a whole run; found: {error}"
            ) from None
    if not found:
        raise InputError("--report: expected runs that are finished; found none")
    return found


def _read_outcome(plan: Plan, run: Run, add: Callable[[str, Figures], Figures]) -> Outcome:
    facts = run.info["champion"]
    body = load_morphology(plan.folder / "champion" / "morphology.yaml")
    champion = {"score": float(facts["score"]), **facts["measures"], **body.descriptors}
    champion |= add(plan.case, champion)
    people, problems = read_population(plan.folder)
    if problems:
        raise ValueError(problems[0])
    alive = [dict(life.figures) for life in people.alive(people.last) if life.score == life.score]
    lives = [life | add(plan.case, life) for life in alive]
    population = {
        name: float(np.mean([life[name] for life in lives])) for name in (lives or [{}])[0]
    }
    return Outcome(plan, champion, population, run.load_metrics(), body)


def score_still(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Scores the champions once more with all joints at rest.

    A body that starts in another attitude than that in which it hangs in the water turns, and its
    core moves; what it scores by that is not swimming.

    Args:
        outcomes: of the finished runs.

    Returns:
        The same with `still_score` among the champions' figures: the mean over a few fresh starts.
    """
    from mjx_revolve.numerics.runtime import prepare_process

    prepare_process()
    found = []
    for some in by_case(outcomes, dict.fromkeys(o.plan.case for o in outcomes)).values():
        scores = _still_scores(some)
        found += [
            o._replace(champion={**o.champion, "still_score": score})
            for o, score in zip(some, scores.tolist(), strict=True)
        ]
    return found


def _still_scores(outcomes: Sequence[Outcome]) -> np.ndarray:
    """`[n]` of one case, by the program that its runs had."""
    import jax

    from mjx_revolve.episodes.fitness import make_fitness
    from mjx_revolve.evolution.body_fitness import make_body_fitness
    from mjx_revolve.evolution.individuals import Individual
    from mjx_revolve.evolution.life import evaluate
    from mjx_revolve.evolution.pool import Pool

    config = outcomes[0].plan.config
    keys = jax.random.split(jax.random.key(_STILL_KEY), _STARTS)
    if config.bodies is None:
        fitness = make_fitness(config)
        still = np.zeros((config.evolution.population_size, fitness.num_genes), np.float32)
        score = np.mean([fitness.evaluate(still, key)[0][0] for key in keys])
        return np.full(len(outcomes), score)
    bodies = make_body_fitness(config)
    pool = Pool(bodies, bodies.block_size)
    who = [Individual(k, (), 0, "champion", None, o.body, None) for k, o in enumerate(outcomes)]
    genes = [np.zeros((1, bodies.num_genes), np.float32)] * len(who)
    return np.mean([[s[0] for s, _ in evaluate(pool, who, genes, key)] for key in keys], 0)


def by_case(outcomes: Sequence[Outcome], cases: Iterable[str]) -> dict[str, list[Outcome]]:
    """Outcomes by case, in the order of the cases; those without any are left out."""
    found = {name: [o for o in outcomes if o.plan.case == name] for name in cases}
    return {name: some for name, some in found.items() if some}


def describe_runs(cases: Mapping[str, Sequence[Outcome]], known: Mapping[str, Case]) -> list[str]:
    """Markdown: what was run, how often, for how long, and the champions' scores.

    Args:
        cases: outcomes by case.
        known: the cases by name.

    Returns:
        Lines of a table, and what is to be known of it.
    """
    lines = ["| | what | seeds | trials each | s each | champions' score | with joints at rest |"]
    lines.append(f"|{'---|' * 7}")
    for name, outcomes in cases.items():
        tried = sorted({f"{int(o.metrics['evaluations'][-1]):,}" for o in outcomes})
        seconds = np.mean([o.metrics["seconds"][-1] for o in outcomes])
        scores = (
            interval([o.champion.get(figure, np.nan) for o in outcomes])
            for figure in ("score", "still_score")
        )
        cells = (known[name].words, len(outcomes), " or ".join(tried), f"{seconds:.0f}", *scores)
        lines.append(f"| `{name}` | {' | '.join(map(str, cells))} |")
    return [*lines, "", fill(_STILL)]


_STILL = """Scores are in body lengths/s, of each run's champion on fresh starts. A body that does
not start in the attitude in which it hangs in the water turns, and its core moves without any work
of a joint: only what a champion scores beyond its score with all joints at rest is its doing."""


def fill(text: str) -> str:
    """A paragraph of Markdown in lines of the width of our pages."""
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Rows as CSV, whole or not at all; what a row lacks stays empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)))
    writer.writeheader()
    writer.writerows(rows)
    write_atomic(path, text.getvalue().encode())
