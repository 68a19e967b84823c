"""The simulators by name: the population step, and MJX's behind the same call."""

from __future__ import annotations

from functools import lru_cache

from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.state import Engine
from mjx_revolve.engine.step import make_population_engine
from mjx_revolve.inputs.errors import InputError

ENGINES = ("population", "mjx")


@lru_cache(maxsize=32)
def make_engine(robot: Robot, engine: str = "population", contact: bool = True) -> Engine:
    """The simulator behind a rollout.

    Args:
        robot: from `build_robot`.
        engine: "population" or "mjx".
        contact: whether the robot can touch the bed.

    Returns:
        The engine.

    Raises:
        InputError: an unknown engine, or something that it cannot do.
    """
    if engine == "population":
        return make_population_engine(robot, contact)
    if engine == "mjx":
        from mjx_revolve.engine.mjx_step import make_mjx_engine

        return make_mjx_engine(robot, contact)
    raise InputError(f"engine: expected one of {', '.join(ENGINES)}; found {engine!r}")
