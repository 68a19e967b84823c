"""Grids of settings: `KEY.PATH=VALUE,VALUE,...` for each axis, and all their combinations.

A comma separates values where it stands outside of brackets and quotes; a value is YAML, as in
`overrides.py`, so that `world.current=[0,0,0],[0.1,0,0]` has two values.
"""

from __future__ import annotations

import hashlib
import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.overrides import read_overrides

_CLOSING = {"[": "]", "{": "}"}
_LONGEST = 80  # of a case's name, which is that of a folder [characters]
MOST_SEEDS = 10_000
"""Runs of one case at most (a choice)."""
_MOST = 1000  # cases in a grid: more than anybody has run; a typing error has a million (a choice)


class Axis(NamedTuple):
    """A setting and the values that it takes.

    Attributes:
        key: dotted.
        texts: its values as they were typed, YAML.
    """

    key: str
    texts: tuple[str, ...]


def split_values(text: str, label: str) -> list[str]:
    """Cuts a text at the commas outside of brackets and quotes.

    Args:
        text: YAML values with commas between them.
        label: what messages call it.

    Returns:
        The values, without the blanks around them.

    Raises:
        InputError: a bracket or a quote does not close, or there is nothing between two commas.
    """
    values, open_brackets = [""], ""
    quote, escaped, before = "", False, ","  # `before`: the last character that is no blank
    for mark in text:
        if quote:
            if escaped:
                escaped = False
            elif mark == quote:
                quote = ""
            else:
                escaped = quote == '"' and mark == "\\"
            values[-1] += mark
            before = mark
            continue
        # An apostrophe within a word opens nothing; after `'` it is YAML's way to write one.
        if mark in "'\"" and (before in ",[{:" or before == mark == "'"):
            quote = mark
        elif mark in _CLOSING:
            open_brackets += _CLOSING[mark]
        elif mark in "]}":
            if not open_brackets.endswith(mark):
                raise InputError(f"{label}: expected brackets in pairs; found {show(text)}")
            open_brackets = open_brackets[:-1]
        elif mark == "," and not open_brackets:
            values.append("")
            before = mark
            continue
        values[-1] += mark
        before = before if mark.isspace() else mark
    if quote or open_brackets:
        what = "a quote" if quote else "a bracket"
        raise InputError(f"{label}: expected {what} to be closed; found {show(text)}")
    values = [value.strip() for value in values]
    if len(values) > 1 and not all(values):
        raise InputError(f"{label}: expected a value between commas; found none in {show(text)}")
    return values


def read_axes(settings: Sequence[str]) -> list[Axis]:
    """Reads what was typed as `--set`.

    Args:
        settings: `KEY.PATH=VALUE,VALUE,...` each.

    Returns:
        An axis for each setting, also for those of one value.

    Raises:
        InputError: a text is no such setting, or a setting or a value is there twice.
    """
    axes: dict[str, Axis] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        key = key.strip()
        if not equals:
            read_overrides([setting])  # which says what is wrong
        if key in axes:
            raise InputError(
                f"--set {key}: expected each setting once, with commas between its values; found "
                "it twice"
            )
        texts = split_values(text, f"--set {key}")
        values: list[Any] = []
        for one in texts:
            (value,) = read_overrides([f"{key}={one}"])[0].values()
            if any(_same(value, other) for other in values):
                raise InputError(f"--set {key}: expected each value once; found {show(one)} twice")
            values.append(value)
        axes[key] = Axis(key, tuple(texts))
    return list(axes.values())


def _same(value: Any, other: Any) -> bool:
    """Whether two values are; Python takes 1 for True."""
    return value == other and isinstance(value, bool) == isinstance(other, bool)


def combine(axes: Sequence[Axis], otherwise: str) -> dict[str, tuple[str, ...]]:
    """All combinations of an axis's value with those of the others.

    Args:
        axes: of the grid.
        otherwise: the name where there is one combination only.

    Returns:
        Settings, `KEY.PATH=VALUE` each, by a name that a folder may have: the values in which
        they differ, `morphology=spider+duration=5`. The last axis changes fastest.

    Raises:
        InputError: there are too many.
    """
    count = 1
    for axis in axes:
        count *= len(axis.texts)
    if count > _MOST:
        raise InputError(f"--set: expected at most {_MOST} combinations; found {count}")
    several = [axis for axis in axes if len(axis.texts) > 1]
    leaves = [axis.key.rpartition(".")[2] for axis in several]
    words = [
        axis.key if leaves.count(leaf) > 1 else leaf
        for axis, leaf in zip(several, leaves, strict=True)
    ]
    cases: dict[str, tuple[str, ...]] = {}
    for texts in itertools.product(*(axis.texts for axis in axes)):
        settings = tuple(f"{axis.key}={text}" for axis, text in zip(axes, texts, strict=True))
        differing = [text for axis, text in zip(axes, texts, strict=True) if len(axis.texts) > 1]
        name = "+".join(f"{a}={_short(b)}" for a, b in zip(words, differing, strict=True))
        name = _plain(name or otherwise)
        if len(name) > _LONGEST or name.casefold() in map(str.casefold, cases):
            digest = hashlib.sha256("\0".join(settings).encode()).hexdigest()[:8]
            name = f"{name[: _LONGEST - 9]}-{digest}"
        cases[name] = settings
    return cases


def _short(text: str) -> str:
    """A value as a name has it: of a path what the file is called."""
    text = text.strip("'\"")
    path = Path(text)
    return path.stem if path.suffix.lower() in (".yaml", ".yml") else text


def _plain(name: str) -> str:
    """A name that every file system takes, and that no shell and no page reads as something else.

    It begins with a letter or digit, so it is neither hidden nor an option.
    """
    return re.sub(r"[^\w.=+-]+", "_", name, flags=re.ASCII).lstrip("_.-+=") or "case"
