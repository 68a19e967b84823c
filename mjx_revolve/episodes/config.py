"""The configuration of a run: a small YAML file, checked before anything expensive starts.

A file names the robot and the world, and says how the robot is controlled, what it has to do and
how it is evolved. `load_config` reads one, applies overrides, checks every value and resolves the
paths; `dump_config` writes the resolved values back, so that a run folder documents itself.
"""

from __future__ import annotations

import difflib
import math
import os
import types
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    model_validator,
)
from pydantic.fields import FieldInfo

from mjx_revolve.inputs import errors
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.own_code import parse_own, short_name
from mjx_revolve.inputs.shipped import find_shipped


def _as_tuple(value: Any) -> Any:
    """YAML writes vectors as lists; frozen values hold tuples."""
    return tuple(value) if isinstance(value, list) else value


def _check_world(value: str | dict[str, Any]) -> str | dict[str, Any]:
    if isinstance(value, str):
        if not value:
            raise ValueError("a name or a path; found an empty text")
    elif not isinstance(value.get("name"), str) or not value["name"]:
        raise ValueError("a `name` (a world's name or path) beside the overrides; found none")
    return value


_Vector = Annotated[tuple[float, float, float], BeforeValidator(_as_tuple)]
_World = Annotated[str | dict[str, Any], AfterValidator(_check_world)]


def _names(*names: str) -> Any:
    """What `Field` takes for a name of ours or a function in a file of the user's own."""
    return {
        "pattern": rf"^({'|'.join(names)}|.+\.py:[^\W\d]\w*)$",
        "description": f"one of {', '.join(names)}, or FILE.py:FUNCTION",
    }


class _Model(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, validate_default=True
    )


class Section(_Model):
    """A section whose `type` names one of ours, or a function in a file of the user's own."""

    type: str

    @property
    def name(self) -> str:
        """What titles call it: its type, or the name of the user's own function."""
        return short_name(self.type)

    @property
    def is_own(self) -> bool:
        """Whether it is a function in a file of the user's own."""
        return parse_own(self.type) is not None

    def _refuse(self, params: Mapping[str, Any]) -> None:
        if params and not self.is_own:
            raise ValueError(
                f"params: none, as only own functions take them; found {', '.join(params)}"
            )


class ControllerConfig(Section):
    """What turns genes into joint targets."""

    type: str = Field("cpg", **_names("cpg", "sine", "feedback"))
    """`cpg`, `sine`, `feedback`, or FILE.py:FUNCTION, a function like `controllers.make_sine`."""
    max_frequency: float = Field(2.0, gt=0, le=20)
    """The fastest oscillation [Hz]."""
    amplitude: float = Field(1.0, gt=0, le=1)
    """Of each sine at most, as a fraction of the hinge's range, which clips their sum [-]."""
    harmonics: int = Field(1, ge=1, le=8)
    """How many sines add up at each hinge; `type: sine` only [-]."""
    gain: float = Field(2.0, gt=0)
    """Largest answer to an error of normal size, as a share of the range; `type: feedback` [-]."""
    depth: float | None = Field(None, ge=0)
    """Depth that `type: feedback` holds; that of the task's start where none is given [m]."""
    params: dict[str, Any] = {}
    """Settings of a function of the user's own, which reads them as `settings.params`."""

    @model_validator(mode="after")
    def _check(self) -> ControllerConfig:
        self._refuse(self.params)
        if self.type in ("cpg", "feedback") and self.harmonics != 1:
            raise ValueError(f"harmonics: 1, as only type sine has more; found {self.harmonics}")
        return self


