"""Who may be dropped into a running world: a run's champion and individuals, and morphologies."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjx_revolve.body.morphology import Morphology, load_morphology, trim_neutral
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.engine.spheres import count_spheres
from mjx_revolve.episodes.champion import load_genes
from mjx_revolve.episodes.config import Config, load_config, override_config
from mjx_revolve.episodes.fitness import MixedFitness, make_mixed_fitness, read_modules
from mjx_revolve.episodes.lives import INDIVIDUALS, read_lives
from mjx_revolve.episodes.tasks import score_unit
from mjx_revolve.inputs.errors import InputError, load_yaml, show
from mjx_revolve.inputs.shipped import find_shipped, list_shipped
from mjx_revolve.view.live.keeper import Entry
from mjx_revolve.water.world import World, load_world

# Whose water and controller, where nobody names one.
_USUAL = "lake_swim"
_FIRST = "spider"  # of the shipped robots
# Robots live on, and may come to a bed that they could not reach in an episode [s]. A choice.
_WHILE = 600.0
# How many of those who lived in a run are offered, the best first. A choice.
_MOST_LIVES = 12


_Genes = Callable[[int], np.ndarray | None]


class _Draft(NamedTuple):
    """An entry, before it is known what there must be room for.

    Attributes:
        name: see `keeper.Entry`.
        short: likewise.
        group: likewise.
        body: trimmed.
        genes: from how many there must be; None: drawn as evolution draws its first ones.
    """

    name: str
    short: str
    group: str
    body: Morphology
    genes: _Genes | None


@dataclass(frozen=True, eq=False)
class Stock:
    """What a user has named, and what is always there.

    Attributes:
        mixed: controller, world, and room for all.
        entries: who may be dropped; the first is there at the beginning.
        title: what is shown, in a few words.
    """

    mixed: MixedFitness
    entries: tuple[Entry, ...]
    title: str

    @property
    def world(self) -> World:
        """Around all."""
        return self.mixed.world

    @property
    def spheres(self) -> int:
        """Most that stand for one of them in contact."""
        return count_spheres([entry.robot for entry in self.entries])


def load_stock(paths: Sequence[str], world: str | None = None) -> Stock:
    """Reads what a user has named.

    Args:
        paths: run folders, configurations and morphologies, or shipped ones' names. The first run
            or configuration says what the controller is, and the world; without one these are
            lake_swim's.
        world: another world: a name or a YAML; None: the one above.

    Returns:
        The stock: what was named, then all shipped morphologies.

    Raises:
        InputError: a file is missing or wrong, or a run has another controller.
    """
    named = [(path, _kind(path)) for path in paths]
    sources = [path for path, kind in named if kind != "body"]
    config = _read_config(sources[0] if sources else _USUAL)
    changes: dict[str, Any] = {"engine": "population", "task.duration": _WHILE}
    config = override_config(config, changes | ({} if world is None else {"world": world}))
    water = load_world(config.world_name, **config.world_overrides)
    drafts: list[_Draft] = []
    for path, kind in named:
        if kind == "body":
            drafts += _bodies(config, water, find_shipped(path, "morphologies"))
            continue
        own = _read_config(path)
        if own.controller != config.controller:
            raise InputError(
                f"{path}: controller: expected that of {sources[0]}, as all robots of a world have "
                f"one kind; found another ({own.controller.type})"
            )
        if kind == "run":
            drafts += _lives(own, water, Path(path))
        elif own.bodies is None:
            assert own.morphology is not None
            drafts += _bodies(config, water, Path(own.morphology))
        else:
            for seed in own.bodies.seeds:
                drafts += _bodies(config, water, Path(seed))
    shipped = list_shipped("morphologies")
    for name in sorted(shipped, key=lambda name: (name != _FIRST, name)):
        known = {(draft.short, draft.name) for draft in drafts}
        more = _bodies(config, water, shipped[name], "shipped")
        alike = config.controller.sensors is not None or more[0].body.sensors is None
        drafts += [x for x in more if alike and (x.short, x.name) not in known]
    title = " and ".join(Path(path).stem or path for path in paths)
    mixed = make_mixed_fitness(config, [draft.body for draft in drafts])
    return Stock(mixed, tuple(_entry(mixed, draft) for draft in drafts), title)


def _entry(mixed: MixedFitness, draft: _Draft) -> Entry:
    """A draft with its body in the world of all."""
    robot = build_robot(draft.body, mixed.world)

    def genes() -> np.ndarray | None:
        count = mixed.controller_of(robot).num_genes
        if draft.genes is not None:
            return draft.genes(count)
        draw = np.random.default_rng().standard_normal(count)
        return (mixed.config.evolution.std_init * draw).astype(np.float32)

    return Entry(draft.name, draft.short, draft.group, robot, genes)


def _kind(path: str) -> str:
    """What a path is of: "run", "config" or "body".

    Raises:
        InputError: of nothing that can be dropped.
    """
    place = Path(path)
    if place.is_dir():
        if not (place / "config.yaml").is_file():
            raise InputError(f"{path}: expected a run folder; found no config.yaml in it")
        return "run"
    configs, bodies = list_shipped("configs"), list_shipped("morphologies")
    if not place.exists() and path in configs:
        return "config"
    if not place.exists() and path in bodies:
        return "body"
    if not place.is_file():
        raise InputError(
            f"{path}: expected a run folder, a configuration or a morphology; found none, and no "
            f"shipped one of this name ({', '.join((*configs, *bodies))})"
        )
    data = load_yaml(place)
    if isinstance(data, dict) and "body" in data:
        return "body"
    if isinstance(data, dict) and "task" in data:
        return "config"
    raise InputError(
        f"{path}: expected a run folder, a configuration or a morphology; found a file with "
        "neither task nor body"
    )


def _read_config(path: str) -> Config:
    place = Path(path)
    return load_config(place / "config.yaml" if place.is_dir() else path)


# --- morphologies ---------------------------------------------------------------------------------


def _bodies(config: Config, water: World, path: Path, group: str = "") -> list[_Draft]:
    """A morphology whose genes are drawn, and one that keeps still."""
    morphology = load_morphology(path, read_modules(config), config.allow_overlap)
    with suppress(InputError):  # what floats, floats
        morphology = trim_neutral(morphology, water.density)
    name = path.stem
    group = group or name
    drafts = [_Draft(f"{name}, still", name, group, morphology, lambda _: None)]
    if morphology.num_hinges + morphology.num_thrusters > 0:
        drafts.insert(0, _Draft(f"{name}, a brain by chance", name, group, morphology, None))
    return drafts


# --- runs -----------------------------------------------------------------------------------------


def _lives(own: Config, water: World, folder: Path) -> list[_Draft]:
    """A run's champion, and, where bodies evolve, the best of those who lived."""
    unit, group = score_unit(own.task.type), folder.absolute().name
    drafts = []
    places = (folder / "genes.yaml", folder / "champion" / "genes.yaml")
    champion = next((place for place in places if place.is_file()), None)
    if champion is not None:
        data = load_yaml(champion)
        score = data.get("score") if isinstance(data, dict) else None
        words = f": {score:.3g} {unit}" if isinstance(score, float) else ""
        body = _trimmed(own, _champion_body(own, champion, data), water)
        genes = _known(load_genes(champion), str(champion))
        drafts.append(_Draft(f"champion{words}", "champion", group, body, genes))
    if own.bodies is not None and (folder / INDIVIDUALS).is_file():
        lives, _ = read_lives(folder)
        scored = [life for life in lives.values() if math.isfinite(life.score)]
        for life in sorted(scored, key=lambda life: (-life.score, life.number))[:_MOST_LIVES]:
            short = f"individual {life.number}"
            body = _trimmed(own, life.grow(read_modules(own)), water)
            name = f"{short}: {life.score:.3g} {unit}"
            drafts.append(_Draft(name, short, group, body, _known(life.genes, short)))
    if not drafts:
        raise InputError(f"{folder}: expected a champion, or somebody who lived; found nobody yet")
    return drafts


def _champion_body(own: Config, path: Path, data: Any) -> Morphology:
    body = own.morphology
    if own.bodies is not None:
        named = data.get("morphology") if isinstance(data, dict) else None
        if not isinstance(named, str) or not (path.parent / named).is_file():
            raise InputError(
                f"{path}: morphology: expected the path of the champion's body, as bodies have "
                f"evolved; found {show(named)}"
            )
        body = str((path.parent / named).absolute())
    assert body is not None
    return load_morphology(body, read_modules(own), allow_overlap=True)


def _trimmed(own: Config, morphology: Morphology, water: World) -> Morphology:
    return trim_neutral(morphology, water.density) if own.trim == "neutral" else morphology


def _known(genes: np.ndarray | None, place: str) -> _Genes:
    """Genes that must be as many as a body's controller takes."""

    def find(count: int) -> np.ndarray | None:
        if genes is not None and len(genes) != count:
            raise InputError(f"{place}: genes: expected {count}; found {len(genes)}")
        return genes

    return find
