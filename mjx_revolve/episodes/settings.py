"""Base classes of a configuration's sections: checks, and the settings that name files."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from inspect import isclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from pydantic import BaseModel, ConfigDict, Field

from mjx_revolve.body.coefficients import read_morphology_files
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import read_file, resolve_inside
from mjx_revolve.inputs.schema import ConstraintError
from mjx_revolve.inputs.trust import audit
from mjx_revolve.inputs.user_code import parse_user_function, short_name
from mjx_revolve.water.world import read_world_files

# --- files ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class File:
    """Metadata of `Annotated` for settings that hold paths of files.

    Attributes:
        kind: of file. A `world` may also be a name, or a mapping with `name` and `current_field`;
            `code` is a name or FILE.py:FUNCTION; in `data`, a user's own parameters, only absolute
            paths of files count.
    """

    kind: Literal["morphology", "modules", "world", "code", "data"]


class NamedFile(NamedTuple):
    """A file that a setting names.

    Attributes:
        place: the setting's dotted name.
        kind: see `File`; `field` for the current field of a world's mapping.
        path: the file.
        function: of code, the function in it; else "".
    """

    place: str
    kind: str
    path: str
    function: str = ""

    def at(self, path: str | Path) -> str:
        """The setting's text if the file were at another path."""
        return f"{path}:{self.function}" if self.function else str(path)

    @property
    def text(self) -> str:
        """The setting's text."""
        return self.at(self.path)

    def contents(self) -> dict[str, bytes]:
        """Contents of the file, and of those that it names, by paths relative to its folder.

        Raises:
            InputError: one cannot be read.
        """
        if self.kind == "world":
            return read_world_files(self.path)
        if self.kind == "morphology":
            return read_morphology_files(self.path)
        content = read_file(self.path)
        if self.kind == "data":  # others are audited where they are used
            audit(self.path, "data", content)
        return {Path(self.path).name: content}

    def digest(self) -> str:
        """SHA-256 of what `contents` has, whatever the files are called."""
        parts = [hashlib.sha256(content).digest() for content in self.contents().values()]
        return hashlib.sha256(b"".join(parts)).hexdigest()


Change = Callable[[NamedFile], object]


def map_files(
    settings: Mapping[str, object], change: Change, model: type[BaseModel], within: str = ""
) -> dict[str, Any]:
    """Replaces the texts of all settings that name files.

    Args:
        settings: nested plain values, checked or not; they stay as they are.
        change: file → the new value of the setting.
        model: the section; its annotations mark the settings that name files.
        within: the dotted name of the section, with a dot.

    Returns:
        The nested values.
    """
    found = dict(settings)
    for name, field in model.model_fields.items():
        value, place = found.get(name), f"{within}{name}"
        mark = next((mark for mark in field.metadata if isinstance(mark, File)), None)
        kinds = field.annotation, *get_args(field.annotation)  # of a union, its members
        section = next((x for x in kinds if isclass(x) and issubclass(x, BaseModel)), None)
        if mark is not None:
            if name in found:
                found[name] = _map_value(mark.kind, place, value, change)
        elif section is not None and isinstance(value, Mapping):
            found[name] = map_files(value, change, section, f"{place}.")
    return found


