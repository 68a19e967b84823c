"""Sweeps: many runs, one after the other in one process, so that they share compiled programs.

A start takes as long as many generations even if all is compiled already: imports, tracing, reading
the cache, in every worker. Runs that differ in their seed or their strategy have the same fitness,
which is made once, with its workers. Scores do not depend on it: an executor keeps no state of
earlier runs.

The runs are in one folder: `CASE/seed_K/` is a run folder, `CASE/seed_K.log` its log. There is no
other record of progress, so a sweep can be continued after any end.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from annotated_types import Ge, Le, MinLen

from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.episodes.run_reader import read_metrics
from mjx_revolve.evolution.executor import Executor, make_executor
from mjx_revolve.evolution.fingerprints import FREE_SETTINGS, fitness_hash
from mjx_revolve.evolution.generations import Champion
from mjx_revolve.evolution.interrupts import Interrupts
from mjx_revolve.evolution.jobs import MakeFitness, WorkerError
from mjx_revolve.evolution.progress import is_live
from mjx_revolve.evolution.run import MakeExecutor, Run, check_genes, check_search, check_unchanged
from mjx_revolve.evolution.run_folder import TEMPORARY, RunFolder, is_new_folder, open_run_folder
from mjx_revolve.evolution.tensorboard import check_tensorboard
from mjx_revolve.inputs.commands import check_output_folder, describe_refusal, say
from mjx_revolve.inputs.errors import InputError, note, reading
from mjx_revolve.inputs.files import SWEEP, short_path, write_atomic
from mjx_revolve.inputs.grids import MOST_SEEDS, combine, read_axes
from mjx_revolve.inputs.overrides import read_overrides, sets
from mjx_revolve.inputs.schema import Integer, Text, TupleOf, checked, read
from mjx_revolve.inputs.trust import opening, opening_config
from mjx_revolve.inputs.yaml_reader import dump_yaml, load_yaml


class Plan(NamedTuple):
    """One run of a study.

    Attributes:
        case: the name of its case.
        seed: its seed.
        folder: its run folder.
        base: the configuration that all runs start from: a file, or a shipped one's name.
        settings: replace values of `base`, `KEY.PATH=VALUE` each.
    """

    case: str
    seed: int
    folder: Path
    base: str | Path
    settings: tuple[str, ...]

    @property
    def name(self) -> str:
        """Its name in messages."""
        return f"{self.case}/{self.folder.name}"

    @property
    def overrides(self) -> tuple[str, ...]:
        """Everything that replaces values of `base`."""
        return (*self.settings, f"evolution.seed={self.seed}")

    @property
    def config(self) -> Config:
        """The configuration, everything replaced; raises `InputError`."""
        return load_config(self.base, self.overrides)


Step = Literal["finished", "begin", "continue"]


def make_plans(
    folder: Path, base: str | Path, cases: Mapping[str, Sequence[str]], seeds: Iterable[int]
) -> list[Plan]:
    """The runs of a study.

    Args:
        folder: of the study.
        base: the configuration that all runs start from.
        cases: settings that replace its values, by case.
        seeds: of each case.

    Returns:
        The plans, all seeds of a case together, as these share compiled programs.
    """
    seeds = list(seeds)
    return [
        Plan(case, seed, folder / case / f"seed_{seed}", base, tuple(settings))
        for case, settings in cases.items()
        for seed in seeds
    ]


def next_step(plan: Plan) -> Step:
    """The next step of a run: nothing, all, or the rest from its last checkpoint.

    Raises:
        InputError: the folder holds something else, or a run that another process writes, of
            another configuration, or with more generations.
    """
    folder, wanted = plan.folder, plan.config
    label = short_path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(label, "a run folder", "a file")
    # A new one may be of a process that was killed while it made the folder.
    if not folder.exists() or (not (folder / "config.yaml").exists() and is_new_folder(folder)):
        return "begin"
    with contextlib.closing(open_run_folder(folder)) as run:
        old = run.load_config()
        check_unchanged(old, wanted, label)
        found, length = _generations(run), wanted.evolution.generations
        # Another kind of passport may choose another champion.
        judged = old.evolution.passport == wanted.evolution.passport
        finished = judged and "finished" in run.info
    if found > length:
        most = f"a run of {length} generations at most"
        raise InputError(label, most, f"{found} (choose another --out)")
    if finished and found == length:
        return "finished"
    return "continue"


def _generations(run: RunFolder) -> int:
    """How many generations a run has done, by the lines that are whole; a run drops others."""
    if not run.metrics_path.exists():
        return 0
    table = read_metrics(run.metrics_path)
    if table.damage:
        raise InputError(f"{short_path(run.metrics_path)}: {table.damage}")
    done = table.columns.get("generation")
    return 0 if done is None or not len(done) else int(done[-1])


# --- sweeps ---------------------------------------------------------------------------------------


@checked
class Sweep:
    """A grid of runs.

    Attributes:
        config: the configuration that all start from: a file's path.
        seeds: how many of each case.
        settings: what replaces its values, `KEY.PATH=VALUE,VALUE,...` each.
        first_seed: the first of the seeds, which follow one another.
    """

    config: Annotated[Text, MinLen(1)]
    seeds: Annotated[Integer, Ge(1), Le(MOST_SEEDS)]
    settings: TupleOf[Text] = ()
    first_seed: Annotated[Integer, Ge(0), Le(2**32 - 1 - MOST_SEEDS)] = 0

    @property
    def cases(self) -> dict[str, tuple[str, ...]]:
        """Settings of each case by its name, which is that of its folder.

        Raises:
            InputError: the settings are no grid, or replace the seed.
        """
        axes = read_axes(self.settings)
        for axis in axes:
            given = (read_overrides([f"{axis.key}={text}"])[0] for text in axis.texts)
            if any(sets(one, "evolution.seed") for one in given):
                raise InputError("--set evolution.seed", "--seeds N instead", "it set")
        return combine(axes, Path(self.config).stem)

    def plans(self, folder: str | Path) -> list[Plan]:
        """Its runs in a folder, all seeds of a case together."""
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        return make_plans(Path(folder), self.config, self.cases, seeds)


def read_sweep(folder: str | Path) -> Sweep:
    """Reads the `sweep.yaml` of a folder.

    Raises:
        InputError: it is missing, or holds something else.
    """
    path = Path(folder) / SWEEP
    data = load_yaml(path)
    with reading(path):
        sweep = read(Sweep, data)
        _ = sweep.cases
    return sweep


def check_folder(folder: Path, sweep: Sweep) -> None:
    """Raises `InputError` for a folder that is not new, empty or a sweep's; see `next_step`.

    A note names cases of the folder that the sweep has no more: they will be in no report.
    """
    check_output_folder(folder)
    if (folder / SWEEP).is_file():
        others = [x for x in read_sweep(folder).cases if x not in sweep.cases]
        if left := [name for name in others if (folder / name).is_dir()]:
            note(f"{folder}: runs of {', '.join(left)} stay, but are no part of this sweep")
    held = [x for x in folder.iterdir() if not TEMPORARY.match(x.name)] if folder.is_dir() else []
    if held and not (folder / SWEEP).is_file():
        raise InputError(f"--out {folder}", "a new or empty folder, or that of a sweep", "files")


def write_sweep(folder: Path, sweep: Sweep) -> None:
    """Writes `sweep.yaml`."""
    data = {"config": sweep.config, "seeds": sweep.seeds, "settings": list(sweep.settings)}
    data |= {"first_seed": sweep.first_seed} if sweep.first_seed else {}
    text = dump_yaml(data)
    write_atomic(folder / SWEEP, f"# What the runs of this folder are.\n{text}".encode())


class SharedExecutor:
    """Makes a run's executor, or returns that of the run before, where it would be the same."""

    def __init__(self, make: MakeExecutor) -> None:
        """Has no executor yet; `make` makes one."""
        self._make = make
        self._executor: Executor | None = None
        self._key = ""

    def __call__(self, config: Config) -> Executor:
        """The executor of a configuration; that of another one is closed."""
        key = fitness_hash(config)
        if self._executor is None or self._executor.closed or key != self._key:
            self.close()
            self._executor, self._key = self._make(config), key
        return self._executor

    def close(self) -> None:
        """Ends its workers."""
        if self._executor is not None:
            self._executor.close()
        self._executor = None