class TaskConfig(Section):
    """What the robot is scored for, and how its episodes start."""

    type: str = Field(**_names("directed_swim", "speed", "reach_target", "hold_depth", "crawl"))
    """`directed_swim`, `speed`, `reach_target`, `hold_depth`, `crawl`, or FILE.py:FUNCTION, a
    function like those in `tasks`."""
    duration: float = Field(10.0, gt=0)
    """Length of an episode [s]."""
    settle: float = Field(1.0, ge=0)
    """Time at the start of an episode that does not count [s]."""
    trials: int = Field(2, ge=1)
    """Episodes averaged per individual, each from its own start [-]."""
    direction: _Vector = (1.0, 0.0, 0.0)
    """Where to swim, world frame; the length does not matter [-]."""
    target: _Vector | None = None
    """Where to go, world frame; `reach_target` needs it [m]."""
    depth: float = Field(2.0, ge=0)
    """Depth of the start below the surface; `crawl` starts on the bed instead [m]."""
    depth_tolerance: float = Field(0.25, gt=0)
    """How far from the start depth still counts as keeping it [m]."""
    energy_weight: float = Field(0.0, ge=0)
    """Score lost per joule of joint work [1/J]."""
    start_tilt: float = Field(0.1, ge=0)
    """Standard deviation of the start's roll and pitch [rad]."""
    start_yaw: float = Field(0.0, ge=0)
    """Standard deviation of the start's heading [rad]."""
    start_position: float = Field(0.0, ge=0)
    """Standard deviation of the start's place, along each axis [m]."""
    current_std: float = Field(0.0, ge=0)
    """Standard deviation of an extra horizontal current, drawn for each episode [m/s]."""
    params: dict[str, Any] = {}
    """Settings of a function of the user's own, which reads them as `settings.params`."""

    @model_validator(mode="after")
    def _check(self) -> TaskConfig:
        self._refuse(self.params)
        if self.settle >= self.duration:
            raise ValueError(
                f"settle: a time below task.duration ({self.duration:g} s); found {self.settle:g}"
            )
        if self.type == "reach_target" and self.target is None:
            raise ValueError("target: three numbers, because task.type is reach_target; found none")
        if math.hypot(*self.direction) < 1e-9:
            raise ValueError(f"direction: a vector of some length; found {list(self.direction)}")
        return self


class EvolutionConfig(_Model):
    """How genes are searched for."""

    strategy: str = Field("CMA_ES", min_length=1)
    """Name of an evosax strategy; `mjx_revolve.evolution.strategies.STRATEGIES` lists them."""
    population_size: int = Field(64, ge=4)
    generations: int = Field(60, ge=1)
    seed: int = Field(0, ge=0, lt=2**32)
    std_init: float = Field(0.5, gt=0)
    """Standard deviation of the first population's genes [-]."""
    checkpoint_every: int = Field(5, ge=1)
    """Generations between checkpoints."""
    keep_checkpoints: int = Field(3, ge=1)
    """How many of the newest checkpoints are kept."""
    tensorboard: bool = False
    """Whether the metrics go to RUN/tensorboard/ as well; needs tensorboardX."""
    strategy_params: dict[str, Any] = {}
    """Settings of the strategy itself, by evosax's names."""


class Config(_Model):
    """A whole run. Paths are absolute once it went through `make_config` or `load_config`."""

    morphology: str = Field(min_length=1, description="the path of a morphology YAML")
    """The robot: a morphology YAML."""
    modules: str | None = Field(None, min_length=1, description="the path of a YAML, or nothing")
    """The user's own module types: a YAML, or None."""
    allow_overlap: bool = False
    """Whether modules may overlap."""
    trim: Literal["neutral", "none"] = "none"
    """`neutral` adds to the core the electronics volume that lets it hover."""
    world: _World = Field(description="a world's name or path, or a mapping of name and overrides")
    """A world's name or path, or a mapping of `name` and overrides for `load_world`."""
    engine: Literal["population", "mjx"] = "population"
    """`population` steps the whole population at once; `mjx` is MJX's own step, the reference."""
    controller: ControllerConfig = ControllerConfig()
    task: TaskConfig
    evolution: EvolutionConfig = EvolutionConfig()

    _source: str = PrivateAttr("config")
    _written: dict[str, Any] = PrivateAttr(default_factory=dict)

    @property
    def source(self) -> str:
        """The file this came from, for messages; `config` when made in code."""
        return self._source

    @property
    def written(self) -> dict[str, Any]:
        """The values as they were written, overrides applied, before paths were resolved."""
        return self._written

    @property
    def name(self) -> str:
        """A short name: the file's name without its suffix."""
        return Path(self._source).stem

    @property
    def world_name(self) -> str:
        """The world's name, or the absolute path of its YAML."""
        return self.world if isinstance(self.world, str) else self.world["name"]

    @property
    def world_overrides(self) -> dict[str, Any]:
        """Keyword arguments for `load_world(config.world_name, **config.world_overrides)`."""
        if isinstance(self.world, str):
            return {}
        return {key: value for key, value in self.world.items() if key != "name"}


