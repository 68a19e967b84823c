"""Coefficients fitted to a real robot, in a YAML file that morphologies and configurations name.

    modules:
      all: {factors: {drag: 1.31, added_mass: 0.87}}    # of every module
      Core: {factors: {drag_coefficient: [1, 0.8, 1]}}  # of a type
      left_hip: {factors: {servo_speed: 0.9}}           # of one module; in morphologies only

Each entry is a module's `params` (`morphology.make_morphology`); factors of several entries
multiply. `python -m mjx_revolve.fit` writes such files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.params import apply_overrides, check_overrides, multiply_factors
from mjx_revolve.body.placement import Module
from mjx_revolve.inputs.errors import InputError, reading
from mjx_revolve.inputs.files import path_inside, read_file
from mjx_revolve.inputs.schema import checked, read, show
from mjx_revolve.inputs.yaml_reader import dump_yaml, load_yaml, parse_yaml

ALL = "all"
Entries = Mapping[str, Mapping[str, Any]]


@checked
class _File:
    """A file of coefficients."""

    modules: dict[Any, dict[Any, Any]]


def load_coefficients(path: str | Path) -> dict[str, dict[str, Any]]:
    """Reads a file of coefficients.

    Returns:
        Params by type of module, name of a module, or `all`.

    Raises:
        InputError: the file is wrong; the message says where.
    """
    data = load_yaml(path)
    with reading(path):
        entries = read(_File, data).modules
        if len(names := [*map(str, entries)]) > len({*names}):
            raise InputError("modules", "each name once", show(names))
        return {str(k): check_overrides(v, f"modules.{k}") for k, v in entries.items()}


def correct_types(
    modules: Mapping[str, ModuleType], entries: Entries, source: str
) -> dict[str, ModuleType]:
    """The catalogue with coefficients in its types.

    Raises:
        InputError: an entry is of no type.
    """
    for name in entries:
        if name != ALL and name not in modules:
            raise InputError(
                f"{source}: modules.{name}: expected `all` or a type ({', '.join(modules)}), or "
                "the file named in a morphology, which has modules by name; found neither"
            )

    def correct(kind: ModuleType) -> ModuleType:
        for name in (ALL, kind.name, *kind.aliases):
            with reading(f"{source}: modules.{name}"):
                kind = apply_overrides(kind, _suited(entries.get(name, {}), kind))
        return kind

    return {name: correct(kind) for name, kind in modules.items()}


def correct_modules(tree: tuple[Module, ...], entries: Entries, source: str) -> tuple[Module, ...]:
    """Modules with coefficients, which their `params` keep.

    Raises:
        InputError: an entry is of no module.
    """
    known = {ALL, *(name for m in tree for name in (m.type, *m.kind.aliases, m.name))}
    for name in entries:
        if name not in known:
            raise InputError(
                f"{source}: modules.{name}: expected `all`, a type or a module of this robot "
                f"({', '.join(sorted(known - {ALL}))}); found none of this name"
            )
    return tuple(_correct(module, entries, source) for module in tree)


def _correct(module: Module, entries: Entries, source: str) -> Module:
    kind, params = module.base or module.kind, dict(module.params)
    # A module may be named after its type.
    for name in dict.fromkeys((ALL, module.type, *kind.aliases, module.name)):
        entry = _suited(entries.get(name, {}), kind)
        if not entry:
            continue
        ballast, placed = params.get("ballast", 0.0), "ballast_position" in params
        if ballast and "ballast" in entry and placed != ("ballast_position" in entry):
            raise InputError(
                f"{source}: modules.{name}.ballast: expected none, as {module.name} has its own "
                f"{'in' if placed else 'without'} a place of its own; found {entry['ballast']:g}"
            )
        params = merge_params(params, entry)
        if "ballast" in entry and not placed:  # which adds to the mass; a placed one replaces
            params["ballast"] += ballast
    if params == module.params:
        return module
    # Of the type and all params at once, as the saved robot is read.
    with reading(f"{source}: {module.name}"):
        return replace(module, kind=apply_overrides(kind, params), params=params, base=kind)


def merge_params(params: Mapping[str, Any], entry: Mapping[str, Any]) -> dict[str, Any]:
    """Params of a module with further ones: factors multiply, numbers of laws and thrusters join.

    Of a thruster with another curve, all numbers are the further ones.
    """
    found = dict(params) | dict(entry)
    for key in ("thruster", "lift_drag"):
        old, new = params.get(key, {}), entry.get(key, {})
        if old and new and new.get("curve", old.get("curve")) == old.get("curve"):
            found[key] = old | new
    if "coefficients" in found:
        laws = {**params.get("coefficients", {}), **found["coefficients"]}
        found |= check_overrides({"coefficients": laws}, "params")
    before, more = params.get("factors", {}), entry.get("factors", {})
    if before or more:
        both = {k: multiply_factors(x, before.get(k, 1.0)) for k, x in more.items()}
        # In the order in which they are read.
        found |= check_overrides({"factors": before | both}, "params")
    return found


def _suited(entry: Mapping[str, object], kind: ModuleType) -> dict[str, Any]:
    """An entry without the coefficients of thrusters, if the type has no thruster."""
    thruster = kind.is_thruster
    return {k: v for k, v in entry.items() if thruster or k not in ("thruster", "thrust")}


def read_morphology_files(path: str | Path) -> dict[str, bytes]:
    """A morphology's file, and the coefficients that it names, by paths relative to its folder.

    Coefficients that lie elsewhere are put beside the file, which then names them there.

    Raises:
        InputError: one cannot be read.
    """
    path = Path(path)
    found = {path.name: read_file(path)}
    data = parse_yaml(found[path.name], path)
    named = data.get("coefficients") if isinstance(data, dict) else None
    if not isinstance(named, str) or not named:
        return found
    content, beside = read_file(path.parent / named), path_inside(named)
    if beside != Path(named).as_posix():
        beside = beside if beside != path.name else f"coefficients_{beside}"
        data["coefficients"] = beside
        found[path.name] = dump_yaml(data).encode()
    return found | {beside: content}
