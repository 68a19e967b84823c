"""Types of users' values, checked by pydantic with error messages of ours.

A `@checked` class is a frozen dataclass. Its values are checked whenever an instance is made: in
code, by `dataclasses.replace`, or from a mapping in a file::

    @checked
    class Jet:
        thrust: Annotated[NonNegative, Unit("N")]
        axis: Direction = (1.0, 0.0, 0.0)

        def __post_init__(self) -> None:
            if self.thrust == 0.0 and self.axis[2] != 0.0:
                raise ConstraintError("axis", "a level one without thrust", show(self.axis))

Messages follow from the annotations: `jet: thrust: expected a number >= 0 [N]; found -1`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, TypeVar, dataclass_transform

from annotated_types import Ge, Gt, Le, Unit, doc
from pydantic import (
    AfterValidator,
    AllowInfNan,
    BeforeValidator,
    ConfigDict,
    Strict,
    TypeAdapter,
    ValidationError,
)
from pydantic.dataclasses import dataclass as pydantic_dataclass
from pydantic_core import ArgsKwargs

from mjx_revolve.inputs.errors import ConstraintError, show
from mjx_revolve.inputs.validation_messages import fields_of, find_problems, join, refuse

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., object])

LARGEST = (2.0 - 2.0**-23) * 2.0**127
"""The largest number of float32."""

words = doc
"""A type's description in messages, as metadata of `Annotated`."""


# --- types ----------------------------------------------------------------------------------------


def _plain(value: Any) -> Any:
    """A NumPy scalar as Python's own number."""
    return value.item() if getattr(value, "shape", None) == () else value


def as_tuple(value: object) -> Any:
    """Lists and arrays as tuples; other values as they are."""
    if isinstance(value, tuple | str | bytes):
        return value
    value = value.tolist() if hasattr(value, "tolist") else value
    return tuple(value) if isinstance(value, Sequence) else value


def _unit_vector(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    length = math.sqrt(sum(x * x for x in vector))
    if not 1e-9 < length < math.inf:
        raise ConstraintError("", "a direction, not zero", show(list(vector)))
    x, y, z = (v / length for v in vector)
    return (x, y, z)


def _within(number: float) -> float:
    """The number, if it is within the range of single precision."""
    if abs(number) > LARGEST:
        between = f"a number between -{LARGEST:.3g} and {LARGEST:.3g}"
        raise ConstraintError("", between, show(number))
    return number


Number = Annotated[
    float, AllowInfNan(False), Strict(), BeforeValidator(_plain), AfterValidator(_within)
]
"""A finite number of single precision: neither truth value nor text."""
NonNegative = Annotated[Number, Ge(0)]
Positive = Annotated[Number, Gt(0)]
Share = Annotated[Number, Ge(0), Le(1), Unit("-")]

Integer = Annotated[int, Strict(), BeforeValidator(_plain)]
Boolean = Annotated[bool, Strict(), BeforeValidator(_plain)]
Text = Annotated[str, Strict()]

TupleOf = Annotated[tuple[T, ...], Strict(), BeforeValidator(as_tuple)]
"""Any number of one kind, from a list, tuple or array."""
Pair = Annotated[tuple[T, T], Strict(), BeforeValidator(as_tuple)]
Triple = Annotated[tuple[T, T, T], Strict(), BeforeValidator(as_tuple)]
Vector = Triple[Number]
"""Along x, y and z."""
Direction = Annotated[Vector, AfterValidator(_unit_vector), Unit("-")]
"""A vector of any length but 0, scaled to 1."""


def also(*forms: Mapping[str, object]) -> Callable[[F], F]:
    """States, as JSON Schema, the further forms that a "before" validator accepts."""

    def state(function: F) -> F:
        function.also = forms  # type: ignore[attr-defined]
        return function

    return state


@also({"type": "integer"})
def _read_id(value: object) -> object:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Id = Annotated[Text, BeforeValidator(_read_id), words("a name")]
"""A name, which YAML may give as a number."""
OFF = {"enum": ["off", False, None]}
ONE: dict[str, object] = {}
"""One of a list's items by itself."""


def is_off(value: object) -> bool:
    """Whether a value means "off": YAML 1.1 reads a bare `off` as False."""
    return value is None or value is False or (isinstance(value, str) and value == "off")


@also({"const": False})
def _law_name(value: object) -> object:
    return "off" if value is False else value


@also(OFF)
def _or_off(value: object) -> object:
    return None if is_off(value) else value


LawName = Annotated[T, BeforeValidator(_law_name)]
"""The name of a law, one of them `off`, which YAML reads as False."""
OrOff = Annotated[T | None, BeforeValidator(_or_off)]
"""A value, or `off`."""


# --- checking -------------------------------------------------------------------------------------


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def checked(kind: type[T]) -> type[T]:
    """Makes a class a frozen dataclass that checks its values and raises `InputError`.

    Numbers become floats, lists tuples, mappings what the annotation says. An annotation's
    `Unit(...)` and `words(...)` go into messages. A `__post_init__` raises `ConstraintError` where
    values do not fit together.
    """
    config = ConfigDict(extra="forbid")
    made: Any = pydantic_dataclass(frozen=True, config=config)(kind)
    label = re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower().removesuffix("_type")

    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:  # noqa: N807
        try:
            arguments = ArgsKwargs(args, kwargs)
            made.__pydantic_validator__.validate_python(arguments, self_instance=self)
        except ValidationError as error:
            given = dict(zip(fields_of(made), args, strict=False)) | kwargs
            name = f" {show(given['name'])}" if "name" in given else ""
            problems = find_problems(error, made, given)
            raise refuse(problems, lambda _: f"{label}{name}: ") from None

    def __getstate__(self: object) -> dict[str, object]:  # noqa: N807
        """The fields alone, without cached properties."""
        return {name: self.__dict__[name] for name in names}

    names = [field.name for field in dataclasses.fields(made)]
    made.__init__ = functools.wraps(made.__init__)(__init__)
    made.__getstate__ = __getstate__
    return made


_adapter = functools.cache(TypeAdapter)


def read(kind: object, value: object, place: str = "", context: object = None) -> Any:
    """Reads a user's value as a type.

    Args:
        kind: a `checked` class, or any other type with annotations.
        value: mappings and lists as in YAML.
        place: where it was given, for messages.
        context: `info.context` of validators.

    Raises:
        InputError: the value is not of that type.
    """
    try:
        return _adapter(kind).validate_python(value, context=context)
    except ValidationError as error:
        problems = find_problems(error, kind, value)
    raise refuse({join(place, at): text for at, text in problems.items()})
