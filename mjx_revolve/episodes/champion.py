"""An episode to look at: a run's champion, or a morphology that is dropped into the water.

Replays, reports and exports all start here, so that each shows the same swim: the first of the
fresh starts on which the champion was judged.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from mjx_revolve.body.morphology import load_morphology, trim_neutral
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.episodes.fitness import Fitness, make_fitness
from mjx_revolve.episodes.scoring import replay_key
from mjx_revolve.episodes.simulate import Trajectory, simulate
from mjx_revolve.episodes.starts import gusty_water
from mjx_revolve.episodes.tasks import score_unit
from mjx_revolve.inputs.errors import InputError, load_yaml, show
from mjx_revolve.inputs.shipped import find_shipped
from mjx_revolve.water.flow import Water, gust_path
from mjx_revolve.water.world import load_world

# How long a morphology without a task is shown [s].
_SECONDS = 10.0


@dataclass(frozen=True, eq=False)
class Episode:
    """One life of one robot, with all that is known about it.

    Attributes:
        title: a few words to head a picture.
        robot: the compiled robot; its world is `robot.world`.
        trajectory: what it did.
        score: the champion's mean score over fresh starts, or None.
        score_unit: of the score, e.g. "body lengths/s"; "" without one.
        water: surface and current along the way, where they are not just the world's.
        genes: `[G]` or None without a controller.
        fitness: what the genes were evolved for, or None.
        folder: the run folder, or None.
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


def load_episode(
    path: str | Path,
    world: str | None = None,
    duration: float | None = None,
    seed: int | None = None,
) -> Episode:
    """Reads a champion, or a morphology, and lets it live.

    Args:
        path: a run folder, its `champion` folder, a `genes.yaml`, or a morphology. A morphology is
            trimmed neutral where it can be, starts 1 m below the surface, and holds its hinges at
            0.
        world: of a morphology, by default the lake; None for a champion, which swims in the world
            that it evolved in.
        duration: [s]; by default the task's, or 10.
        seed: draws another start than the first on which the champion was judged.

    Returns:
        The episode.

    Raises:
        InputError: there is no champion, a file holds something else, or a champion is to swim
            in another world.
    """
    path = Path(path)
    if path.is_dir():
        return _champion(_genes_file(path), world, duration, seed)
    path = find_shipped(path, "morphologies")
    data = load_yaml(path)
    if isinstance(data, dict) and "genes" in data:
        return _champion(path, world, duration, seed)
    if not (isinstance(data, dict) and "body" in data):
        raise InputError(
            f"{path}: expected a run folder, a champion's genes.yaml or a morphology; found a file "
            "with neither genes nor body"
        )
    water = load_world("lake" if world is None else world)
    morphology = load_morphology(path)
    with suppress(InputError):  # what floats, floats
        morphology = trim_neutral(morphology, water.density)
    robot = build_robot(morphology, water)
    key = None if seed is None else jax.random.key(seed)
    seconds, gusty = duration or _SECONDS, None
    if water.gust is not None:
        gust_key = jax.random.fold_in(jax.random.key(seed or 0), 1)
        steps = max(1, round(seconds / water.timestep))
        gusts = gust_path(water.gust, gust_key, steps, water.timestep, 1)
        gusty = gusty_water(water, gusts[..., 0])
    trajectory = simulate(robot, None, seconds, key=key, water=gusty)
    return Episode(morphology.name, robot, trajectory, water=gusty)


def _genes_file(folder: Path) -> Path:
    """Where a run folder, or its champion folder, keeps the champion."""
    for place in (folder / "genes.yaml", folder / "champion" / "genes.yaml"):
        if place.is_file():
            return place
    if (folder / "config.yaml").is_file():
        raise InputError(
            f"{folder / 'champion' / 'genes.yaml'}: expected a champion; found none: this run was "
            "stopped before its first checkpoint, or the file is lost"
        )
    raise InputError(f"{folder}: expected a run folder; found no config.yaml in it")


def _champion(path: Path, world: str | None, duration: float | None, seed: int | None) -> Episode:
    if world is not None:
        raise InputError(
            f"world: expected none: a champion swims in the world it evolved in; found {world!r}"
        )
    genes = load_genes(path)
    data = load_yaml(path)
    named = data.get("config", "../config.yaml")
    if not isinstance(named, str):
        raise InputError(f"{path}: config: expected a path; found {named!r}")
    source = path.parent / named
    if not source.is_file():
        raise InputError(f"{path}: config: expected the run's config.yaml; found no {source}")
    overrides = {} if duration is None else {"task.duration": float(duration)}
    config: Config = load_config(source, overrides=overrides)
    body = data.get("morphology")
    if config.bodies is not None:
        if not isinstance(body, str) or not (path.parent / body).is_file():
            raise InputError(
                f"{path}: morphology: expected the path of the champion's body, as bodies have "
                f"evolved; found {show(body)}"
            )
        config = config.for_body((path.parent / body).absolute())
    fitness = make_fitness(config)
    if len(genes) != fitness.num_genes:
        raise InputError(
            f"{path}: genes: expected {fitness.num_genes}, as {source.name} has it; found "
            f"{len(genes)}"
        )
    key = replay_key(config.evolution.seed) if seed is None else jax.random.key(seed)
    score = data.get("score")
    folder = source.parent.absolute()
    return Episode(
        title=f"{fitness.robot.morphology.name}: {config.task.name.replace('_', ' ')}",
        robot=fitness.robot,
        trajectory=fitness.replay(genes, key),
        water=fitness.water(key),
        score=float(score) if isinstance(score, int | float) else None,
        score_unit=score_unit(config.task.type),
        genes=genes,
        fitness=fitness,
        folder=folder,
    )


def load_genes(path: str | Path) -> np.ndarray:
    """Reads a champion's genes.

    Args:
        path: a run folder, its `champion` folder, or a `genes.yaml`.

    Returns:
        `[G]` float32, the same bits as evolved.

    Raises:
        InputError: there is no champion, or its file holds something else.
    """
    path = Path(path)
    if path.is_dir():
        inside = path / "genes.yaml"
        path = inside if inside.exists() else path / "champion" / "genes.yaml"
    data = load_yaml(path)
    genes = data.get("genes") if isinstance(data, dict) else None
    if not isinstance(genes, list) or not all(isinstance(gene, float | int) for gene in genes):
        raise InputError(f"{path}: genes: expected a list of numbers; found {str(genes)[:60]}")
    return np.asarray(genes, np.float32)