def _map_value(kind: str, place: str, value: object, change: Change) -> object:
    if isinstance(value, Mapping):
        paths = {key: f"{place}.{key}" for key in value}
        if kind == "world":
            paths = {key: paths[key] for key in ("name", "current_field") if key in value}
        return {
            key: _map_value(kind, paths[key], item, change) if key in paths else item
            for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        items = (_map_value(kind, f"{place}.{k}", item, change) for k, item in enumerate(value))
        return type(value)(items)
    if not isinstance(value, str) or not value:
        return value
    if kind == "code":
        own = parse_user_function(value)
        return value if own is None else change(NamedFile(place, kind, own.path, own.function))
    if kind == "data" and not (os.path.isabs(value) and os.path.isfile(value)):
        return value
    if kind == "world" and place.endswith(".current_field"):
        if value == "off":
            return value
        kind = "field"
    elif kind == "world" and not _is_path(value):
        return value
    return change(NamedFile(place, kind, value))


def _is_path(world: str) -> bool:
    """Whether a world is given as a file rather than by name."""
    return world.endswith((".yaml", ".yml")) or "/" in world or os.sep in world


def copy_files(
    settings: Mapping[str, object], model: type[BaseModel]
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """All files that settings name, so that they can be moved together with the settings.

    Args:
        settings: nested plain values, with absolute paths.
        model: as for `map_files`.

    Returns:
        The settings with relative paths, below `inputs/`; the contents of the files by these paths.
        Files keep their names, as robots and worlds may be named after them.

    Raises:
        InputError: a file cannot be read.
    """
    copies: dict[str, bytes] = {}
    names: dict[str, str] = {}

    def name(file: NamedFile) -> str:
        if file.path not in names:
            found = file.contents()
            taken = {path.casefold() for path in copies}
            folders = itertools.chain(["inputs"], (f"inputs/{k}" for k in itertools.count(2)))
            folder = next(
                x for x in folders if taken.isdisjoint(f"{x}/{path}".casefold() for path in found)
            )
            copies.update({f"{folder}/{path}": content for path, content in found.items()})
            names[file.path] = f"{folder}/{Path(file.path).name}"
        return file.at(names[file.path])

    return map_files(settings, name, model), copies


def locate_files(settings: object, places: Mapping[str, Path]) -> Any:
    """Settings in which files have other paths.

    Args:
        settings: nested plain values; they stay as they are.
        places: the new paths by the old ones, as from `copy_files`.
    """
    if isinstance(settings, Mapping):
        return {key: locate_files(value, places) for key, value in settings.items()}
    if isinstance(settings, list | tuple):
        return [locate_files(value, places) for value in settings]
    own = parse_user_function(settings)
    path = own.path if own else settings
    if not isinstance(path, str) or path not in places:
        return settings
    return f"{places[path]}:{own.function}" if own else str(places[path])


def find_copies(folder: Path) -> dict[str, Path]:
    """The copies of files that a run folder holds, by relative paths.

    Args:
        folder: the run folder. Its `run.json` lists them with their SHA-256; those of older runs
            list none.

    Raises:
        InputError: a copy is no longer what the run began with.
    """
    try:
        listed = json.loads(read_file(folder / "run.json")).get("inputs", {})
    except (InputError, OSError, ValueError, RecursionError, AttributeError):
        return {}  # reported by the reader of the other fields
    found = {}
    for name, digest in listed.items() if isinstance(listed, dict) else ():
        path = resolve_inside(name, folder)
        # A missing one is reported where it is used.
        if path.is_file() and hashlib.sha256(read_file(path)).hexdigest() != digest:
            raise InputError(folder / name, "the file that the run began with", "it changed")
        found[name] = folder / name
    return found


# --- sections -------------------------------------------------------------------------------------


def one_of(names: Iterable[str]) -> Any:
    """A name of ours or a function in a user's own file, as `Annotated` takes it."""
    return Field(
        pattern=rf"^({'|'.join(names)}|.+\.py:[^\W\d]\w*)$",
        description=f"one of {', '.join(names)}, or FILE.py:FUNCTION",
    )


class Settings(BaseModel):
    """A frozen section, checked when it is made."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, validate_default=True
    )

    def __repr_args__(self) -> Any:
        """Only values that differ from the defaults."""
        usual = {name: field.default for name, field in type(self).model_fields.items()}
        return [(k, v) for k, v in super().__repr_args__() if k not in usual or usual[k] != v]


class Section(Settings):
    """A section with a `type`: one of the package's, or a function in a user's own file."""

    type: str

    @property
    def name(self) -> str:
        """The type, or the name of the user's own function; for titles."""
        return short_name(self.type)

    @property
    def is_user_code(self) -> bool:
        """Whether the type is a function in a user's own file."""
        return parse_user_function(self.type) is not None

    def refuse_params(self, params: Mapping[str, object]) -> None:
        """Raises `ConstraintError` for `params` of a type that is one of ours."""
        if params and not self.is_user_code:
            none = "none, as only own functions take them"
            raise ConstraintError("params", none, ", ".join(params))
