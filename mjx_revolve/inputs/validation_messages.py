"""Pydantic's errors as one line that names place, expected and found."""

from __future__ import annotations

import dataclasses
import difflib
import re
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import DocInfo, Ge, Gt, Le, Lt, Unit, doc
from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from mjx_revolve.inputs.errors import ConstraintError, InputError, show

Step = str | int  # of a dotted place: a key or an index


def refuse(problems: Mapping[str, str], origin: Callable[[str], str] = lambda _: "") -> InputError:
    """All problems as one error: the first in full, and the places of the others.

    Args:
        problems: by place, from `find_problems`.
        origin: place → the file or other source it was read from.
    """
    (place, text), *others = problems.items()
    line = ": ".join(part for part in (place, text) if part)
    more = f" (also wrong or missing: {', '.join(at for at, _ in others)})" if others else ""
    return InputError(f"{origin(place)}{line}{more}")


# The longest list of names before a suggestion [characters].
_MAX_NAMES = 100
# Pydantic's error types for a key that is no field of a model or of a dataclass.
_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")


def find_problems(error: ValidationError, kind: object, data: object) -> dict[str, str]:
    """Pydantic's errors as "expected X; found Y" by place, the first of each.

    Args:
        error: from pydantic.
        kind: the type that was expected.
        data: what was given.
    """
    problems: dict[str, str] = {}
    # Unknown keys first: they may be the missing ones, misspelt.
    strange = (*_UNKNOWN, "invalid_key")
    found = error.errors(include_url=False)
    for item in sorted(found, key=lambda item: item["type"] not in strange):
        place, text = _problem(item, kind, data)
        problems.setdefault(place, text)
    return problems


def _problem(error: ErrorDetails, kind: object, data: Any) -> tuple[str, str]:
    """The place of an error, and "expected X; found Y"."""
    steps = list(error["loc"])
    names = list(fields_of(kind))
    if steps and isinstance(steps[0], int) and steps[0] < len(names) and steps[0] not in data:
        steps[0] = names[steps[0]]  # an argument without its name
    place = join(*steps)
    if error["type"] == "value_error":
        reason = error["ctx"]["error"]
        if isinstance(reason, ConstraintError):
            return join(place, reason.place), f"expected {reason.expected}; found {reason.found}"
        return place, str(reason)
    if error["type"] == "invalid_key":
        return place, "expected the name of a setting; found a key that is no text"
    if error["type"] in _UNKNOWN:
        _, annotation = _follow(kind, steps[:-1])
        known = list(fields_of(_open(annotation)[0]))
        hint = _suggest(str(steps[-1]), known, steps[:-1], kind)
        listed = ", ".join(known)
        if hint and len(listed) > _MAX_NAMES:
            listed = f"{len(known)} keys"
        return place, f"expected one of {listed}; found an unknown key{hint}"
    missing = error["type"] == "missing"
    if missing and isinstance(steps[-1], int):  # a vector that is too short: all of it
        missing = False
        steps.pop()
    if steps and steps[-1] == "[key]":
        taken, annotation = _follow(kind, steps[:-2])
        found, annotation = steps[-2], get_args(_open(annotation)[0])[0]
    else:
        taken, annotation = _follow(kind, steps)
        taken, found = _look_up(data, taken, error["input"])
    text = "none" if missing and len(taken) == len(steps) else show(found)
    return join(*taken), f"expected {describe(annotation)}; found {text}"


def join(*steps: object) -> str:
    """A dotted place from its steps, without empty ones."""
    return ".".join(str(step) for step in steps if step != "")


def _look_up(data: Any, steps: list[Step], otherwise: object) -> tuple[list[Step], Any]:
    """The value at a place; the place ends early where a short form stands for the whole."""
    for i, step in enumerate(steps):
        # One number for several.
        if isinstance(data, int | float) or getattr(data, "shape", None) == ():
            return steps[:i], data
        try:
            data = data[step]
        except (TypeError, KeyError, IndexError):
            return steps, otherwise
    return steps, data


# --- what annotations say, in words ---------------------------------------------------------------


def fields_of(kind: object) -> dict[str, FieldInfo]:
    """The fields of a checked class or a model by name; empty for other types."""
    return getattr(kind, "model_fields", None) or getattr(kind, "__pydantic_fields__", {})


