"""The paths in a configuration, made absolute where they are written."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.own_code import parse_own
from mjx_revolve.inputs.shipped import find_shipped


def _is_path(world: str) -> bool:
    """Whether a world is given as a file rather than by name.

    Args:
        world: what was written.

    Returns:
        True if it ends in `.yaml` or `.yml`, or contains a folder.
    """
    return world.endswith((".yaml", ".yml")) or "/" in world or os.sep in world


def resolve_paths(data: dict[str, Any], origin: Callable[[str], tuple[Path, str]]) -> None:
    """Makes all paths absolute in place; a shipped morphology may be given by name.

    Args:
        data: the settings, checked or not.
        origin: for the place of a path, the folder from which it starts and what stands before the
            place in messages.

    Raises:
        InputError: there is no such file, and no shipped morphology of that name.
    """

    def resolve(section: Any, key: Any, within: str = "", robot: bool = False) -> None:
        value = section.get(key) if isinstance(section, dict) else None
        value = section[key] if isinstance(section, list) and isinstance(key, int) else value
        if not isinstance(value, str) or not value:
            return
        code = key in ("type", "genotype")
        own = parse_own(value) if code else None
        if (code and own is None) or (key in ("world", "name") and not _is_path(value)):
            return
        place = f"{within}{key}"
        folder, before = origin(place)
        file = folder / Path(own.path if own else value).expanduser()
        if robot:
            file = find_shipped(Path(value).expanduser(), "morphologies", folder, before + place)
        path = Path(os.path.abspath(file))
        if not path.is_file():
            what = "a folder" if path.is_dir() else "none"
            raise InputError(f"{before}{place}: expected a file; found {what} at {path}")
        section[key] = f"{path}:{own.function}" if own else str(path)

    for key in ("morphology", "modules", "world"):
        resolve(data, key, robot=key == "morphology")
    for key in ("name", "current_field"):
        resolve(data.get("world"), key, "world.")
    for section in ("controller", "task"):
        resolve(data.get(section), "type", f"{section}.")
    bodies = data.get("bodies")
    resolve(bodies, "genotype", "bodies.")
    seeds = bodies.get("seeds") if isinstance(bodies, dict) else None
    for index in range(len(seeds) if isinstance(seeds, list) else 0):
        resolve(seeds, index, "bodies.seeds.", robot=True)
