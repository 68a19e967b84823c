"""Episodes for replays, reports and exports: of a champion, an individual, or a morphology.

They all show the same episode: the first of the fresh starts on which the champion was evaluated.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_revolve.body.morphology import trim_neutral
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.episodes.config import Config, TaskConfig
from mjx_revolve.episodes.early_checks import read_episode_file, refuse_world
from mjx_revolve.episodes.fitness import (
    Fitness,
    fit_body,
    make_fitness,
    make_mixed_fitness,
)
from mjx_revolve.episodes.individual_log import LoggedIndividual, find_individuals
from mjx_revolve.episodes.named_files import read_modules
from mjx_revolve.episodes.run_reader import ChampionRecord, RunReader, find_run, read_champion
from mjx_revolve.episodes.scoring import replay_key
from mjx_revolve.episodes.simulate import Trajectory, simulate
from mjx_revolve.episodes.starts import draw_gusts, gusty_water
from mjx_revolve.episodes.tasks import COLONY_FITNESS, body_length, score_unit
from mjx_revolve.inputs.commands import opening_episode
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import check_path
from mjx_revolve.inputs.short_repr import short_repr
from mjx_revolve.water.flow import Water

# Duration of the episode of a morphology without a task [s].
_SECONDS = 10.0


@dataclass(frozen=True, eq=False, repr=False)
class Episode:
    """An episode of one robot.

    Attributes:
        title: of pictures.
        robot: the compiled robot; its world is `robot.world`.
        trajectory: of the robot.
        score: mean score, or None.
        score_unit: of the score, e.g. "body lengths/s"; "" without one.
        water: surface and current at each row; None: the world's.
        genes: `[G]` or None without a controller.
        fitness: of the run, or None.
        folder: the run folder, or None.
        starts: those over which the score is the mean, in words.
        task: of the run, or None.
    """

    title: str
    robot: Robot
    trajectory: Trajectory
    score: float | None = None
    score_unit: str = ""
    water: Water | None = None
    genes: np.ndarray | None = None
    fitness: Fitness | None = None
    folder: Path | None = None
    starts: str = "fresh starts"
    task: TaskConfig | None = None

    __repr__ = short_repr

    @property
    def length(self) -> float:
        """Body length, as the run's task has it [m]."""
        return body_length(self.robot, self.task)


def load_episode(
    path: str | Path,
    world: str | None = None,
    duration: float | None = None,
    seed: int | None = None,
    individual: int | None = None,
    modules: str | Path | None = None,
) -> Episode:
    """The episode of a champion, an individual or a morphology.

    Args:
        path: a run folder, its `champion` folder, a `genes.yaml`, or a morphology. A morphology is
            trimmed neutral if possible, starts 1 m below the surface, and holds its hinges at 0.
        world: of a morphology, by default the lake; None for a champion: its run names its own.
        duration: [s]; by default the task's, or 10.
        seed: draws another start than the first on which the champion was evaluated.
        individual: number of an individual, in place of the champion, if bodies have evolved.
        modules: of a morphology: a YAML of module types of the user's own (see
            `catalogue.load_modules`); None for a champion: its run names its own.

    Returns:
        The episode.

    Raises:
        InputError: there is no champion or individual, a file has another content, or a world or
            modules are given for a run.
    """
    path = check_path(path)
    if individual is not None:
        refuse_world(world, modules)
        return _individual(path, individual, duration, seed)
    named = read_episode_file(path, world, modules)
    if named is None:
        known = "a run folder, a champion's genes.yaml or a morphology"
        raise InputError(path, known, "a file with neither genes nor body")
    if isinstance(named, ChampionRecord):
        return _champion(named, duration, seed)
    morphology, water = named
    with suppress(InputError):  # a robot that floats stays as it is
        morphology = trim_neutral(morphology, water.density)
    robot = build_robot(morphology, water)
    key = None if seed is None else jax.random.key(seed)
    seconds, gusty = _SECONDS if duration is None else duration, None
    if water.gust is not None:
        steps = max(1, round(seconds / water.timestep))
        gusts = draw_gusts(water, jax.random.key(seed or 0), steps, 1)
        gusty = gusty_water(water, gusts[..., 0])
    trajectory = simulate(robot, None, seconds, key=key, water=gusty, once=True)
    return Episode(morphology.name, robot, trajectory, water=gusty)


def load_asked(arguments: argparse.Namespace) -> Episode:
    """The episode that a command's arguments name; files that are not trusted are refused.

    Args:
        arguments: with what `commands.add_episode_arguments` adds.

    Returns:
        The episode.

    Raises:
        InputError: as `load_episode`, or a file is not trusted (see `trust.opening`).
    """
    a = arguments
    with opening_episode(a):
        return load_episode(a.path, a.world, a.duration, a.seed, a.individual, a.modules)


def _load_config(load: Callable[..., Config], duration: float | None) -> Config:
    """A configuration, for so long."""
    config = load()
    if duration is None:
        return config
    if not duration > (settle := config.task.settle):
        raise InputError("--duration", f"more than task.settle ({settle:g} s)", f"{duration:g}")
    # What swims longer than its horizon needs none.
    return load(**{"task.duration": float(duration), "task.horizon": None})


