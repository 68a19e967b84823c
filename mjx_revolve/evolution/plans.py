"""Runs that are planned: what becomes of each when many of them are started, or started again.

The runs of a study lie in one folder: `CASE/seed_K/` is a run folder, `CASE/seed_K.log` what was
said meanwhile. Nothing else tells what is done, so whatever ended a study, it can go on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.evolution.runs import Run, is_new_folder, open_run
from mjx_revolve.evolution.start import check_unchanged
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import short_path


class Plan(NamedTuple):
    """One run of a study.

    Attributes:
        case: the name of its case.
        seed: its seed.
        folder: its run folder.
        base: the configuration that all runs start from: a file, or a shipped one's name.
        settings: what replaces values of that, `KEY.PATH=VALUE` each.
    """

    case: str
    seed: int
    folder: Path
    base: str | Path
    settings: tuple[str, ...]

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.case}/{self.folder.name}"

    @property
    def overrides(self) -> tuple[str, ...]:
        """All that replaces values of `base`."""
        return (*self.settings, f"evolution.seed={self.seed}")

    @property
    def config(self) -> Config:
        """The configuration, everything replaced.

        Raises:
            InputError: it is wrong.
        """
        return load_config(self.base, self.overrides)


Step = Literal["finished", "begin", "continue"]


def make_plans(
    folder: Path, base: str | Path, cases: Mapping[str, Sequence[str]], seeds: Iterable[int]
) -> list[Plan]:
    """The runs of a study.

    Args:
        folder: of the study.
        base: the configuration that all runs start from.
        cases: what replaces values of that, by case.
        seeds: of each case.

    Returns:
        The plans, all seeds of a case together, as these share what is compiled.
    """
    seeds = list(seeds)
    return [
        Plan(case, seed, folder / case / f"seed_{seed}", base, tuple(settings))
        for case, settings in cases.items()
        for seed in seeds
    ]


def next_step(plan: Plan) -> Step:
    """What is to be done with a run. Changes nothing.

    Args:
        plan: the run.

    Returns:
        "finished": nothing; "begin": all; "continue": what is left, from its last checkpoint.

    Raises:
        InputError: the folder holds something else, or a run that another process writes, of
            another configuration, or with more generations.
    """
    folder, wanted = plan.folder, plan.config
    label = short_path(folder)
    if not folder.is_dir() or not any(folder.iterdir()):
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{label}: expected a run folder; found a file")
        return "begin"
    if not (folder / "config.yaml").exists() and is_new_folder(folder):
        return "begin"  # killed while its folder was made
    run = open_run(folder)
    try:
        check_unchanged(run.load_config(), wanted, label)
        found, length = _generations(run), wanted.evolution.generations
        finished = "finished" in run.info
    finally:
        run.close()
    if found > length:
        raise InputError(
            f"{label}: expected a run of {length} generations at most; found {found} "
            "(choose another --out)"
        )
    if finished and found == length:
        return "finished"
    return "continue"


def _generations(run: Run) -> int:
    """How many a run has done."""
    metrics = run.load_metrics() if run.metrics_path.exists() else {}
    return int(metrics["generation"][-1]) if len(metrics.get("generation", ())) else 0
