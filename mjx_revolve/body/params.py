"""What a module's `params` in a morphology file change of its type: masses, volumes, laws, numbers.

`load_morphology` lists them for users.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from mjx_revolve.body.module_types import (
    ModuleType,
    Part,
    Thruster,
    check_number,
    check_vector,
    show,
)
from mjx_revolve.body.plates import LiftDrag
from mjx_revolve.inputs.errors import InputError

_NUMBERS = {
    "mass": "kg",
    "volume": "m3",
    "electronics_volume": "m3",
    "ballast": "kg",
    "ballast_volume": "m3",
    "drag_coefficient": "-",
    "added_mass_coefficient": "-",
    "entrained_water": "-",
    "thrust": "N",
}
_VECTORS = ("ballast_position", "center_of_volume")
_TABLES = {"lift_drag": LiftDrag, "thruster": Thruster}
# What every part takes over as it is, and checks.
_PLAIN = (
    "drag_coefficient", "added_mass_coefficient", "entrained_water",
    "buoyancy", "drag", "added_mass",
)  # fmt: skip

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


def read_number(value: Any) -> Any:
    """Text such as `0.707;`, as found in files, as a number; everything else as it is."""
    if isinstance(value, str):
        text = value.strip().rstrip(";,").rstrip()
        return float(text) if _NUMBER.fullmatch(text) else value
    return value


def check_overrides(params: Mapping[str, Any], place: str) -> dict[str, Any]:
    """The params with numbers and vectors checked and made plain floats.

    Args:
        params: of one module; keys that are no overrides are kept as they are.
        place: where, for messages.

    Returns:
        The same keys.

    Raises:
        InputError: a value is out of range.
    """
    found = dict(params)
    for key, unit in _NUMBERS.items():
        if key in found:
            found[key] = check_number(read_number(found[key]), f"{place}.{key}", unit)
    for key in _VECTORS:
        if key in found:
            value = found[key]
            listed = [read_number(x) for x in value] if isinstance(value, list) else value
            found[key] = list(check_vector(listed, f"{place}.{key}", "m"))
    for key, kind in _TABLES.items():
        if key not in found:
            continue
        known = [f.name for f in fields(kind)]
        if not isinstance(found[key], dict) or not found[key]:
            raise InputError(
                f"{place}.{key}: expected a mapping with any of {', '.join(known)}; "
                f"found {show(found[key])}"
            )
        for name in found[key]:
            if name not in known:
                raise InputError(
                    f"{place}.{key}: expected only {', '.join(known)}; found {show(name)}"
                )
    return found


def _share(values: list[float], total: float) -> list[float]:
    """Splits a total in proportion to `values`; all to the first where they are all 0."""
    whole = sum(values)
    if whole == 0.0:
        return [total] + [0.0] * (len(values) - 1)
    return [total * (value / whole) for value in values]


def apply_overrides(kind: ModuleType, params: Mapping[str, Any]) -> ModuleType:
    """The type with a module's own masses, volumes, laws and numbers.

    Args:
        kind: the module's type.
        params: from `check_overrides`.

    Returns:
        The changed type.

    Raises:
        InputError: a value is out of range, or of something that the type does not have.
    """
    known = (*_NUMBERS, *_VECTORS, *_TABLES, *_PLAIN)
    if not any(key in params for key in known):
        return kind
    parts = list(kind.parts)
    for key in ("mass", "volume"):
        if key in params:
            values = _share([getattr(part, key) for part in parts], params[key])
            changes: list[dict[str, Any]] = [{key: value} for value in values]
            parts = [replace(p, **change) for p, change in zip(parts, changes, strict=True)]
    largest = max(range(len(parts)), key=lambda i: kind.parts[i].volume)
    if "electronics_volume" in params:
        parts = [
            replace(part, electronics_volume=params["electronics_volume"] if i == largest else 0.0)
            for i, part in enumerate(parts)
        ]
    if "center_of_volume" in params:
        place = tuple(params["center_of_volume"])
        parts[largest] = replace(parts[largest], center_of_volume=place)
    parts[0] = _with_ballast(parts[0], params)
    plain = {key: params[key] for key in _PLAIN if key in params}
    # YAML 1.1 reads a bare `off` as False.
    plain |= {key: "off" for key in ("buoyancy", "drag") if plain.get(key) is False}
    parts = [replace(part, **plain) for part in parts]
    if "lift_drag" in params:
        # A module without a fin becomes one, whole.
        own = any(part.lift_drag is not None for part in parts)
        parts = [
            replace(part, lift_drag=replace(part.lift_drag or LiftDrag(), **params["lift_drag"]))
            if part.lift_drag is not None or not own
            else part
            for part in parts
        ]
    if "thruster" in params or "thrust" in params:
        parts = [_with_thruster(part, params) for part in parts]
        if all(part.thruster is None for part in parts):
            key = "thruster" if "thruster" in params else "thrust"
            raise InputError(f"{key}: expected a module with a thruster; found type {kind.name}")
    return replace(kind, parts=tuple(parts))


def _with_ballast(part: Part, params: Mapping[str, Any]) -> Part:
    """The first part with its ballast: spread over it, or a point where it has a place."""
    placed = {key: params[key] for key in ("ballast_volume", "ballast_position") if key in params}
    if not placed:
        return replace(part, mass=part.mass + params.get("ballast", 0.0))
    if "ballast" in params:
        placed["ballast_mass"] = params["ballast"]
    return replace(part, **placed)


def _with_thruster(part: Part, params: Mapping[str, Any]) -> Part:
    """The part with its thruster's numbers, then its curve scaled to a thrust [N]."""
    thruster = part.thruster
    if thruster is None:
        return part
    thruster = replace(thruster, **params.get("thruster", {}))
    if "thrust" in params:
        ahead = thruster.range[1]
        full = thruster.thrust_at(ahead)
        if full <= 0.0:
            raise InputError(
                f"thrust: expected a thruster that pushes at its highest command {ahead:g}; found "
                f"{full:g} N there"
            )
        thruster = thruster.scaled(params["thrust"] / full)
    return replace(part, thruster=thruster)
