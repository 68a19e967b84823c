"""Names of laws, and coefficients of laws by name, as users write them in worlds and modules.

They are checked against the tables of laws. These are imported when the first name is read and not
before, so that bodies that name no law are read without JAX.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator

from mjx_revolve.inputs.errors import ConstraintError, show
from mjx_revolve.inputs.schema import LARGEST, Number, Text, also, as_tuple, words

if TYPE_CHECKING:
    from mjx_revolve.water.laws import Coefficient


def drag_names(of_parts: bool = False) -> str:
    """The drag laws that a world can choose, or a part of a module, in words."""
    from mjx_revolve.water.drag import DRAG_LAWS, drags_whole_bodies

    whole = [name for name in DRAG_LAWS if drags_whole_bodies(name)]
    if not of_parts:
        return f"one of {', '.join(DRAG_LAWS)}"
    own = ", ".join(name for name in DRAG_LAWS if name not in whole)
    return f"one of {own} ({', '.join(whole)} is a law of whole bodies)"


def buoyancy_names() -> str:
    """The buoyancy laws, in words."""
    from mjx_revolve.water.buoyancy import BUOYANCY_LAWS

    return f"one of {', '.join(BUOYANCY_LAWS)}"


def list_coefficients() -> list[tuple[str, Coefficient]]:
    """Every coefficient that users may give for a module, after the law that reads it."""
    from mjx_revolve.water.added_mass import COEFFICIENTS
    from mjx_revolve.water.drag import DRAG_LAWS

    found = [(name, c) for name, law in DRAG_LAWS.items() for c in law.coefficients]
    return found + [("added_mass", c) for c in COEFFICIENTS]


def _law(describe: Callable[[], str]) -> BeforeValidator:
    """A check that a value is a name of a law; its `names` are for JSON Schema."""

    def names() -> list[str]:
        return describe().removeprefix("one of ").partition(" (")[0].split(", ")

    def check(value: Any) -> str:
        name = "off" if value is False else value  # YAML 1.1 reads a bare `off` as False
        if not isinstance(name, str) or name not in names():
            raise ConstraintError("", describe(), show(value))
        return name

    check.names = names  # type: ignore[attr-defined]
    return BeforeValidator(check)


def _read_mapping(value: Any, what: str) -> dict[Any, Any]:
    """A mapping from coefficients, from itself or the pairs that it was read into; empty: none."""
    if value is None or value in ((), []):
        return {}
    pairs = isinstance(value, tuple) and all(isinstance(x, tuple) and len(x) == 2 for x in value)
    if not (pairs or isinstance(value, Mapping)):
        raise ConstraintError("", f"a mapping from coefficients to {what}", show(value))
    return dict(value)


@also({"type": "object", "additionalProperties": {"type": "number"}}, {"type": "null"})
def _read_coefficients(value: Any) -> Any:
    """A mapping from names to numbers as sorted pairs, each within its coefficient's bounds."""
    given = _read_mapping(value, "numbers")
    # Without any, no law is imported.
    known = {c.name: c for _, c in list_coefficients() if not c.own_field} if given else {}
    for name, number in given.items():
        if name not in known:
            names = f"({', '.join(known) or 'there is none without a field of its own'})"
            raise ConstraintError("", f"names of coefficients {names}", show(name))
        c, plain = known[name], isinstance(number, int | float) and not isinstance(number, bool)
        if not plain or not c.low <= number <= min(c.high, LARGEST):
            expected = f"a number from {c.low:g} to {c.high:g} [{c.unit}]"
            raise ConstraintError(name, expected, show(number))
    return tuple(sorted(given.items()))


def _read_per_axis(value: Any, place: str = "") -> Any:
    """A number, or three of them, one for each axis."""
    value = as_tuple(value)
    several = value if isinstance(value, tuple) else (value,)
    plain = all(isinstance(x, int | float) and not isinstance(x, bool) for x in several)
    wrong = isinstance(value, tuple) and len(value) != 3
    if wrong or not plain or not all(0 <= x <= LARGEST for x in several):
        raise ConstraintError(place, "a number >= 0, or three, one for each axis", show(value))
    return tuple(map(float, value)) if isinstance(value, tuple) else value


PerAxis = Annotated[
    float | tuple[float, float, float],
    BeforeValidator(lambda value: _read_per_axis(value)),
    words("a number >= 0, or three, one for each axis"),
]
"""A coefficient of all faces of a part, or of those across each of its axes."""
DragName = Annotated[str, _law(drag_names)]
PartDrag = Annotated[str, _law(lambda: drag_names(of_parts=True))]
BuoyancyName = Annotated[str, _law(buoyancy_names)]
Coefficients = Annotated[
    tuple[tuple[Text, Number], ...],
    BeforeValidator(_read_coefficients),
    words("a mapping from coefficients of laws to numbers"),
]
"""Coefficients of laws by name; what is not given has the law's default."""


def factor_names() -> dict[str, tuple[bool, float]]:
    """What of a part's water factors may multiply: whether along axes, and `Coefficient.spread`.

    All that laws vary as `drag` or `added_mass`, each coefficient, and LAW.FIELD of parameters.
    """
    from mjx_revolve.water.drag import DRAG_LAWS

    found = {"drag": (False, 1.5), "added_mass": (False, 1.35)}
    found |= {c.name: (c.per_axis, c.spread) for _, c in list_coefficients()}
    for name, law in DRAG_LAWS.items():
        for field in dataclasses.fields(law.parameters) if law.parameters is not None else ():
            if isinstance(field.default, float):
                found[f"{name}.{field.name}"] = (False, 1.5)
    return found


def _read_factors(value: Any) -> Any:
    """A mapping from names to factors as sorted pairs."""
    given = _read_mapping(value, "factors")
    known = factor_names() if given else {}
    for name, factor in given.items():
        if name not in known:
            raise ConstraintError("", f"names of coefficients ({', '.join(known)})", show(name))
        given[name] = _read_per_axis(factor, name)
        if isinstance(given[name], tuple) and not known[name][0]:
            raise ConstraintError(name, "one number >= 0", show(factor))
    return tuple(sorted(given.items()))


Factors = Annotated[
    tuple[tuple[Text, Any], ...],
    BeforeValidator(_read_factors),
    words("a mapping from coefficients of laws to factors"),
]
"""Factors on coefficients of laws by name."""
