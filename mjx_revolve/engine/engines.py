"""The engines by name: the population engine and MJX's."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from mjx_revolve.engine.engine import Engine
from mjx_revolve.engine.population import make_population_engine
from mjx_revolve.engine.robot import Robot
from mjx_revolve.inputs.errors import InputError

ENGINES = ("population", "mjx")


def make_engine(robot: Robot, engine: str = "population", contact: bool = True) -> Engine[Any]:
    """The simulator of a robot; the same object for the same arguments.

    Args:
        robot: from `build_robot`.
        engine: "population" or "mjx".
        contact: whether the robot can touch the bed.

    Returns:
        The engine.

    Raises:
        InputError: an unknown engine, or a world that it cannot step, or a model that was edited
            beyond what `Robot.with_model` takes.
    """
    return _make_engine(robot.as_edited(), engine, contact)


@lru_cache(maxsize=32)
def _make_engine(robot: Robot, engine: str, contact: bool) -> Engine[Any]:
    if engine == "population":
        return make_population_engine(robot, contact)
    if engine == "mjx":
        from mjx_revolve.engine.mjx_engine import make_mjx_engine

        return make_mjx_engine(robot, contact)
    raise InputError("engine", f"one of {', '.join(ENGINES)}", repr(engine))