# --- what the schema says, in words ---------------------------------------------------------------


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation


def _fields(model: type[BaseModel] = Config, prefix: str = "") -> dict[str, FieldInfo]:
    """All fields by dotted name, sections before what they hold."""
    found: dict[str, FieldInfo] = {}
    for name, field in model.model_fields.items():
        found[prefix + name] = field
        for inner in _models(field.annotation):
            found |= _fields(inner, f"{prefix}{name}.")
    return found


def _kind(annotation: Any) -> str:
    """The kind of value a field takes, in words."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _kind(arguments[0])
    if origin is Literal:
        return "one of " + ", ".join(str(argument) for argument in arguments)
    if origin in (Union, types.UnionType):
        return " or ".join(_kind(argument) for argument in arguments)
    if origin is tuple:
        return "three finite numbers"
    if origin is dict or any(True for _ in _models(annotation)):
        return "a mapping"
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    return names.get(annotation, "nothing")


def _expected(field: FieldInfo) -> str:
    """What a field takes, bounds included: "a number > 0 and <= 20"."""
    if field.description:
        return field.description
    bounds = []
    for item in field.metadata:
        if isinstance(item, annotated_types.Gt):
            bounds.append(f"> {item.gt}")
        elif isinstance(item, annotated_types.Ge):
            bounds.append(f">= {item.ge}")
        elif isinstance(item, annotated_types.Lt):
            bounds.append(f"< {item.lt}")
        elif isinstance(item, annotated_types.Le):
            bounds.append(f"<= {item.le}")
    return " ".join([_kind(field.annotation), " and ".join(bounds)]).strip()


def _found(value: Any) -> str:
    if isinstance(value, BaseModel):
        value = value.model_dump()
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _suggestion(place: str) -> str:
    """The name the user may have meant, among all names of the schema."""
    names = list(_fields())
    prefix = place.rpartition(".")[0]
    leaf = place.rpartition(".")[2]
    near = difflib.get_close_matches(place, names, n=1, cutoff=0.75)
    if not near:
        siblings = [name for name in names if name.rpartition(".")[0] == prefix]
        leaves = {name.rpartition(".")[2]: name for name in [*names, *siblings]}
        near = [leaves[hit] for hit in difflib.get_close_matches(leaf, leaves, n=1, cutoff=0.7)]
    return f"; did you mean {near[0]}?" if near else ""


def _look_up(data: Any, parts: Sequence[str]) -> Any:
    """What the user wrote at a place; None where there is nothing."""
    for part in parts:
        data = data.get(part) if isinstance(data, Mapping) else None
    return data


def _problem(error: Mapping[str, Any], data: Mapping[str, Any]) -> str:
    """One of pydantic's errors as "PLACE: expected X; found Y"."""
    fields = _fields()
    parts = [str(part) for part in error["loc"]]
    place = ".".join(parts)
    if error["type"] == "invalid_key":
        return f"{place}: expected the name of a setting; found a key that is no text"
    section = ".".join(parts[:-1])
    if error["type"] == "extra_forbidden":
        names = [name for name in fields if name.rpartition(".")[0] == section]
        known = ", ".join(name.rpartition(".")[2] for name in names)
        return f"{place}: expected one of {known}; found an unknown key{_suggestion(place)}"
    if error["type"] == "value_error":  # raised by our own validators, without the "expected"
        where, _, rest = str(error["ctx"]["error"]).rpartition(": ")
        place = ".".join(part for part in (place, where) if part)
        return f"{place}: expected {rest}"
    while parts and ".".join(parts) not in fields:  # below a vector, or inside a union's branch
        parts.pop()
    name = ".".join(parts)
    missing = error["type"] == "missing" and name == place
    found = "none" if missing else _found(_look_up(data, parts))
    return f"{name}: expected {_expected(fields[name])}; found {found}"


