"""Who may be dropped into a running world: a run's champion and individuals, and morphologies."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjx_revolve.body.morphology import Morphology, load_morphology, trim_neutral
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.episodes.champion import load_genes
from mjx_revolve.episodes.config import Config, load_config, override_config
from mjx_revolve.episodes.fitness import fit_body, read_modules
from mjx_revolve.episodes.lives import INDIVIDUALS, Life, read_lives
from mjx_revolve.episodes.tasks import score_unit
from mjx_revolve.inputs.errors import InputError, load_yaml, show
from mjx_revolve.inputs.shipped import find_shipped, list_shipped
from mjx_revolve.view.live.keeper import Entry
from mjx_revolve.water.world import World, load_world

# Whose water and controller, where nobody names one.
_USUAL = "lake_swim"
# How many of those who lived in a run are offered, the best first. A choice.
_MOST_LIVES = 12


@dataclass(frozen=True, eq=False)
class Stock:
    """What a user has named, and what is always there.

    Attributes:
        config: controller and world of all.
        world: the same world.
        entries: who may be dropped; the first is there at the beginning.
        title: what is shown, in a few words.
    """

    config: Config
    world: World
    entries: tuple[Entry, ...]
    title: str


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
    if world is not None:
        config = override_config(config, {"world": world})
    if config.engine != "population":
        config = override_config(config, {"engine": "population"})
    water = load_world(config.world_name, **config.world_overrides)
    entries: list[Entry] = []
    for path, kind in named:
        if kind == "body":
            entries += _bodies(config, water, find_shipped(path, "morphologies"))
            continue
        own = _read_config(path)
        if own.controller != config.controller:
            raise InputError(
                f"{path}: controller: expected that of {sources[0]}, as all robots of a world have "
                f"one kind; found another ({own.controller.type})"
            )
        place = Path(path)
        if kind == "run":
            entries += _lives(config, own, place)
        elif own.morphology is not None:
            entries += _bodies(config, water, Path(own.morphology))
        else:
            assert own.bodies is not None
            for seed in own.bodies.seeds:
                entries += _bodies(config, water, Path(seed))
    usual = "spider"
    shipped = list_shipped("morphologies")
    for name in sorted(shipped, key=lambda name: (name != usual, name)):
        entries += _bodies(config, water, shipped[name], "shipped")
    title = " and ".join(Path(path).stem or path for path in paths) if paths else "live"
    return Stock(config, water, tuple(_distinct(entries)), title)


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


def _distinct(entries: Sequence[Entry]) -> list[Entry]:
    """Of those with one name the first."""
    found: dict[tuple[str, str], Entry] = {}
    for entry in entries:
        found.setdefault((entry.group, entry.name), entry)
    return list(found.values())


# --- morphologies ---------------------------------------------------------------------------------


def _bodies(config: Config, water: World, path: Path, group: str = "") -> list[Entry]:
    """A morphology whose genes are drawn, and one that holds still."""
    morphology = load_morphology(path, read_modules(config), config.allow_overlap)
    with suppress(InputError):  # what floats, floats
        morphology = trim_neutral(morphology, water.density)
    name = path.stem
    group = group or name

    def still() -> tuple[Robot, np.ndarray | None]:
        return build_robot(morphology, water), None

    def moving() -> tuple[Robot, np.ndarray | None]:
        return build_robot(morphology, water), _draw_genes(config, morphology)

    entries = [Entry(f"{name}, still", name, group, still)]
    if morphology.num_hinges + morphology.num_thrusters > 0:
        entries.insert(0, Entry(f"{name}, a brain by chance", name, group, moving))
    return entries


def _draw_genes(config: Config, morphology: Morphology) -> np.ndarray:
    """Genes as evolution draws its first ones."""
    count = fit_body(config, morphology).num_genes
    draw = np.random.default_rng().standard_normal(count)
    return (config.evolution.std_init * draw).astype(np.float32)


# --- runs -----------------------------------------------------------------------------------------


def _lives(config: Config, own: Config, folder: Path) -> list[Entry]:
    """A run's champion, and, where bodies evolve, the best of those who lived."""
    unit = score_unit(own.task.type)
    entries = []
    champion = next(
        (p for p in (folder / "genes.yaml", folder / "champion" / "genes.yaml") if p.is_file()),
        None,
    )
    if champion is not None:
        data = load_yaml(champion)
        score = data.get("score") if isinstance(data, dict) else None
        words = f": {score:.3g} {unit}" if isinstance(score, float) else ""
        entries.append(
            Entry(f"champion{words}", "champion", folder.name, _champion(config, own, champion))
        )
    if own.bodies is not None and (folder / INDIVIDUALS).is_file():
        lives, _ = read_lives(folder)
        scored = [life for life in lives.values() if math.isfinite(life.score)]
        best = sorted(scored, key=lambda life: (-life.score, life.number))[:_MOST_LIVES]
        for life in best:
            short = f"individual {life.number}"
            name = f"{short}: {life.score:.3g} {unit}"
            entries.append(Entry(name, short, folder.name, _life(config, own, life)))
    if not entries:
        raise InputError(f"{folder}: expected a champion, or somebody who lived; found nobody yet")
    return entries


def _champion(
    config: Config, own: Config, path: Path
) -> Callable[[], tuple[Robot, np.ndarray | None]]:
    def make() -> tuple[Robot, np.ndarray | None]:
        genes, data = load_genes(path), load_yaml(path)
        body = own.morphology
        if own.bodies is not None:
            named = data.get("morphology")
            if not isinstance(named, str) or not (path.parent / named).is_file():
                raise InputError(
                    f"{path}: morphology: expected the path of the champion's body, as bodies have "
                    f"evolved; found {show(named)}"
                )
            body = str((path.parent / named).absolute())
        assert body is not None
        morphology = load_morphology(body, read_modules(own), allow_overlap=own.allow_overlap)
        return _fit(config, own, morphology, genes, str(path))

    return make


def _life(config: Config, own: Config, life: Life) -> Callable[[], tuple[Robot, np.ndarray | None]]:
    def make() -> tuple[Robot, np.ndarray | None]:
        return _fit(
            config, own, life.grow(read_modules(own)), life.genes, f"individual {life.number}"
        )

    return make


def _fit(
    config: Config, own: Config, morphology: Morphology, genes: np.ndarray | None, place: str
) -> tuple[Robot, np.ndarray | None]:
    """A robot as its run has it, in the world of all."""
    fitness = fit_body(own.model_copy(update={"world": config.world}), morphology)
    if genes is not None and len(genes) != fitness.num_genes:
        raise InputError(f"{place}: genes: expected {fitness.num_genes}; found {len(genes)}")
    return fitness.robot, genes
