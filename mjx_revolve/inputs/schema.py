"""What a user's value may be: types that pydantic checks, and its complaints in our words.

A `@checked` class is a frozen dataclass whose values are checked whenever one is made, in code, by
`dataclasses.replace` or from a mapping in a file. Annotations say it all::

    @checked
    class Jet:
        thrust: Annotated[NonNegative, Unit("N")]
        axis: Direction = (1.0, 0.0, 0.0)

        def __post_init__(self) -> None:
            if self.thrust == 0.0 and self.axis[2] != 0.0:
                raise MisfitError("axis", "a level one, since there is no thrust", show(self.axis))

and every complaint follows from them: `jet: thrust: expected a number >= 0 [N]; found -1`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Sequence
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

from mjx_revolve.inputs.complaints import MisfitError, fields_of, find_problems, join, refuse
from mjx_revolve.inputs.errors import show

T = TypeVar("T")

LARGEST = (2.0 - 2.0**-23) * 2.0**127
"""The largest number of float32."""

words = doc
"""What messages say of a type instead of its name, as metadata of `Annotated`."""


# --- types ----------------------------------------------------------------------------------------


def _plain(value: Any) -> Any:
    """A NumPy scalar as Python's own number."""
    return value.item() if getattr(value, "shape", None) == () else value


def as_tuple(value: Any) -> Any:
    """Lists and arrays as tuples; whatever else as it is."""
    if isinstance(value, tuple | str | bytes):
        return value
    value = value.tolist() if hasattr(value, "tolist") else value
    return tuple(value) if isinstance(value, Sequence) else value


def _unit_vector(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    length = math.sqrt(sum(x * x for x in vector))
    if not 1e-9 < length < math.inf:
        raise MisfitError("", "a direction, not zero", show(list(vector)))
    x, y, z = (v / length for v in vector)
    return (x, y, z)


def _within(number: float) -> float:
    """The number, if single precision holds it, in which all is computed."""
    if abs(number) > LARGEST:
        raise MisfitError("", f"a number between -{LARGEST:.3g} and {LARGEST:.3g}", show(number))
    return number


Number = Annotated[
    float, AllowInfNan(False), Strict(), BeforeValidator(_plain), AfterValidator(_within)
]
"""A finite number of single precision: neither truth value nor text."""
NonNegative = Annotated[Number, Ge(0)]
Positive = Annotated[Number, Gt(0)]
Share = Annotated[Number, Ge(0), Le(1), Unit("-")]

Whole = Annotated[int, Strict()]
Switch = Annotated[bool, Strict()]
Text = Annotated[str, Strict()]

Row = Annotated[tuple[T, ...], Strict(), BeforeValidator(as_tuple)]
"""Any number of one kind, from a list, tuple or array."""
Pair = Annotated[tuple[T, T], Strict(), BeforeValidator(as_tuple)]
Triple = Annotated[tuple[T, T, T], Strict(), BeforeValidator(as_tuple)]
Vector = Triple[Number]
"""Along x, y and z."""
Direction = Annotated[Vector, AfterValidator(_unit_vector), Unit("-")]
"""A vector of any length but 0, scaled to 1."""


def is_off(value: Any) -> bool:
    """Whether a value says that there is none: YAML 1.1 reads a bare `off` as False."""
    return value is None or value is False or (isinstance(value, str) and value == "off")


Law = Annotated[T, BeforeValidator(lambda value: "off" if value is False else value)]
"""The name of a law, one of them `off`, which YAML reads as False."""
Maybe = Annotated[T | None, BeforeValidator(lambda value: None if is_off(value) else value)]
"""A value, or `off`."""


# --- checking -------------------------------------------------------------------------------------


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def checked(kind: type[T]) -> type[T]:
    """Makes a class a frozen dataclass that checks its values.

    Numbers become floats, lists tuples, mappings what the annotation says. An annotation's
    `Unit(...)` and `words(...)` go into messages.

    Args:
        kind: the class. Its `__post_init__`, if any, raises `MisfitError` where values do not fit.

    Returns:
        The class; making one raises `InputError`.
    """
    config = ConfigDict(extra="forbid")
    made: Any = pydantic_dataclass(frozen=True, config=config)(kind)
    label = re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower().removesuffix("_type")

    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:  # noqa: N807
        try:
            made.__pydantic_validator__.validate_python(
                ArgsKwargs(args, kwargs), self_instance=self
            )
        except ValidationError as error:
            given = dict(zip(fields_of(made), args, strict=False)) | kwargs
            name = f" {show(given['name'])}" if "name" in given else ""
            problems = find_problems(error, made, given)
            raise refuse(problems, lambda _: f"{label}{name}: ") from None

    def __getstate__(self: Any) -> dict[str, Any]:  # noqa: N807
        """Its fields: what follows from them is found again by whoever unpickles it."""
        return {name: self.__dict__[name] for name in names}

    names = [field.name for field in dataclasses.fields(made)]
    made.__init__ = functools.wraps(made.__init__)(__init__)
    made.__getstate__ = __getstate__
    return made


@functools.cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def read(kind: Any, value: Any, place: str = "", context: Any = None) -> Any:
    """Reads a user's value.

    Args:
        kind: what it should be: a `checked` class, or any other type with annotations.
        value: what was given; mappings and lists as in YAML.
        place: where it was given, for messages.
        context: what validators find as `info.context`.

    Returns:
        The value as its type says.

    Raises:
        InputError: it is something else; the message says where, what was expected, what was found.
    """
    try:
        return _adapter(kind).validate_python(value, context=context)
    except ValidationError as error:
        problems = find_problems(error, kind, value)
    raise refuse({join(place, at): text for at, text in problems.items()})
