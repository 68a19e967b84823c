"""A colony that goes on while somebody looks: everybody's poses, for pages that replay it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.evolution.body_fitness import BodyFitness, make_body_fitness
from mjx_revolve.evolution.checkpoints import DamageError, read_checkpoint
from mjx_revolve.evolution.colony import (
    Citizen,
    Colony,
    _Commune,
    colony_from_arrays,
)
from mjx_revolve.evolution.individuals import Individual
from mjx_revolve.evolution.runs import Run
from mjx_revolve.inputs.errors import InputError


@dataclass(frozen=True, eq=False)
class Sight:
    """What was seen of a robot.

    Attributes:
        individual: as it was when it was seen last.
        robot: its body.
        born: when [s].
        end: of its death; None where it lives on [s].
        cause: of its death; "" where it lives on.
        time: `[T]` when its poses are [s].
        qpos: `[T, 7 + num_hinges]` MuJoCo's, world frame; from one row to the next it may have been
            put back into the arena from beyond an edge.
    """

    individual: Individual
    robot: Robot
    born: float
    end: float | None
    cause: str
    time: np.ndarray = field(repr=False)
    qpos: np.ndarray = field(repr=False)


def watch_colony(
    config: Config, fitness: BodyFitness, search: Colony, begin: float, duration: float, gap: float
) -> tuple[list[Sight], list[Mapping[str, Any]]]:
    """Lets a colony live on, and looks at everybody in it.

    Args:
        config: how it lives.
        fitness: of its bodies.
        search: where it goes on.
        begin: from when on it is looked at, at the next interval's start [s].
        duration: for how long, to the end of an interval [s].
        gap: about how long from pose to pose [s].

    Returns:
        Who lived in that time, by birth, and what happened (see `Colony.events`).
    """
    world = _Commune(config, fitness)
    world.load(search)
    while world.tank.time < begin - 1e-9:
        search, _ = world.advance(search)
    steps = round(world.look / world.tank.timestep)
    wanted = max(1, round(gap / world.tank.timestep))
    stride = max(k for k in range(1, wanted + 1) if steps % k == 0)
    world.finer = steps // stride
    known: dict[int, Citizen] = {}
    times: dict[int, list[np.ndarray]] = {}
    poses: dict[int, list[np.ndarray]] = {}
    events: list[Mapping[str, Any]] = []
    until = world.tank.time + duration
    while world.tank.time < until - 1e-9:
        search, _ = world.advance(search)
        assert world.seen is not None
        citizens, trail = world.seen
        for number, citizen in citizens.items():
            width = 7 + citizen.individual.body.num_hinges
            own = trail.qpos[:, :width, citizen.place]
            whole = np.isfinite(own).all(1).cumprod().astype(bool)
            times.setdefault(number, []).append(trail.time[whole])
            poses.setdefault(number, []).append(own[whole])
        known |= {**citizens, **search.citizens}
        known |= {i.number: replace(known[i.number], individual=i) for i in search.died}
        events += search.events
    deaths = {event["id"]: event for event in events if event["event"] == "death"}
    sights = []
    for number in sorted(times):
        if not sum(map(len, times[number])):
            continue
        citizen, death = known[number], deaths.get(number, {})
        sights.append(
            Sight(
                individual=citizen.individual,
                robot=fitness.build(citizen.individual.body),
                born=citizen.born,
                end=death.get("time"),
                cause=death.get("cause", ""),
                time=np.concatenate(times[number]),
                qpos=np.concatenate(poses[number]),
            )
        )
    return sights, events


def open_colony(
    folder: Path, begin: float | None = None
) -> tuple[Config, BodyFitness, Colony, float]:
    """A colony at a checkpoint of its run; the folder stays as it is.

    Args:
        folder: the run folder.
        begin: a time [s]; None: that of the newest checkpoint.

    Returns:
        Its configuration, the fitness of its bodies, the colony at the newest checkpoint that is
        not later, or before its first interval, and when that is, or `begin` [s].

    Raises:
        InputError: it is no run of a colony, or has no checkpoint that is whole.
    """
    path = folder / "config.yaml"
    if not path.is_file():
        raise InputError(f"{folder}: expected a run folder; found no config.yaml in it")
    config = load_config(path)
    if config.colony is None:
        raise InputError(f"{folder}: expected the run of a colony; found one without")
    fitness = make_body_fitness(config)
    for checkpoint in Run(folder).checkpoints():
        try:
            arrays = read_checkpoint(checkpoint).arrays
        except DamageError:
            continue
        search = colony_from_arrays(config, fitness, arrays)
        now = _time_of(fitness, search)
        if begin is None or now <= begin + 1e-9:
            return config, fitness, search, now if begin is None else begin
    if begin is None:
        raise InputError(f"{folder / 'checkpoints'}: expected a checkpoint that is whole; found "
                         "none")  # fmt: skip
    return config, fitness, Colony(), begin


def _time_of(fitness: BodyFitness, search: Colony) -> float:
    """When a colony is [s]."""
    return int(search.tank["steps"]) * fitness.mixed.world.timestep if search.tank else 0.0
