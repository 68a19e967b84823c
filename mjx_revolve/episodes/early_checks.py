"""Files that commands read, checked before JAX is imported: a wrong one is refused at once."""

from __future__ import annotations

import argparse
from pathlib import Path

from mjx_revolve.body.catalogue import MODULES, load_modules
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.episodes.run_reader import ChampionRecord, RunReader, read_champion
from mjx_revolve.inputs.commands import opening_episode
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import check_path
from mjx_revolve.inputs.shipped import find_shipped
from mjx_revolve.inputs.yaml_reader import load_yaml
from mjx_revolve.water.world import load_world


def check_episode_files(arguments: argparse.Namespace) -> None:
    """Checks the files that `champion.load_episode` will read first.

    Args:
        arguments: with what `commands.add_episode_arguments` adds.

    Raises:
        InputError: a file is wrong, or not trusted.
    """
    with opening_episode(arguments):
        path = check_path(arguments.path)
        if path.is_dir():
            refuse_world(arguments.world, arguments.modules)
            if arguments.individual is None and not arguments.colony:
                _check_champion(RunReader(path).load_champion())
            return
        path = find_shipped(path, "morphologies")
        data = load_yaml(path)
        if isinstance(data, dict) and "genes" in data:
            refuse_world(arguments.world, arguments.modules)
            _check_champion(read_champion(path))
        elif isinstance(data, dict) and "body" in data:
            load_world("lake" if arguments.world is None else arguments.world)
            own = {} if arguments.modules is None else load_modules(arguments.modules)
            load_morphology(path, MODULES | own)


def _check_champion(record: ChampionRecord) -> None:
    record.load_config()


def refuse_world(world: str | None, modules: str | Path | None = None) -> None:
    """Refuses a world, or modules, for a run, which names its own.

    Raises:
        InputError: there is one.
    """
    if world is not None:
        raise InputError("world", "none: a champion swims in the world it evolved in", repr(world))
    if modules is not None:
        raise InputError("modules", "none: a run's configuration names its own", repr(str(modules)))
