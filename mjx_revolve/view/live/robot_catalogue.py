"""The robots that can be added to a live simulation: a run's, and those of morphologies."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_revolve.body.morphology import Morphology, load_morphology, trim_neutral
from mjx_revolve.engine.robot import Robot, build_robot, check_timestep
from mjx_revolve.engine.spheres import count_spheres
from mjx_revolve.episodes.config import Config, ControllerConfig, override_config
from mjx_revolve.episodes.early_checks import USUAL_CONFIG, named_kind, read_named_config
from mjx_revolve.episodes.fitness import MixedFitness, make_mixed_fitness
from mjx_revolve.episodes.individual_log import INDIVIDUALS, read_individuals
from mjx_revolve.episodes.named_files import read_modules, read_world
from mjx_revolve.episodes.run_reader import RunReader, find_run
from mjx_revolve.episodes.settings import map_files
from mjx_revolve.episodes.tasks import COLONY_FITNESS, score_unit
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.shipped import find_shipped, list_shipped
from mjx_revolve.view.live.simulation import CatalogueEntry
from mjx_revolve.view.population import rank
from mjx_revolve.water.world import World, load_world

_FIRST = "spider"  # of the shipped robots
# Robots live on, and may come to a bed that they could not reach in an episode [s]. A choice.
_WHILE = 600.0
# How many of a run's individuals are offered, the best first. A choice.
_MOST_INDIVIDUALS = 12


_Genes = Callable[[int], np.ndarray | None]


class _Draft(NamedTuple):
    """An entry, before the robot is built.

    Attributes:
        name, short, group: see `simulation.CatalogueEntry`.
        body: trimmed.
        genes: a function of their number; None: drawn as in evolution's first generation.
    """

    name: str
    short: str
    group: str
    body: Morphology
    genes: _Genes | None


@dataclass(frozen=True, eq=False)
class RobotCatalogue:
    """All robots that can be added to a live simulation.

    Attributes:
        mixed: controller, world, and room for all.
        entries: the robots; the first is there at the beginning.
        title: what is shown, in a few words.
    """

    mixed: MixedFitness
    entries: tuple[CatalogueEntry, ...]
    title: str

    @property
    def world(self) -> World:
        """The world of all robots."""
        return self.mixed.world

    @property
    def spheres(self) -> int:
        """The most contact spheres of any of the robots."""
        return count_spheres([entry.robot for entry in self.entries])


def load_catalogue(paths: Sequence[str], world: str | None = None) -> RobotCatalogue:
    """Reads the robots that a user has named.

    Args:
        paths: run folders, configurations and morphologies, or shipped ones' names. The first run
            or configuration names the controller and the world; without one these are
            lake_swim's.
        world: another world: a name or a YAML; None: the one above.

    Returns:
        The named robots, then all shipped morphologies that the world's step can simulate.

    Raises:
        InputError: a file is missing or wrong, or a run has another controller.
    """
    named = [(path, named_kind(path)) for path in paths]
    sources = [path for path, kind in named if kind != "body"]
    config = read_named_config(sources[0] if sources else USUAL_CONFIG)
    changes: dict[str, Any] = {
        "engine": "population", "task.duration": _WHILE, "task.horizon": None
    }  # fmt: skip
    if world is not None:
        load_world(os.path.expanduser(world))  # what is wrong of it is said of the option
    config = override_config(config, changes | ({} if world is None else {"world": world}))
    water = read_world(config)
    drafts: list[_Draft] = []
    for path, kind in named:
        if kind == "body":
            drafts += _bodies(config, water, find_shipped(path, "morphologies"))
            continue
        own = read_named_config(path)
        if _controller(own) != _controller(config):
            alike = f"that of {sources[0]}, as all robots of a world have one kind"
            raise InputError(f"{path}: controller", alike, f"another ({own.controller.type})")
        if kind == "run":
            drafts += _run_drafts(own, water, Path(path))
        elif own.bodies is None:
            assert own.morphology is not None
            drafts += _bodies(own, water, Path(own.morphology))
        else:
            for seed in own.bodies.seeds:
                drafts += _bodies(own, water, Path(seed))
    shipped = list_shipped("morphologies")
    for name in sorted(shipped, key=lambda name: (name != _FIRST, name)):
        known = {(draft.short, draft.name) for draft in drafts}
        more = _bodies(config, water, shipped[name], "shipped")
        sensed = config.controller.sensors is not None or more[0].body.sensors is None
        if sensed and _can_swim(more[0].body, water):
            drafts += [x for x in more if (x.short, x.name) not in known]
    names = (Path(x).name if Path(x).is_dir() else Path(x).stem for x in paths)
    title = " and ".join(name or path for name, path in zip(names, paths, strict=True))
    # Drafts are trimmed, as far as they can be; many share a body.
    bodies = {id(draft.body): draft.body for draft in drafts}
    mixed = make_mixed_fitness(override_config(config, {"trim": "none"}), [*bodies.values()])
    robots = {key: build_robot(body, mixed.world) for key, body in bodies.items()}
    entries = tuple(_entry(mixed, draft, robots[id(draft.body)]) for draft in drafts)
    return RobotCatalogue(mixed, entries, title)


def _controller(config: Config) -> dict[str, Any]:
    """The controller's settings, files by what they hold: each run has copies of its own."""
    data = config.controller.model_dump()
    return map_files(data, lambda file: (file.function, file.digest()), ControllerConfig)


