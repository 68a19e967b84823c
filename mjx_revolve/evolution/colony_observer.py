"""A colony replayed from a checkpoint, with the poses of all its robots, for pages and films."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.run_reader import RunReader, find_run
from mjx_revolve.evolution.body_fitness import BodyFitness, make_body_fitness
from mjx_revolve.evolution.colony import Colony, Event, Member
from mjx_revolve.evolution.colony_search import ColonyEvolution
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.individuals import Individual
from mjx_revolve.inputs.errors import InputError


@dataclass(frozen=True, eq=False)
class ObservedRobot:
    """A robot of a colony, and its poses.

    Attributes:
        individual: in its last state.
        robot: its body.
        born: time of birth [s].
        end: time of death [s]; None if it is alive.
        cause: of its death; "" if it is alive.
        time: `[T]` of its poses [s].
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


def observe_colony(
    config: Config, fitness: BodyFitness, search: Colony, begin: float, duration: float, gap: float
) -> tuple[list[ObservedRobot], list[Event]]:
    """Advances a colony and records the poses of its robots.

    Args:
        config: its settings.
        fitness: of its bodies.
        search: the colony at the start.
        begin: start of the record [s], rounded up to the next interval.
        duration: length of the record [s], rounded up to the end of an interval.
        gap: approximate time between poses [s].

    Returns:
        The robots that lived in that time, by birth, and the events (see `Colony.events`).
    """
    evolution = ColonyEvolution(config, Executor(fitness, fitness.block_size))
    timestep, rules = evolution.tank.timestep, evolution.rules
    steps, wanted = round(rules.look / timestep), max(1, round(gap / timestep))
    rows = steps // max(k for k in range(1, wanted + 1) if steps % k == 0)
    members: dict[int, Member] = {}
    poses: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    events: list[Event] = []
    while rules.time(search) < begin - 1e-9:
        proposal = evolution.ask(search)
        search = evolution.tell(proposal, evolution.evaluate(proposal)).search
    until = rules.time(search) + duration
    while rules.time(search) < until - 1e-9:
        proposal = evolution.ask(search)
        trajectory = evolution.evaluate(proposal, rows)
        search = evolution.tell(proposal, trajectory).search
        for number, member in proposal.colony.members.items():
            own = trajectory.qpos[:, : 7 + member.individual.body.num_hinges, member.slot]
            whole = np.isfinite(own).all(1).cumprod().astype(bool)
            poses.setdefault(number, []).append((trajectory.time[whole], own[whole]))
        members |= proposal.colony.members
        members |= {n: replace(m, individual=rules.measured(m)) for n, m in search.members.items()}
        members |= {i.number: replace(members[i.number], individual=i) for i in search.died}
        events += search.events
    deaths = {event["id"]: event for event in events if event["event"] == "death"}
    observed = []
    for number in sorted(poses):
        time, qpos = (np.concatenate(rows) for rows in zip(*poses[number], strict=True))
        if not len(time):
            continue
        member, death = members[number], deaths.get(number, {})
        observed.append(
            ObservedRobot(
                individual=member.individual,
                robot=fitness.build(member.individual.body),
                born=member.born,
                end=death.get("time"),
                cause=death.get("cause", ""),
                time=time,
                qpos=qpos,
            )
        )
    return observed, events


def open_colony(
    folder: Path, begin: float | None = None
) -> tuple[Config, BodyFitness, Colony, float]:
    """A colony at a checkpoint of its run; the folder is not changed.

    Args:
        folder: the run folder.
        begin: a time [s]; None: that of the newest checkpoint.

    Returns:
        Its configuration, the fitness of its bodies, the colony at the newest checkpoint that is
        not later, or before its first interval, and its time, or `begin` [s].

    Raises:
        InputError: it is no run of a colony, or has no checkpoint that is whole.
    """
    run = RunReader(find_run(folder))
    config = run.load_config()
    if config.colony is None:
        raise InputError(folder, "the run of a colony", "one without")
    fitness = make_body_fitness(config)
    evolution = ColonyEvolution(config, Executor(fitness, fitness.block_size))
    for checkpoint in run.readable_checkpoints({}):
        search = evolution.from_arrays(checkpoint.arrays)
        now = evolution.rules.time(search)
        if begin is None or now <= begin + 1e-9:
            return config, fitness, search, now if begin is None else begin
    if begin is None:
        raise InputError(folder / "checkpoints", "a checkpoint that is whole", "none")
    return config, fitness, Colony(), begin
