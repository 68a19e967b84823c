"""A module's `params` in a morphology file: overrides of its type's masses, volumes and laws.

The docstring of `make_morphology` lists them for users.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

from annotated_types import MinLen, Unit
from pydantic import AfterValidator, BeforeValidator

from mjx_revolve.body.module_types import ModuleType, Part
from mjx_revolve.body.tree import COLORS
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.schema import (
    Boolean,
    NonNegative,
    Number,
    Positive,
    Share,
    Text,
    Triple,
    also,
    read,
    words,
)
from mjx_revolve.water.law_names import BuoyancyName, Coefficients, Factors, PartDrag, PerAxis
from mjx_revolve.water.plates import Fossen, LiftDrag
from mjx_revolve.water.propellers import Thruster

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


@also({"type": "string", "pattern": "^\\s*[-+]?[.0-9][.0-9eE+-]*[\\s;,]*$"})
def read_number(value: object) -> object:
    """Text such as `0.707;`, as found in files, as a number, in lists too; else as it is."""
    if isinstance(value, list):
        return [read_number(x) for x in value]
    if isinstance(value, str):
        text = value.strip().rstrip(";,").rstrip()
        return float(text) if _NUMBER.fullmatch(text) else value
    return value


_Loose = BeforeValidator(read_number)
_Amount = Annotated[NonNegative, _Loose]
_Place = Annotated[Triple[Annotated[Number, _Loose]], AfterValidator(list), Unit("m")]
# Its values are checked where they are applied.
_Some = Annotated[dict[Text, Any], MinLen(1), words("a mapping with any of its fields")]

MODULE_FACTORS = {"mass": 1.05, "thrust": 1.3, "servo_speed": 1.1, "servo_effort": 1.3}
"""Factors on quantities of modules rather than of the water, with their spread as in
`Coefficient.spread`; a choice, but for the servos' speed (`docs/sensitivity.md`)."""


def _read_factors(value: object) -> dict[str, object]:
    """Factors, checked: those of `MODULE_FACTORS` here, those on coefficients by `Factors`."""
    if not isinstance(value, dict):
        return read(_Some, value)
    own = {key: x for key, x in value.items() if key in MODULE_FACTORS}
    found = {key: read(Positive, read_number(x), key) for key, x in own.items()}
    water = read(Factors, {key: x for key, x in value.items() if key not in own})
    return found | {k: list(x) if isinstance(x, tuple) else x for k, x in water}


# Params that are assigned to the same field of every part.
_PLAIN: dict[str, object] = {
    "drag_coefficient": Annotated[PerAxis, _Loose, Unit("-")],
    "added_mass_coefficient": Annotated[PerAxis, _Loose, Unit("-")],
    "entrained_water": Annotated[Share, _Loose],
    "coefficients": Annotated[Coefficients, AfterValidator(dict)],
    "buoyancy": BuoyancyName,
    "drag": PartDrag,
    "added_mass": Boolean,
}
# All overrides; colours are none.
_OVERRIDES: dict[str, object] = _PLAIN | {
    "mass": Annotated[_Amount, Unit("kg")],
    "volume": Annotated[_Amount, Unit("m3")],
    "electronics_volume": Annotated[_Amount, Unit("m3")],
    "ballast": Annotated[_Amount, Unit("kg")],
    "ballast_volume": Annotated[_Amount, Unit("m3")],
    "ballast_position": _Place,
    "center_of_volume": _Place,
    "thrust": Annotated[_Amount, Unit("N")],
    "factors": Annotated[Any, BeforeValidator(_read_factors)],
    "lift_drag": _Some,
    "fossen": _Some,
    "thruster": _Some,
}
# Similarity (of difflib) above which an unknown key counts as a misspelt one of ours: one letter in
# four. A choice; other unknown keys are kept, as other programs write their own.
_SIMILARITY = 0.8
PARAMS: dict[str, Any] = _OVERRIDES | dict.fromkeys(
    COLORS, Annotated[Share, _Loose, words("a number from 0 to 1")]
)


