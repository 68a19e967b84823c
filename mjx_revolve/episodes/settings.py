"""What all sections of a configuration share: checking, and which of their values name files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from mjx_revolve.inputs.schema import ConstraintError
from mjx_revolve.inputs.user_code import parse_user_function, short_name

# --- files ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class File:
    """Marks a setting, as metadata of `Annotated`, whose texts are paths of files.

    Attributes:
        kind: what the files are. `world` also marks names, and a mapping's `name` and
            `current_field`; `code` marks names and FILE.py:FUNCTION; `data` marks the user's own
            parameters, of which only absolute paths of files count.
    """

    kind: Literal["morphology", "modules", "world", "code", "data"]


class NamedFile(NamedTuple):
    """A file that a setting names.

    Attributes:
        place: the setting's dotted name.
        kind: see `File`.
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

    @property
    def bundled(self) -> bool:
        """Whether the file can be copied alone; a world or modules file may refer to others."""
        return self.kind not in ("modules", "world")


Change = Callable[[NamedFile], Any]


def map_files(
    settings: Mapping[str, Any], change: Change, model: type[BaseModel], within: str = ""
) -> dict[str, Any]:
    """Replaces the texts of all settings that name files.

    Args:
        settings: nested plain values, checked or not; they stay as they are.
        change: file → what the setting becomes.
        model: the section whose annotations say which settings name files.
        within: the dotted name of the section, with a dot.

    Returns:
        The nested values.
    """
    found = dict(settings)
    for name, field in model.model_fields.items():
        value, place = found.get(name), f"{within}{name}"
        mark = next((mark for mark in field.metadata if isinstance(mark, File)), None)
        section = next((kind for kind in _kinds(field.annotation) if _is_section(kind)), None)
        if mark is not None:
            if name in found:
                found[name] = _map_value(mark.kind, place, value, change)
        elif section is not None and isinstance(value, Mapping):
            found[name] = map_files(value, change, section, f"{place}.")
    return found


def _kinds(annotation: Any) -> tuple[Any, ...]:
    """A type, or the members of a union."""
    return annotation, *getattr(annotation, "__args__", ())


def _is_section(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _map_value(kind: str, place: str, value: Any, change: Change) -> Any:
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
    if kind == "world" and not (place.endswith(".current_field") or _is_path(value)):
        return value
    return change(NamedFile(place, kind, value))


def _is_path(world: str) -> bool:
    """Whether a world is given as a file rather than by name."""
    return world.endswith((".yaml", ".yml")) or "/" in world or os.sep in world


# --- sections -------------------------------------------------------------------------------------


def one_of(names: Iterable[str]) -> Any:
    """A name of ours or a function in a user's own file, as `Annotated` takes it."""
    return Field(
        pattern=rf"^({'|'.join(names)}|.+\.py:[^\W\d]\w*)$",
        description=f"one of {', '.join(names)}, or FILE.py:FUNCTION",
    )


class Settings(BaseModel):
    """Checked when it is made, and frozen."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, validate_default=True
    )

    def __repr_args__(self) -> Any:
        """Only values that differ from the defaults."""
        usual = {name: field.default for name, field in type(self).model_fields.items()}
        return [(k, v) for k, v in super().__repr_args__() if k not in usual or usual[k] != v]


class Section(Settings):
    """A section whose `type` is one of ours, or a function in a user's own file."""

    type: str

    @property
    def name(self) -> str:
        """The type, or the name of the user's own function; for titles."""
        return short_name(self.type)

    @property
    def is_user_code(self) -> bool:
        """Whether the type is a function in a user's own file."""
        return parse_user_function(self.type) is not None

    def refuse_params(self, params: Mapping[str, Any]) -> None:
        """Raises `ConstraintError` for `params` of a type that is one of ours."""
        if params and not self.is_user_code:
            raise ConstraintError(
                "params", "none, as only own functions take them", ", ".join(params)
            )