def _can_swim(morphology: Morphology, water: World) -> bool:
    """Whether the world's step can simulate a robot: some are too light for a long one."""
    try:
        check_timestep(build_robot(morphology, water))
    except InputError:
        return False
    return True


def _entry(mixed: MixedFitness, draft: _Draft, robot: Robot) -> CatalogueEntry:
    """A draft with its robot."""

    def genes() -> np.ndarray | None:
        count = mixed.controller_of(robot).num_genes
        if draft.genes is not None:
            return draft.genes(count)
        draw = np.random.default_rng().standard_normal(count)
        return (mixed.config.evolution.std_init * draw).astype(np.float32)

    return CatalogueEntry(draft.name, draft.short, draft.group, robot, genes)


# --- morphologies ---------------------------------------------------------------------------------


def _bodies(config: Config, water: World, path: Path, group: str = "") -> list[_Draft]:
    """A morphology with random genes, and the same without a controller.

    It is trimmed if the configuration says so; so are shipped robots that stand beside.
    """
    morphology = load_morphology(path, read_modules(config), config.allow_overlap)
    with suppress(InputError):  # a robot that floats stays as it is
        if group == "shipped" or config.trim == "neutral":
            morphology = trim_neutral(morphology, water.density)
    name = path.stem
    group = group or name
    drafts = [_Draft(f"{name}, still", name, group, morphology, lambda _: None)]
    if morphology.num_hinges + morphology.num_thrusters > 0:
        drafts.insert(0, _Draft(f"{name}, a brain by chance", name, group, morphology, None))
    return drafts


# --- runs -----------------------------------------------------------------------------------------


def _run_drafts(own: Config, water: World, folder: Path) -> list[_Draft]:
    """A run's champion, and, where bodies evolve, its best individuals."""
    unit, group = score_unit(own.task.type, own.task.unit), folder.absolute().name
    selected = unit if own.colony is None else COLONY_FITNESS
    run, drafts = RunReader(find_run(folder)), []
    if run.champion_path is not None:
        champion = run.load_champion()
        own_unit = unit if champion.is_final else selected
        words = "" if champion.score is None else f": {champion.score:.3g} {own_unit}"
        named = champion.load_config().morphology
        assert named is not None
        body = load_morphology(named, read_modules(own), allow_overlap=True)
        body, genes = _trimmed(own, body, water), _known(champion.genes, str(champion.path))
        drafts.append(_Draft(f"champion{words}", "champion", group, body, genes))
    if own.bodies is not None and (run.path / INDIVIDUALS).is_file():
        lives, _ = read_individuals(run.path)
        scored = [life for life in lives.values() if math.isfinite(life.score)]
        for life in sorted(scored, key=rank)[:_MOST_INDIVIDUALS]:
            short = f"individual {life.number}"
            body = _trimmed(own, life.grow(read_modules(own)), water)
            name = f"{short}: {life.score:.3g} {selected}"
            drafts.append(_Draft(name, short, group, body, _known(life.genes, short)))
    if not drafts:
        raise InputError(folder, "a champion or individuals", "none yet")
    return drafts


def _trimmed(own: Config, morphology: Morphology, water: World) -> Morphology:
    return trim_neutral(morphology, water.density) if own.trim == "neutral" else morphology


def _known(genes: np.ndarray | None, place: str) -> _Genes:
    """Genes that must be as many as a body's controller takes."""

    def find(count: int) -> np.ndarray | None:
        if genes is not None and len(genes) != count:
            raise InputError(f"{place}: genes", count, len(genes))
        return genes

    return find