def check_overrides(params: Mapping[str, object], place: str) -> dict[str, Any]:
    """The params with overrides and colours checked, numbers as floats.

    Args:
        params: of one module; other keys are kept as they are, unless they look like one of ours.
        place: where, for messages.

    Returns:
        The same keys.

    Raises:
        InputError: a value is out of range, or a key seems to be misspelt.
    """
    for key in params:
        if isinstance(key, str) and key not in PARAMS:
            near = difflib.get_close_matches(key.strip().lower(), PARAMS, n=1, cutoff=_SIMILARITY)
            if near:
                raise InputError(place, f"{near[0]}, or a key less like it", show(key))
    return {
        key: read(PARAMS[key], value, f"{place}.{key}") if key in PARAMS else value
        for key, value in params.items()
    }


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
        InputError: a value is out of range, or for a thruster, fin or part that the type lacks.
    """
    if not _OVERRIDES.keys() & params:
        return kind
    parts = kind.parts
    changes = [{key: params[key] for key in _PLAIN if key in params} for _ in parts]
    if "coefficients" in params:
        for part, change in zip(parts, changes, strict=True):
            change["coefficients"] = dict(part.coefficients) | params["coefficients"]
    for key in ("mass", "volume"):
        if key in params:
            shares = _share([getattr(part, key) for part in parts], params[key])
            for change, share in zip(changes, shares, strict=True):
                change[key] = share
    largest = max(range(len(parts)), key=lambda i: parts[i].volume)
    if "electronics_volume" in params:
        for change in changes:
            change["electronics_volume"] = 0.0
        changes[largest]["electronics_volume"] = params["electronics_volume"]
    if "center_of_volume" in params:
        changes[largest]["center_of_volume"] = params["center_of_volume"]
    if "ballast_volume" in params or "ballast_position" in params:
        names = {"ballast": "ballast_mass"}
        placed = ("ballast", "ballast_volume", "ballast_position")
        changes[0] |= {names.get(key, key): params[key] for key in placed if key in params}
    elif "ballast" in params:
        changes[0]["mass"] = changes[0].get("mass", parts[0].mass) + params["ballast"]
    if "lift_drag" in params:
        # In a module without a fin, all parts become one.
        for part, change in zip(parts, changes, strict=True):
            if part.lift_drag is not None or not kind.is_fin:
                change["lift_drag"] = replace(part.lift_drag or LiftDrag(), **params["lift_drag"])
    if "fossen" in params:
        if len(parts) > 1:
            raise InputError(
                "fossen", "a module with one part", f"type {kind.name} with {len(parts)}"
            )
        changes[0]["fossen"] = read(Fossen, params["fossen"], "fossen")
    if "thruster" in params or "thrust" in params:
        if not kind.is_thruster:
            key = "thruster" if "thruster" in params else "thrust"
            raise InputError(key, "a module with a thruster", f"type {kind.name}")
        for part, change in zip(parts, changes, strict=True):
            if part.thruster is not None:
                change["thruster"] = _change_thruster(part.thruster, params)
    changed = [replace(part, **change) for part, change in zip(parts, changes, strict=True)]
    kind = replace(kind, parts=tuple(changed))
    return _multiply(kind, params["factors"]) if params.get("factors") else kind


def _multiply(kind: ModuleType, factors: Mapping[str, Any]) -> ModuleType:
    """The type with factors on its numbers; factors on quantities that it lacks have no effect."""
    water = {name: factor for name, factor in factors.items() if name not in MODULE_FACTORS}
    mass, thrust, speed, effort = (factors.get(name, 1.0) for name in MODULE_FACTORS)

    def part(one: Part) -> Part:
        before = dict(one.factors)
        both = {k: multiply_factors(f, before.get(k, 1.0)) for k, f in water.items()}
        return replace(
            one,
            factors=tuple((before | both).items()),
            mass=mass * one.mass,
            ballast_mass=mass * one.ballast_mass,
            thruster=one.thruster and one.thruster.scaled(thrust),
        )

    hinge = kind.hinge
    if hinge is not None:
        hinge = replace(hinge, speed=speed * hinge.speed, effort=effort * hinge.effort)
    return replace(kind, parts=tuple(map(part, kind.parts)), hinge=hinge)


def multiply_factors(one: object, other: object) -> Any:
    """The product of two factors, each a number or three along the part's axes."""
    wide = [x if isinstance(x, tuple | list) else [x] * 3 for x in (one, other)]
    found = [a * b for a, b in zip(*wide, strict=True)]
    return found if isinstance(one, tuple | list) or isinstance(other, tuple | list) else found[0]


def _change_thruster(thruster: Thruster, params: Mapping[str, Any]) -> Thruster:
    """The thruster with its own numbers, then its curve scaled to a thrust [N]."""
    own = params.get("thruster", {})
    if own.get("curve", thruster.curve) != thruster.curve:  # another one has numbers of its own
        kept = ("axis", "position", "range", "time_constant", "torque_ratio")
        thruster = Thruster(**{name: getattr(thruster, name) for name in kept} | own)
    else:
        thruster = replace(thruster, **own)
    if "thrust" not in params:
        return thruster
    ahead = thruster.range[1]
    full = thruster.thrust_at(ahead)
    if full <= 0.0:
        raise InputError(
            f"thrust: expected a thruster that pushes at its highest command {ahead:g}; found "
            f"{full:g} N there"
        )
    return thruster.scaled(params["thrust"] / full)