def _translate(
    error: ValidationError, data: Mapping[str, Any], source: str, overridden: Mapping[str, str]
) -> InputError:
    """All of pydantic's problems as one line; places set by an override say so."""
    problems: dict[str, str] = {}
    for item in error.errors(include_url=False):
        problem = _problem(item, data)
        place = problem.partition(": ")[0]
        problems.setdefault(place, problem)
    lines = []
    for place, problem in problems.items():
        origins = [o for key, o in overridden.items() if _covers(key, place) or _covers(place, key)]
        lines.append(f"{origins[0]} {problem}" if origins else f"{source}: {problem}")
    more = f" (and {len(lines) - 1} more: {', '.join(list(problems)[1:])})" if lines[1:] else ""
    return InputError(lines[0] + more)


def _covers(key: str, place: str) -> bool:
    return place == key or place.startswith(key + ".")


# --- overrides ------------------------------------------------------------------------------------


def _parse_settings(settings: Sequence[str]) -> dict[str, Any]:
    """`["task.duration=5"]` as `{"task.duration": 5}`; values are read as YAML."""
    parsed: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        key = key.strip()
        if not equals or not key or not all(key.split(".")):
            raise InputError(f"--set {setting}: expected KEY.PATH=VALUE; found {setting!r}")
        try:
            # The same reader as for files, so that 1e-3 is a number here too.
            parsed[key] = yaml.load(text, Loader=errors.SafeLoader)
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            reason = getattr(error, "problem", None) or str(error).splitlines()[0]
            raise InputError(f"--set {key}: expected a YAML value; found: {reason}") from None
    return parsed


def _apply_override(data: dict[str, Any], key: str, value: Any, origin: str) -> None:
    """Sets one dotted key in place; a mapping is merged into a mapping."""
    *sections, leaf = key.split(".")
    here = data
    for depth, section in enumerate(sections):
        inner = here.get(section)
        if inner is None:
            inner = here[section] = {}
        elif depth == 0 and section == "world" and isinstance(inner, str):
            inner = here[section] = {"name": inner}
        elif not isinstance(inner, dict):
            place = ".".join(sections[: depth + 1])
            raise InputError(
                f"{origin} {key}: expected {place} to be a mapping; found {_found(inner)}"
            )
        here = inner
    if isinstance(value, Mapping) and isinstance(here.get(leaf), dict):
        for inner_key, inner_value in value.items():
            _apply_override(here[leaf], str(inner_key), inner_value, origin)
    else:
        here[leaf] = dict(value) if isinstance(value, Mapping) else value