def choose_steps(
    plans: Sequence[Plan], make_fitness: MakeFitness | None = None, trust: bool = False
) -> dict[Plan, Step]:
    """The next step of each run, after all checks of its configuration.

    Args:
        plans: the runs.
        make_fitness: see `executor.make_executor`.
        trust: whether Python files of another's run folder may run.

    Raises:
        InputError: a configuration is wrong, alone or for its robot, world and strategy, or a run
            folder holds something else; see `next_step`.
    """
    several = len({plan.case for plan in plans}) > 1
    steps: dict[Plan, Step] = {}
    seen = set()
    with contextlib.closing(
        SharedExecutor(lambda c: make_executor(c, 1, make_fitness))
    ) as executors:
        for plan in plans:
            try:
                steps[plan] = next_step(plan)
                if plan.case in seen or steps[plan] == "finished":
                    continue
                seen.add(plan.case)
                config = plan.config
                check_tensorboard(config, config.source)
                with opening_config(plan.base, trust):
                    executor = executors(config)
                    check_genes(config, executor)
                    check_search(config, executor)
            except InputError as error:
                raise InputError(f"{plan.case}: {error}" if several else str(error)) from None
    return steps


def run_plans(
    steps: dict[Plan, Step],
    make_executor: MakeExecutor,
    draw: Callable[[Run, Champion], None],
    again: str,
    trust: bool = False,
) -> int:
    """Runs what is not finished, with a line on standard output for each.

    Ctrl-C and SIGTERM end the run under way after its generation, and all with it.

    Args:
        steps: the runs, from `choose_steps`.
        make_executor: makes the executor of a run.
        draw: writes the pictures of a run, when its champion is evaluated.
        again: the command that goes on.
        trust: as in `choose_steps`.

    Returns:
        The exit code: 0 when all are finished, 130 or 143 when interrupted, 1 when the disk refused
        a file or no worker was left, 2 when a run could not begin, go on or be judged.
    """
    began, ran, code = time.perf_counter(), 0, 0
    # A sweep may take days, and reads them anew for each run.
    known: dict[str, tuple[object, str]] = {}
    for plan, step in steps.items():
        if step == "begin" and plan.case not in known:
            known[plan.case] = _made_of(plan)
    left = sum(step != "finished" for step in steps.values())
    width = len(str(len(steps)))
    with Interrupts() as interrupts, contextlib.closing(SharedExecutor(make_executor)) as executors:
        interrupts.finish_first("stopping after the generation under way")
        for k, (plan, step) in enumerate(steps.items()):
            if interrupts.signal:
                break
            number = f"[{k + 1:{width}}/{len(steps)}]"
            begin = f"{number} {plan.name}: "
            if step == "finished":
                say(begin + _result(plan, "finished before"))
                continue
            # A terminal's line is drawn over by the run's progress.
            over = f"\r\x1b[K{begin}" if is_live(sys.stdout) else ""
            say(f"{begin}running ... ", end="")
            started = time.perf_counter()
            try:
                if step == "begin" and _made_of(plan) != known[plan.case]:
                    expected = "configuration and files as they were when the sweep started"
                    raise InputError(short_path(plan.base), expected, "them changed")
                champion = _run(plan, step, executors, draw, interrupts, number, trust)
            except (WorkerError, OSError) as error:
                words = describe_refusal(error) if isinstance(error, OSError) else str(error)
                say(f"{over}failed\ngo on: {again}")
                print(f"error: {plan.name}: {words}", file=sys.stderr)
                return 1
            except InputError as error:  # nothing of this run can be judged; the others go on
                say(f"{over}failed")
                if str(error).startswith(("--cluster", "--workers")):  # it is the same for all
                    if ran:
                        say(f"go on: {again}")
                    raise
                print(f"error: {plan.name}: {error}", file=sys.stderr)
                code, left = 2, left - 1
                continue
            except BaseException:
                say(f"{over}failed")
                raise
            if champion is None:
                say(f"{over}stopped")
                break
            ran += 1
            left -= 1
            rest = left * (time.perf_counter() - began) / ran
            more = f", some {max(1, round(rest / 60))} min left" if left else ""
            say(over + _result(plan, f"{time.perf_counter() - started:.0f} s{more}"))
    if interrupts.signal and left:
        say(f"go on: {again}")
        return interrupts.exit_code
    return code