def _open(annotation: object) -> tuple[Any, list[Any], bool]:
    """A type itself, its metadata (outer ones last), and whether it may be None."""
    metadata: list[Any] = []
    optional = False
    while True:
        branches = [x for x in get_args(annotation) if x is not type(None)]
        if get_origin(annotation) is Annotated:
            annotation, *given = get_args(annotation)
            outer: list[Any] = []
            for item in given:
                outer += item.metadata if isinstance(item, FieldInfo) else [item]
                outer += [doc(item.description)] if getattr(item, "description", None) else []
            metadata = outer + metadata
        elif _is_union(annotation) and len(branches) == 1:
            annotation, optional = branches[0], True
        else:
            return annotation, metadata, optional


def _is_union(annotation: object) -> bool:
    return get_origin(annotation) in (Union, types.UnionType)


def _follow(annotation: object, steps: Sequence[Step]) -> tuple[list[Step], Any]:
    """As many steps as can be followed into a type, and the annotation there."""
    taken: list[Step] = []
    for step in steps:
        kind, metadata, _ = _open(annotation)
        fields, arguments = fields_of(kind), get_args(kind)
        found: Any
        if step in fields:
            found = Annotated[(fields[step].annotation, fields[step])]
        elif get_origin(kind) is tuple and isinstance(step, int):
            found = arguments[0 if Ellipsis in arguments else min(step, len(arguments) - 1)]
        elif get_origin(kind) is dict:
            found = arguments[1]
        else:
            break
        # A vector's unit is that of its numbers.
        units = [item for item in metadata if isinstance(item, Unit)]
        annotation = Annotated[(found, *units)] if units else found
        taken.append(step)
    return taken, annotation


def _names(kind: object, prefix: str = "") -> Iterator[str]:
    """All fields' dotted names."""
    for name, field in fields_of(kind).items():
        yield prefix + name
        yield from _names(_open(field.annotation)[0], f"{prefix}{name}.")


def _suggest(name: str, known: Sequence[str], place: Sequence[Step], root: object) -> str:
    """The most similar known name: of a sibling, or of a field in a section of it, or another."""
    section = join(*place) + "."
    every = sorted(_names(root), key=lambda full: full.startswith(section))
    others = {full.rpartition(".")[2]: full for full in every}
    for names in ({key: join(*place, key) for key in known}, others):
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.7)
        if near:
            return f"; did you mean {names[near[0]]}?"
    return ""


_WORDS = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
_COUNTS = {2: "two", 3: "three"}
_SIGNS = {Gt: "> ", Ge: ">= ", Lt: "< ", Le: "<= "}


def describe(annotation: object) -> str:
    """The values of a type in words: "a number > 0 and <= 20 [Hz]"."""
    kind, metadata, optional = _open(annotation)
    said = [item.documentation for item in metadata if isinstance(item, DocInfo)]
    if said:
        return said[-1]
    # The bounds of a vector are those of its numbers.
    numbers = _open(get_args(kind)[0])[1] if get_origin(kind) is tuple else metadata
    bounds = []
    for item in numbers:
        if type(item) in _SIGNS:
            (bound,) = dataclasses.astuple(item)
            bounds.append(_SIGNS[type(item)] + (f"{bound:g}" if bound % 1 else f"{bound:.0f}"))
    units = [f"[{item.unit}]" for item in metadata if isinstance(item, Unit)]
    words = " ".join(part for part in (_name(kind), " and ".join(bounds), *units[-1:]) if part)
    return words + ", or nothing" * optional


def _name(kind: Any) -> str:
    """The kind of value, without bounds and unit."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "one of " + ", ".join(str(argument) for argument in arguments)
    if _is_union(kind):
        return " or ".join(describe(branch) for branch in arguments)
    if origin is tuple:
        one = _name(_open(arguments[0])[0])
        count = "a list of" if Ellipsis in arguments else _COUNTS[len(arguments)]
        plural = re.sub(r"^an? (\w+( number)?)", r"\1s", one)
        return f"{count} {plural}"
    if origin is dict or fields_of(kind):
        required = [name for name, field in fields_of(kind).items() if field.is_required()]
        return "a mapping" + (f" with {', '.join(required)}" if required else "")
    return _WORDS.get(kind, "a value")
