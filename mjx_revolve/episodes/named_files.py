"""Files that a configuration names: world, types of modules and morphology. Read without JAX."""

from __future__ import annotations

from collections.abc import Mapping

from mjx_revolve.body.catalogue import MODULES, load_modules
from mjx_revolve.body.coefficients import correct_types, load_coefficients
from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import Morphology, load_morphology
from mjx_revolve.episodes.config import Config
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.world import World, load_world


def check_files(config: Config) -> None:
    """Reads all of them, so that a wrong one is refused before JAX is imported.

    Raises:
        InputError: a file is wrong.
    """
    read_world(config)
    if config.morphology is not None:
        read_morphology(config)
        return
    modules = read_modules(config)
    for path in config.bodies.seeds if config.bodies is not None else ():
        load_morphology(path, modules, config.allow_overlap)


def read_world(config: Config) -> World:
    """The world of a configuration.

    Raises:
        InputError: it is wrong; the message says whether the configuration or the world's file.
    """
    try:
        return load_world(config.world_name, **config.world_overrides)
    except InputError as error:
        name, _, text = str(error).partition(": ")
        place = {"world": "world"}.get(name, "")
        if name.startswith("world "):  # "world lake: density: expected ..."
            place = f"world.{text.partition(':')[0]}"
        before = config.origin(place)
        typed = name != "world" and before != config.origin("")
        raise InputError(before + (f"world.{text}" if typed else str(error))) from None


def read_modules(config: Config) -> Mapping[str, ModuleType]:
    """All types of modules of a configuration, by name and alias."""
    modules = MODULES | load_modules(config.modules) if config.modules else MODULES
    if config.coefficients is None:
        return modules
    return correct_types(modules, load_coefficients(config.coefficients), config.coefficients)


def read_morphology(config: Config) -> Morphology:
    """The body of a configuration that names one.

    Raises:
        InputError: it is wrong.
    """
    assert config.morphology is not None
    return load_morphology(config.morphology, read_modules(config), config.allow_overlap)
