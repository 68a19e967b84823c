"""Files that commands read, checked before JAX is imported: a wrong one is refused at once."""

from __future__ import annotations

import argparse
from pathlib import Path

from mjx_revolve.body.catalogue import MODULES, load_modules
from mjx_revolve.body.morphology import Morphology, load_morphology
from mjx_revolve.episodes.run_reader import ChampionRecord, RunReader, read_champion
from mjx_revolve.inputs.commands import opening_episode
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import check_path
from mjx_revolve.inputs.shipped import find_shipped
from mjx_revolve.inputs.yaml_reader import load_yaml
from mjx_revolve.water.world import World, load_world


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


def check_episode_files(arguments: argparse.Namespace) -> None:
    """Checks the files that `champion.load_episode` will read first.

    Args:
        arguments: with what `commands.add_episode_arguments` adds.

    Raises:
        InputError: a file is wrong, or not trusted.
    """
    with opening_episode(arguments):
        path, world, modules = arguments.path, arguments.world, arguments.modules
        if (arguments.individual is not None or arguments.colony) and check_path(path).is_dir():
            refuse_world(world, modules)
            return
        found = read_episode_file(path, world, modules)
        if isinstance(found, ChampionRecord):
            found.load_config()


def refuse_world(world: str | None, modules: str | Path | None) -> None:
    """Refuses a world, or modules, for a run, which names its own.

    Raises:
        InputError: there is one.
    """
    if world is not None:
        raise InputError("world", "none: a champion swims in the world it evolved in", repr(world))
    if modules is not None:
        raise InputError("modules", "none: a run's configuration names its own", repr(str(modules)))
