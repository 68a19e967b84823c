"""Commands to a running world, as its page posts them."""

from __future__ import annotations

from dataclasses import fields
from typing import Annotated, get_args

from annotated_types import Ge, Le, Unit

from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.schema import Boolean, Integer, Number, Pair, Triple, checked, read

# Bounds, choices: how far from the middle robots are dropped [m], the fastest current [m/s].
_MAX_DISTANCE, _MAX_DEPTH, _MAX_SPEED = 500.0, 500.0, 3.0
_Level = Annotated[Number, Ge(-_MAX_DISTANCE), Le(_MAX_DISTANCE), Unit("m")]
_Speed = Annotated[Number, Ge(-_MAX_SPEED), Le(_MAX_SPEED), Unit("m/s")]


@checked
class Drop:
    """A robot into the water.

    Attributes:
        entry: index in the catalogue.
        place: x and y of its core, world frame [m]; None: the middle.
        depth: of its core below the still surface [m]; it is less where the bed is in the way.
        heading: which way it looks, from x towards y [deg]; None: any.
    """

    entry: Annotated[Integer, Ge(0)]
    place: Pair[_Level] | None = None
    depth: Annotated[Number, Ge(-2.0), Le(_MAX_DEPTH), Unit("m")] = 1.0
    heading: Annotated[Number, Ge(-360.0), Le(360.0), Unit("deg")] | None = None


@checked
class Remove:
    """A robot out of the water.

    Attributes:
        key: its number on the page.
    """

    key: Annotated[Integer, Ge(0)]


@checked
class Current:
    """Another current everywhere.

    Attributes:
        velocity: of the water, world frame [m/s].
    """

    velocity: Triple[_Speed]


@checked
class Pause:
    """Time stops, or goes on.

    Attributes:
        on: whether it stops.
    """

    on: Boolean


@checked
class Rate:
    """Slower or faster than real time.

    Attributes:
        factor: seconds in the water for each real one [-].
    """

    factor: Annotated[Number, Ge(0.02), Le(8.0), Unit("-")]


@checked
class Reset:
    """All as it was at the beginning: the first robots, the world's current, real time."""


Command = Drop | Remove | Current | Pause | Rate | Reset
_COMMANDS: dict[str, type] = {kind.__name__.lower(): kind for kind in get_args(Command)}


def read_command(data: object) -> Command:
    """Reads what a page has posted.

    Args:
        data: JSON as Python has it: a mapping with `do`, the name of a command, and its arguments.

    Returns:
        The command.

    Raises:
        InputError: it is something else; one line says what.
    """
    if not isinstance(data, dict):
        raise InputError(f"expected a mapping with `do`; found {show(data)}")
    name = data.get("do")
    if not isinstance(name, str) or name not in _COMMANDS:
        found = show(name) if "do" in data else "nothing"
        raise InputError("do", f"one of {', '.join(_COMMANDS)}", found)
    given = {key: value for key, value in data.items() if key != "do"}
    if given and not fields(_COMMANDS[name]):
        raise InputError(name, "nothing beside `do`", show(given))
    return read(_COMMANDS[name], given, name)
