"""Grids of settings: `KEY.PATH=VALUE,VALUE,...` for each axis, and all their combinations.

Values are YAML, those between brackets or quotes may hold commas: `world.current=[0,0,0],[0.1,0,0]`
has two.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.overrides import read_overrides
from mjx_revolve.inputs.yaml_reader import SafeLoader

_MAX_NAME = 80  # of a case's name, which is that of a folder [characters]
MOST_SEEDS = 10_000
"""Runs of one case at most (a choice)."""
_MAX_CASES = 1000  # cases in a grid; a typing error easily has a million (a choice)


class GridAxis(NamedTuple):
    """A setting and its values.

    Attributes:
        key: dotted.
        texts: the values as they were typed, YAML.
    """

    key: str
    texts: tuple[str, ...]


def split_values(text: str, label: str) -> list[str]:
    """The values of a YAML list without its brackets, as they were typed.

    Args:
        text: values with commas between them.
        label: of messages.

    Raises:
        InputError: it is no such list, or there is nothing between two commas.
    """
    if "," not in text:
        return [text.strip()]
    listed = f"[{text}\n]"
    try:
        node = yaml.compose(listed, Loader=SafeLoader)
    except (yaml.YAMLError, InputError, RecursionError):
        node = None
    values = []
    if node is not None and node.value:
        values = [listed[one.start_mark.index : one.end_mark.index] for one in node.value]
        # Neither a comma nor a comment nor another list may follow.
        values = values if not listed[node.value[-1].end_mark.index : -1].strip() else []
    if not values:
        raise InputError(label, "YAML values between commas", show(text))
    return [value.strip() for value in values]


def read_axes(settings: Sequence[str]) -> list[GridAxis]:
    """Reads what was typed as `--set`, `KEY.PATH=VALUE,VALUE,...` each; an axis may have one value.

    Raises:
        InputError: a text is no such setting, or a setting or a value is there twice.
    """
    axes: dict[str, GridAxis] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        key = key.strip()
        if not equals:
            read_overrides([setting])  # which raises the error
        if key in axes:
            once = "each setting once, with commas between its values"
            raise InputError(f"--set {key}", once, "it twice")
        texts = split_values(text, f"--set {key}")
        values: list[Any] = []
        for one in texts:
            (value,) = read_overrides([f"{key}={one}"])[0].values()
            # Python takes 1 for True.
            if any(value == x and isinstance(value, bool) == isinstance(x, bool) for x in values):
                raise InputError(f"--set {key}", "each value once", f"{show(one)} twice")
            values.append(value)
        axes[key] = GridAxis(key, tuple(texts))
    return list(axes.values())


def combine(axes: Sequence[GridAxis], otherwise: str) -> dict[str, tuple[str, ...]]:
    """All combinations of the axes' values, by name.

    Args:
        axes: of the grid; the last one changes fastest.
        otherwise: the name if there is one combination only.

    Returns:
        Settings, `KEY.PATH=VALUE` each, by a name that a folder may have: the values in which
        they differ, `morphology=spider+duration=5`.

    Raises:
        InputError: there are too many.
    """
    count = math.prod(len(axis.texts) for axis in axes)
    if count > _MAX_CASES:
        raise InputError("--set", f"at most {_MAX_CASES} combinations", count)
    several = [axis.key for axis in axes if len(axis.texts) > 1]
    leaves = [key.rpartition(".")[2] for key in several]
    pairs = zip(several, leaves, strict=True)
    words = [key if leaves.count(leaf) > 1 else leaf for key, leaf in pairs]
    cases: dict[str, tuple[str, ...]] = {}
    for texts in itertools.product(*(axis.texts for axis in axes)):
        values = {axis.key: text for axis, text in zip(axes, texts, strict=True)}
        settings = tuple(f"{key}={text}" for key, text in values.items())
        named = zip(words, several, strict=True)
        name = _plain("+".join(f"{a}={_short(values[b])}" for a, b in named) or otherwise)
        if len(name) > _MAX_NAME or name.casefold() in map(str.casefold, cases):
            digest = hashlib.sha256("\0".join(settings).encode()).hexdigest()[:8]
            name = f"{name[: _MAX_NAME - 9]}-{digest}"
        cases[name] = settings
    return cases


def _short(text: str) -> str:
    """A value as part of a case's name: of a path, the file's name."""
    text = text.strip("'\"")
    path = Path(text)
    return path.stem if path.suffix.lower() in (".yaml", ".yml") else text


def _plain(name: str) -> str:
    """A name without characters that are special in file systems, shells or HTML.

    It begins with a letter or digit, so it is neither a hidden file nor an option.
    """
    return re.sub(r"[^\w.=+-]+", "_", name, flags=re.ASCII).lstrip("_.-+=") or "case"
