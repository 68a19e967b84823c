"""Many runs, one after the other in one process, so that they share what is compiled.

A start takes as long as many generations even where all is compiled already: imports, tracing,
reading the cache, in every worker. Runs that differ in their seed, or in how genes are searched
for, have the same fitness; it is made once, and so are its workers. Scores do not depend on it: a
pool knows nothing of the runs that it served before.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import yaml
from annotated_types import Ge, Le, MinLen

from mjx_revolve.episodes.config import Config
from mjx_revolve.evolution import session
from mjx_revolve.evolution.fingerprints import FREE_SETTINGS, fitness_hash
from mjx_revolve.evolution.interrupts import Interrupts
from mjx_revolve.evolution.jobs import WorkerError
from mjx_revolve.evolution.loop import Champion
from mjx_revolve.evolution.plans import Plan, Step, make_plans, next_step
from mjx_revolve.evolution.pool import Pool, make_pool
from mjx_revolve.evolution.runs import Run
from mjx_revolve.evolution.start import Start, begin_run, check_search, continue_run
from mjx_revolve.evolution.tensorboard import check_tensorboard
from mjx_revolve.inputs.commands import check_place, describe_refusal
from mjx_revolve.inputs.errors import InputError, load_yaml, reading
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.inputs.grids import MOST_SEEDS, combine, read_axes
from mjx_revolve.inputs.schema import Row, Text, Whole, checked, read
from mjx_revolve.inputs.trust import is_run_config, opening, remembering

FILE = "sweep.yaml"
"""What a sweep's folder has beside the runs: what they are."""

MakePool = Callable[[Config], Pool]


@checked
class Sweep:
    """A grid of runs.

    Attributes:
        config: the configuration that all start from: a file's path.
        seeds: of each case, from 0 on.
        settings: what replaces its values, `KEY.PATH=VALUE,VALUE,...` each.
    """

    config: Annotated[Text, MinLen(1)]
    seeds: Annotated[Whole, Ge(1), Le(MOST_SEEDS)]
    settings: Row[Text] = ()

    @property
    def cases(self) -> dict[str, tuple[str, ...]]:
        """Settings of each case by its name, which is that of its folder.

        Raises:
            InputError: the settings are no grid, or replace the seed.
        """
        axes = read_axes(self.settings)
        for axis in axes:
            if axis.key == "evolution.seed":
                raise InputError("--set evolution.seed: expected --seeds N instead; found it set")
        return combine(axes, Path(self.config).stem)

    def plans(self, folder: Path) -> list[Plan]:
        """Its runs in a folder, all seeds of a case together."""
        return make_plans(folder, self.config, self.cases, range(self.seeds))


def read_sweep(folder: str | Path) -> Sweep:
    """Reads what the runs of a folder are.

    Args:
        folder: of a sweep.

    Returns:
        The sweep.

    Raises:
        InputError: its file is missing, or holds something else.
    """
    path = Path(folder) / FILE
    data = load_yaml(path)
    with reading(path):
        sweep = read(Sweep, data)
        _ = sweep.cases
    return sweep