def _champion(champion: ChampionRecord, duration: float | None, seed: int | None) -> Episode:
    config = _load_config(champion.load_config, duration)
    fitness = make_fitness(config)
    champion.check_genes(fitness.num_genes, Path(config.source).name)
    key = _key(config, seed)
    return _episode(
        config, fitness.robot.morphology.title, fitness.robot, fitness.replay(champion.genes, key),
        water=fitness.water(key), score=champion.score, genes=champion.genes, fitness=fitness,
        **({} if champion.is_final else _selected(champion.load_run_config())),
    )  # fmt: skip


def _selected(config: Config, born: int | None = None) -> dict[str, str]:
    """The unit of a score by which an individual was selected, and over what it is the mean."""
    if config.colony is not None:
        return {"score_unit": COLONY_FITNESS, "starts": "its life"}
    if config.bodies is not None and config.bodies.selection.reevaluate:
        return {"starts": "all of its evaluations"}
    own = "its own generation" if born is None else f"generation {born}"
    return {"starts": f"{own}'s starts"}


def _episode(
    config: Config, name: str, robot: Robot, trajectory: Trajectory, **more: Any
) -> Episode:
    """An episode of a run."""
    unit = score_unit(config.task.type, config.task.unit)
    facts: dict[str, Any] = {"score_unit": unit, "task": config.task} | more
    return Episode(
        f"{name}: {config.task.name.replace('_', ' ')}", robot, trajectory,
        folder=Path(config.source).parent.absolute(), **facts,
    )  # fmt: skip


def champion_number(folder: Path) -> int:
    """The champion's number among the individuals of a run.

    Raises:
        InputError: there is no champion, or bodies did not evolve.
    """
    return RunReader(folder).load_champion().individual


def _key(config: Config, seed: int | None) -> jax.Array:
    """The key of the start: by default the first one on which the champion was evaluated."""
    return replay_key(config.evolution.seed) if seed is None else jax.random.key(seed)


# --- individuals ----------------------------------------------------------------------------------


def read_individuals(
    path: str | Path, numbers: Sequence[int], duration: float | None = None
) -> tuple[Config, list[LoggedIndividual]]:
    """Reads some individuals of a run.

    Args:
        path: the run folder, or its `champion` folder.
        numbers: of the individuals.
        duration: of their episodes [s]; by default the task's.

    Returns:
        The run's configuration and the individuals.

    Raises:
        InputError: the run evolves no bodies, or has no such individual.
    """
    folder = find_run(path)
    config = _load_config(RunReader(folder).load_config, duration)
    if config.bodies is None:
        many = "a run in which bodies evolve, to show one of many"
        raise InputError(folder, many, "one in which only genes do")
    return config, find_individuals(folder, numbers)


def _individual(path: Path, number: int, duration: float | None, seed: int | None) -> Episode:
    config, (life,) = read_individuals(path, [number], duration)
    fitness = fit_body(config, life.grow(read_modules(config)))
    key, genes = _key(config, seed), _own_genes(life, fitness.num_genes)
    facts = _facts(config, life) | {"genes": genes, "water": fitness.water(key), "fitness": fitness}
    return _episode(config, robot=fitness.robot, trajectory=fitness.replay(genes, key), **facts)


def load_individuals(
    path: str | Path, numbers: Sequence[int], duration: float | None = None, seed: int | None = None
) -> list[Episode]:
    """The episodes of many individuals at once, by one compiled program.

    Args:
        path: the run folder.
        numbers: of the individuals.
        duration: [s]; by default the task's.
        seed: as for `load_episode`.

    Returns:
        Their episodes, equal to those of `load_episode` up to rounding, with fewer rows.

    Raises:
        InputError: as `load_episode`.
    """
    config, lives = read_individuals(path, numbers, duration)
    modules, key = read_modules(config), _key(config, seed)
    bodies = [life.grow(modules) for life in lives]
    fitness = make_mixed_fitness(config, bodies)
    robots = [fitness.build(body) for body in bodies]
    genes = [
        _own_genes(life, fitness.controller_of(robot).num_genes)
        for life, robot in zip(lives, robots, strict=True)
    ]
    water = fitness.water(key)
    found = zip(lives, robots, fitness.replay(robots, genes, key), genes, strict=True)
    return [
        _episode(
            config, robot=robot, trajectory=swim, genes=own, water=water, **_facts(config, life)
        )
        for life, robot, swim, own in found
    ]


def _own_genes(life: LoggedIndividual, count: int) -> np.ndarray:
    """`[count]` the learnt genes of an individual."""
    genes = life.genes
    if genes is None or len(genes) != count:
        found = "none: every trial of its life failed" if genes is None else str(len(genes))
        raise InputError(f"individual {life.number}: genes", count, found)
    return genes


def _facts(config: Config, life: LoggedIndividual) -> dict[str, Any]:
    """The title, score and starts of an individual's episode."""
    return {
        "name": f"individual {life.number}, {config.unit} {life.born}",
        "score": None if math.isnan(life.score) else life.score,
        **_selected(config, life.born),
    }


def load_genes(path: str | Path) -> np.ndarray:
    """Reads a champion's genes.

    Args:
        path: a run folder, its `champion` folder, or a `genes.yaml`.

    Returns:
        `[G]` float32, the same bits as evolved.

    Raises:
        InputError: there is no champion, or its file holds something else.
    """
    path = check_path(path)
    return (RunReader(path).load_champion() if path.is_dir() else read_champion(path)).genes
