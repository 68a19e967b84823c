"""Files that commands read, checked before JAX is imported: a wrong one is refused at once."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from mjx_revolve.body.catalogue import MODULES, load_modules
from mjx_revolve.body.morphology import Morphology, load_morphology
from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.episodes.named_files import read_modules
from mjx_revolve.episodes.run_reader import ChampionRecord, RunReader, find_run, read_champion
from mjx_revolve.inputs.commands import opening_episode
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import check_path
from mjx_revolve.inputs.shipped import find_shipped, list_shipped
from mjx_revolve.inputs.yaml_reader import load_yaml
from mjx_revolve.water.world import World, load_world

USUAL_CONFIG = "lake_swim"
"""The configuration with the default water and controller."""


def read_episode_file(
    path: str | Path, world: str | None, modules: str | Path | None
) -> ChampionRecord | tuple[Morphology, World] | None:
    """The champion, or the morphology and its world, that the arguments of `load_episode` name.

    Args:
        path: as of `load_episode`.
        world: of a morphology, by default the lake; None for a champion.
        modules: of a morphology; None for a champion.

    Returns:
        None for a file that holds neither.

    Raises:
        InputError: a file is missing or wrong, or a world or modules are given for a run.
    """
    path = check_path(path)
    if path.is_dir():
        refuse_world(world, modules)
        return RunReader(path).load_champion()
    path = find_shipped(path, "morphologies")
    data = load_yaml(path)
    if isinstance(data, dict) and "genes" in data:
        refuse_world(world, modules)
        return read_champion(path)
    if isinstance(data, dict) and "body" in data:
        water = load_world("lake" if world is None else world)
        own = {} if modules is None else load_modules(modules)
        return load_morphology(path, MODULES | own), water
    return None


def check_episode_files(arguments: argparse.Namespace) -> bool:
    """Checks the files that `champion.load_episode` will read first.

    Args:
        arguments: with what `commands.add_episode_arguments` adds.

    Returns:
        Whether it is a morphology, which has no genes.

    Raises:
        InputError: a file is wrong, or not trusted.
    """
    with opening_episode(arguments):
        path, world, modules = arguments.path, arguments.world, arguments.modules
        if (arguments.individual is not None or arguments.colony) and check_path(path).is_dir():
            refuse_world(world, modules)
            return False
        found = read_episode_file(path, world, modules)
        if isinstance(found, ChampionRecord):
            found.load_config()
        return isinstance(found, tuple)


def check_live_files(paths: Sequence[str], world: str | None) -> None:
    """Checks the files that a live world will read first; arguments as of `load_catalogue`.

    Raises:
        InputError: a file is missing or wrong.
    """
    kinds = {path: named_kind(path) for path in paths}
    configs = [read_named_config(path) for path, kind in kinds.items() if kind != "body"]
    config = configs[0] if configs else load_config(USUAL_CONFIG)
    if world is not None:
        load_world(os.path.expanduser(world))
    for path, kind in kinds.items():
        if kind == "body":
            body = find_shipped(path, "morphologies")
            load_morphology(body, read_modules(config), config.allow_overlap)


def named_kind(path: str) -> str:
    """The kind of a path: "run", "config" or "body"; InputError for anything else."""
    place = Path(path)
    if place.is_dir():
        find_run(place)
        return "run"
    configs, bodies = list_shipped("configs"), list_shipped("morphologies")
    if not place.exists() and path in configs:
        return "config"
    if not place.exists() and path in bodies:
        return "body"
    wanted = "a run folder, a configuration or a morphology"
    if not place.is_file():
        names = ", ".join((*configs, *bodies))
        raise InputError(path, wanted, f"none, and no shipped one of this name ({names})")
    data = load_yaml(place)
    if isinstance(data, dict) and "body" in data:
        return "body"
    if isinstance(data, dict) and "task" in data:
        return "config"
    raise InputError(path, wanted, "a file with neither task nor body")


def read_named_config(path: str) -> Config:
    """The configuration of a run folder, or of a file or a shipped one's name."""
    return RunReader(find_run(path)).load_config() if Path(path).is_dir() else load_config(path)


def refuse_world(world: str | None, modules: str | Path | None) -> None:
    """Refuses a world, or modules, for a run, which names its own.

    Raises:
        InputError: there is one.
    """
    if world is not None:
        raise InputError("world", "none: a champion swims in the world it evolved in", repr(world))
    if modules is not None:
        raise InputError("modules", "none: a run's configuration names its own", repr(str(modules)))