def _run(
    plan: Plan,
    step: Step,
    executors: SharedExecutor,
    draw: Callable[[Run, Champion], None],
    interrupts: Interrupts,
    label: str,
    trust: bool,
) -> Champion | None:
    """Begins a run or goes on with it; None where it was interrupted before its end."""
    folder, log = plan.folder, plan.folder.with_name(f"{plan.folder.name}.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as opened:
        out = opened.enter_context(log.open("a", encoding="utf-8"))
        if step == "continue":
            with opening(folder, trust=trust):
                run = Run.resume(str(folder), None, _changes(plan), executors)
            print(f"resuming {plan.name} {run.resumption}", file=out, flush=True)
        else:
            with opening_config(plan.base, trust):
                base, place = str(plan.base), str(folder)
                run = Run.begin(base, plan.overrides, place, executors, interrupts.writing)
            print(f"beginning {plan.name}", file=out, flush=True)
        opened.callback(run.close)
        champion = run.evolve(interrupts, draw, out, label)
        words = "stopped" if champion is None else f"champion: {champion.score:.3g}"
        print(words, file=out)
        return champion


def _made_of(plan: Plan) -> tuple[object, str]:
    """What a run is made of but for its seed, files by what they hold."""
    config = plan._replace(seed=0).config
    return config.evolution, fitness_hash(config)


def _changes(plan: Plan) -> list[str]:
    """Settings that have changed, of those that may when a run goes on."""
    old, new = RunFolder(plan.folder).load_config().evolution, plan.config.evolution
    return [
        f"evolution.{name}={json.dumps(getattr(new, name))}"
        for name in FREE_SETTINGS
        if getattr(new, name) != getattr(old, name)
    ]


def _result(plan: Plan, words: str) -> str:
    """The score of a finished run, and a remark."""
    champion = RunFolder(plan.folder).info.get("champion", {})
    return f"{champion.get('score', float('nan')):.3g}, {words}"