def _copy(value: Any) -> Any:
    """A deep copy of plain YAML values; tuples (from code) become lists."""
    if isinstance(value, Mapping):
        return {key: _copy(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_copy(item) for item in value]
    return value


# --- paths ----------------------------------------------------------------------------------------


def is_path(world: str) -> bool:
    """Whether a world is given as a file rather than by name.

    Args:
        world: what was written.

    Returns:
        True if it ends in `.yaml` or `.yml`, or contains a folder.
    """
    return world.endswith((".yaml", ".yml")) or "/" in world or os.sep in world


def _resolve(data: dict[str, Any], key: str, folder: Path, origin: str) -> None:
    """Makes one path absolute in place, and refuses it if there is no such file."""
    value = data.get(key)
    if key == "world" and isinstance(value, dict):
        if isinstance(value.get("name"), str) and is_path(value["name"]):
            _resolve(value, "name", folder, origin + "world.")
        _resolve(value, "current_field", folder, origin + "world.")
        return
    if not isinstance(value, str) or not value or (key == "world" and not is_path(value)):
        return
    path = folder / Path(value).expanduser()
    if key == "morphology":
        path = find_shipped(Path(value).expanduser(), "morphologies", folder, f"{origin}{key}")
    path = Path(os.path.abspath(path))
    if not path.is_file():
        what = "a folder" if path.is_dir() else "none"
        place = origin if key == "file" else f"{origin}{key}"
        raise InputError(f"{place}: expected a file; found {what} at {path}")
    data[key] = str(path)


def _resolve_own(section: dict[str, Any], folder: Path, origin: str) -> None:
    """Makes the path of FILE.py:FUNCTION absolute in place, and refuses it if there is no file."""
    own = parse_own(section.get("type"))
    if own is not None:
        held = {"file": own.path}
        _resolve(held, "file", folder, origin)
        section["type"] = f"{held['file']}:{own.function}"


def _sets(settings: Mapping[str, Any], section: str, key: str) -> bool:
    """Whether overrides set a key of a section, dotted or nested."""
    inner = settings.get(section)
    return f"{section}.{key}" in settings or (isinstance(inner, Mapping) and key in inner)


# --- the public part ------------------------------------------------------------------------------


def make_config(
    data: Mapping[str, Any],
    folder: str | Path = ".",
    overrides: Mapping[str, Any] | Sequence[str] = (),
    source: str = "config",
) -> Config:
    """Checks a mapping of settings.

    Args:
        data: the settings, nested like the YAML file.
        folder: what relative paths in `data` start from. Relative paths in overrides start from
            the current folder, because that is where they are typed.
        overrides: see `load_config`.
        source: what messages call the settings.

    Returns:
        The checked configuration, its paths absolute.

    Raises:
        InputError: a key is unknown or missing, a value is out of bounds, or a file is missing.
    """
    if not isinstance(data, Mapping):
        raise InputError(f"{source}: expected a mapping; found {_found(data)}")
    merged = _copy(data)
    if isinstance(overrides, Mapping):
        settings, label = dict(overrides), "override"
    else:
        settings, label = _parse_settings(overrides), "--set"
    for key, value in settings.items():
        _apply_override(merged, str(key), _copy(value), label)
    written = _copy(merged)
    for key in ("morphology", "modules", "world"):
        typed = key in settings or f"{key}.name" in settings
        start, origin = (Path.cwd(), f"{label} ") if typed else (Path(folder), f"{source}: ")
        _resolve(merged, key, start, origin)
    for key in ("controller", "task"):
        if isinstance(merged.get(key), dict):
            typed = _sets(settings, key, "type")
            start, origin = (Path.cwd(), f"{label} ") if typed else (Path(folder), f"{source}: ")
            _resolve_own(merged[key], start, f"{origin}{key}.type")
    try:
        config = Config.model_validate(merged)
    except ValidationError as error:
        raise _translate(error, merged, source, dict.fromkeys(settings, label)) from None
    config._source = source
    config._written = written
    return config


def load_config(path: str | Path, overrides: Mapping[str, Any] | Sequence[str] = ()) -> Config:
    """Reads a configuration file.

    Args:
        path: the YAML file, or a shipped configuration's name. Relative paths in it start from
            its folder.
        overrides: values that replace the file's: a mapping of dotted keys or nested mappings
            (`{"task.duration": 5.0}`), or texts as on the command line (`["task.duration=5"]`).
            `world.current=[...]` works on a world given by name, too.

    Returns:
        The checked configuration, its paths absolute.

    Raises:
        InputError: the file is missing or no YAML, a key is unknown or missing, a value is out of
            bounds, or a file it names is missing.
    """
    path = find_shipped(path, "configs")
    data = errors.load_yaml(path)
    if not isinstance(data, dict):
        found = "an empty file" if data is None else _found(data)
        raise InputError(f"{path}: expected a mapping of settings; found {found}")
    return make_config(data, path.parent, overrides, str(path))


def override_config(config: Config, overrides: Mapping[str, Any] | Sequence[str]) -> Config:
    """Applies overrides to a configuration that was already checked.

    Args:
        config: the configuration; it stays as it is.
        overrides: see `load_config`.

    Returns:
        The new configuration.

    Raises:
        InputError: see `load_config`.
    """
    return make_config(config.model_dump(), "/", overrides, config.source)


def dump_config(config: Config, folder: str | Path | None = None) -> str:
    """Writes a configuration as YAML with every value spelled out.

    Args:
        config: the configuration.
        folder: where the text will be saved, or None. Paths inside this folder are written
            relative to it, so that the folder can be moved; all others stay absolute.

    Returns:
        The YAML text; `load_config` reads it back equal.
    """

    def shorten(path: str | None) -> str | None:
        if path and folder is not None and Path(path).is_relative_to(Path(folder).absolute()):
            return Path(path).relative_to(Path(folder).absolute()).as_posix()
        return path

    data = _copy(config.model_dump())
    data["morphology"] = shorten(data["morphology"])
    data["modules"] = shorten(data["modules"])
    for section in ("controller", "task"):
        own = parse_own(data[section]["type"])
        if own is not None:
            data[section]["type"] = f"{shorten(own.path)}:{own.function}"
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, default_flow_style=None)
