"""Values that replace those of a file: typed as `KEY.PATH=VALUE`, or given by dotted keys."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.yaml_reader import SafeLoader


def copy_plain(value: object) -> Any:
    """A deep copy of plain YAML values; tuples (from code) become lists."""
    if isinstance(value, Mapping):
        return {key: copy_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [copy_plain(item) for item in value]
    return value


def read_overrides(overrides: Mapping[str, object] | Sequence[str]) -> tuple[dict[str, Any], str]:
    """Values by dotted key, and the label of messages about them.

    Args:
        overrides: a mapping of dotted keys, or texts like `task.duration=5` with a YAML value.

    Raises:
        InputError: a text is no `KEY.PATH=VALUE`.
    """
    if isinstance(overrides, Mapping):
        return {str(key): copy_plain(value) for key, value in overrides.items()}, "override"
    parsed: dict[str, Any] = {}
    for setting in overrides:
        key, equals, text = setting.partition("=")
        key = key.strip()
        if not equals or not key or not all(key.split(".")):
            raise InputError(f"--set {setting}", "KEY.PATH=VALUE", show(setting))
        try:
            # The same reader as for files, so that 1e-3 is a number here too.
            parsed[key] = yaml.load(text, Loader=SafeLoader)
        except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
            reason = getattr(error, "problem", None) or str(error).splitlines()[0]
            raise InputError(f"--set {key}: expected a YAML value; found: {reason}") from None
    return parsed, "--set"


def merge_override(
    data: dict[str, Any], key: str, value: object, label: str, named: Sequence[str] = ()
) -> None:
    """Sets one dotted key of nested mappings, in place; a mapping is merged into a mapping.

    Args:
        data: nested mappings.
        key: dotted.
        value: its new value.
        label: of overrides in messages.
        named: sections that may be given as a name alone, which is then their key `name`.

    Raises:
        InputError: the key leads into something that is no mapping.
    """
    *sections, leaf = key.split(".")
    here = data
    for depth, section in enumerate(sections):
        inner = here.get(section)
        if inner is None:
            inner = {}
        elif depth == 0 and section in named and isinstance(inner, str):
            inner = {"name": inner}
        elif not isinstance(inner, dict):
            place = ".".join(sections[: depth + 1])
            raise InputError(f"{label} {key}", f"{place} to be a mapping", show(inner))
        here[section] = inner
        here = inner
    if isinstance(value, Mapping) and isinstance(here.get(leaf), dict):
        for inner_key, inner_value in value.items():
            merge_override(here[leaf], str(inner_key), inner_value, label)
    else:
        here[leaf] = copy_plain(value)


def sets(overrides: Mapping[str, object], place: str) -> bool:
    """Whether overrides, by dotted key, set what is at a dotted place, or something in it."""
    for key, value in overrides.items():
        if f"{key}.".startswith(f"{place}."):
            return True
        if place.startswith(f"{key}."):
            steps = place.removeprefix(f"{key}.").split(".")
            while steps and isinstance(value, Mapping) and steps[0] in value:
                value = value[steps.pop(0)]
            if not steps or not isinstance(value, Mapping):
                return True
    return False