def check_folder(folder: Path) -> None:
    """Refuses a folder in which no sweep can be; whether its runs fit is for `next_step` to say.

    Args:
        folder: new, empty, or that of a sweep: of the one that is meant, or of one that it extends.

    Raises:
        InputError: it holds something else, or cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: expected a folder; found a file")
    if not (folder / FILE).is_file() and folder.is_dir() and any(folder.iterdir()):
        raise InputError(
            f"--out {folder}: expected a new or empty folder, or that of a sweep; found files"
        )
    check_place(folder / FILE, f"--out {folder}")


def write_sweep(folder: Path, sweep: Sweep) -> None:
    """Writes `sweep.yaml`.

    Args:
        folder: see `check_folder`.
        sweep: the sweep.

    Raises:
        OSError: it cannot be written.
    """
    data = {"config": sweep.config, "seeds": sweep.seeds, "settings": list(sweep.settings)}
    text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
    write_atomic(folder / FILE, f"# What the runs of this folder are.\n{text}".encode())


class SharedPool:
    """Makes the pool of a run, or hands out that of the run before, where it would be the same."""

    def __init__(self, make: MakePool) -> None:
        """Has none yet.

        Args:
            make: makes one.
        """
        self._make = make
        self._pool: Pool | None = None
        self._key = ""

    def __call__(self, config: Config) -> Pool:
        """The pool for a configuration; that of another one is closed."""
        key = fitness_hash(config)
        if self._pool is None or self._pool.closed or key != self._key:
            self.close()
            self._pool, self._key = self._make(config), key
        return self._pool

    def close(self) -> None:
        """Ends its workers."""
        if self._pool is not None:
            self._pool.close()
        self._pool = None


def choose_steps(
    plans: Sequence[Plan], make_fitness: Callable[[Config], Any] | None = None
) -> dict[Plan, Step]:
    """What is to be done with each run; all that can be wrong with any of them is said here.

    Args:
        plans: the runs.
        make_fitness: see `pool.make_pool`.

    Returns:
        The steps. Nothing has been changed.

    Raises:
        InputError: a configuration is wrong, alone or for its robot, world and strategy, or a run
            folder holds something else; see `plans.next_step`.
    """
    several = len({plan.case for plan in plans}) > 1
    steps: dict[Plan, Step] = {}
    seen = set()
    with contextlib.closing(SharedPool(lambda c: make_pool(c, 1, make_fitness))) as pools:
        for plan in plans:
            try:
                steps[plan] = next_step(plan)
                if plan.case in seen or steps[plan] == "finished":
                    continue
                seen.add(plan.case)
                config = plan.config
                if config.evolution.tensorboard:
                    check_tensorboard(config.source)
                with _asking(plan):
                    check_search(config, pools(config))
            except InputError as error:
                raise InputError(f"{plan.case}: {error}" if several else str(error)) from None
    return steps


def run_plans(
    steps: dict[Plan, Step],
    make_pool: MakePool,
    draw: Callable[[Start, Champion], None],
    again: str,
) -> int:
    """Runs what is not finished, with a line on standard output for each.

    Ctrl-C and SIGTERM end the run under way after its generation, and all with it.

    Args:
        steps: the runs, from `choose_steps`.
        make_pool: makes the pool of a run.
        draw: writes the pictures of a run, when its champion is judged.
        again: the command that goes on.

    Returns:
        The exit code: 0 when all are finished, 130 or 143 when interrupted, 1 when the disk refused
        a file or no worker was left.

    Raises:
        InputError: a run cannot begin or go on.
    """
    began, ran = time.perf_counter(), 0
    left = sum(step != "finished" for step in steps.values())
    width = len(str(len(steps)))
    with (
        Interrupts() as interrupts,
        contextlib.closing(SharedPool(make_pool)) as pools,
    ):
        interrupts.be_patient("stopping after the generation under way")
        for k, (plan, step) in enumerate(steps.items()):
            if interrupts.signal:
                break
            print(f"[{k + 1:{width}}/{len(steps)}] {plan.name}: ", end="")
            if step == "finished":
                print(_result(plan, "finished before"))
                continue
            print("running ... ", end="", flush=True)
            started = time.perf_counter()
            try:
                champion = _run(plan, step, pools, draw, interrupts)
            except (WorkerError, OSError) as error:
                words = describe_refusal(error) if isinstance(error, OSError) else str(error)
                print(f"failed\ngo on: {again}", flush=True)
                print(f"error: {plan.name}: {words}", file=sys.stderr)
                return 1
            except BaseException:
                print("failed", flush=True)
                raise
            if champion is None:
                print("stopped", flush=True)
                break
            ran += 1
            left -= 1
            rest = left * (time.perf_counter() - began) / ran
            more = f", some {max(1, round(rest / 60))} min left" if left else ""
            print(_result(plan, f"{time.perf_counter() - started:.0f} s{more}"), flush=True)
    if interrupts.signal and left:
        print(f"go on: {again}", flush=True)
        return interrupts.exit_code
    return 0


def _run(
    plan: Plan,
    step: Step,
    pools: SharedPool,
    draw: Callable[[Start, Champion], None],
    interrupts: Interrupts,
) -> Champion | None:
    """Begins a run or goes on with it; None where it was interrupted before its end."""
    folder, log = plan.folder, plan.folder.with_name(f"{plan.folder.name}.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as opened:
        out = opened.enter_context(log.open("a", encoding="utf-8"))
        if step == "continue":
            with opening(folder, trust=False):
                start = continue_run(str(folder), None, _changes(plan), pools)
            print(f"resuming {plan.name} {start.resumption}", file=out, flush=True)
        else:
            with _asking(plan):
                place = str(folder)
                start = begin_run(str(plan.base), plan.overrides, place, pools, interrupts.writing)
            print(f"beginning {plan.name}", file=out, flush=True)
        opened.callback(start.run.close)
        _, champion = session.run_to_end(
            start, interrupts, lambda champion: draw(start, champion), out
        )
        words = "stopped" if champion is None else f"champion: {champion.score:.3g}"
        print(words, file=out)
        return champion


def _asking(plan: Plan) -> contextlib.AbstractContextManager[None]:
    """Who names a configuration wants what it names; that of a run folder may be a stranger's."""
    base = Path(plan.base)
    return opening(base, trust=False) if is_run_config(base) else remembering()


def _changes(plan: Plan) -> list[str]:
    """Settings that may change when a run goes on, and have changed."""
    old, new = Run(plan.folder).load_config().evolution, plan.config.evolution
    return [
        f"evolution.{name}={json.dumps(getattr(new, name))}"
        for name in FREE_SETTINGS
        if getattr(new, name) != getattr(old, name)
    ]


def _result(plan: Plan, words: str) -> str:
    """What became of a run, and a remark."""
    champion = Run(plan.folder).info.get("champion", {})
    return f"{champion.get('score', float('nan')):.3g}, {words}"
