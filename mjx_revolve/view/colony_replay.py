"""A run's colony as a page: from a checkpoint it lives on for a while, and all is kept."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from mjx_revolve.evolution.colony_watch import Sight, open_colony, watch_colony
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.colony import Actor, Mark, Written, write_colony_page

_GAP = 0.05  # from pose to pose [s]; what lies between is interpolated. A choice.
DURATION = 60.0
"""For how long a colony is watched, where nothing else is asked for [s]."""


@dataclass(frozen=True, eq=False)
class Watched:
    """A colony that was looked at.

    Attributes:
        actors: who lived then, by birth.
        marks: the clinic and chargers.
        start: from when on it was looked at [s].
        end: until when [s].
        leap: who is farther than this from its pose before has been put there [m]; None: nobody is.
        title: what it is called.
    """

    actors: list[Actor]
    marks: list[Mark]
    start: float
    end: float
    leap: float | None
    title: str


def watch_run(folder: Path, begin: float | None = None, duration: float = DURATION) -> Watched:
    """Lets a run's colony live on from a checkpoint.

    Up to the run's end, what is seen is what has happened; from there on, what would have.

    Args:
        folder: the run folder; it stays as it is.
        begin: from when on it is watched [s]; None: from its newest checkpoint on.
        duration: for how long, to the end of an interval [s].

    Returns:
        What was seen.

    Raises:
        InputError: it is no run of a colony, it has no checkpoint, or nobody lives then.
    """
    config, fitness, search, begin = open_colony(folder, begin)
    colony = config.colony
    assert colony is not None
    sights, _ = watch_colony(config, fitness, search, begin, duration, _GAP)
    if not sights:
        raise InputError(f"{folder}: expected somebody alive from {begin:g} s on; found nobody")
    start = min(float(sight.time[0]) for sight in sights) - _GAP
    actors = [_actor(sight, start) for sight in sights]
    depth = fitness.mixed.world.surface_height - config.task.depth
    marks = [Mark("clinic", (0.0, 0.0, depth), colony.birth.radius)]
    if colony.energy is not None:
        marks += [Mark("charger", place, colony.energy.reach) for place in colony.energy.chargers]
    end = max(float(sight.time[-1]) for sight in sights)
    # Nobody swims half of the arena from one pose to the next.
    leap = colony.arena.size / 2 if colony.arena.edge == "wrap" else None
    title = f"{folder.resolve().name}: a colony"
    return Watched(actors, marks, start, end, leap, title)


def write_colony_replay(
    folder: Path, path: Path, begin: float | None = None, duration: float = DURATION
) -> tuple[Written, float, float, int]:
    """Lets a run's colony live on from a checkpoint, and writes a page of that.

    Args:
        folder: the run folder; it stays as it is, but for the page.
        path: of the page.
        begin: see `watch_run`.
        duration: see `watch_run`.

    Returns:
        What the page holds, from when to when it goes [s], and how many robots are on it.

    Raises:
        InputError: it is no run of a colony, it has no checkpoint, or nobody lives then.
        OSError: the page cannot be written.
    """
    seen = watch_run(folder, begin, duration)
    window = (seen.start, seen.end)
    written = write_colony_page(
        seen.actors, path, seen.title, marks=seen.marks, leap=seen.leap, window=window
    )
    return written, seen.start, seen.end, len(seen.actors)


def _actor(sight: Sight, start: float) -> Actor:
    """A robot as the page wants it."""
    one = sight.individual
    parents = " and ".join(f"#{number}" for number in one.parents) or "none"
    score = "not known" if math.isnan(one.score) else f"{one.score:.3g}"
    info: dict[str, str | float] = {
        "born": f"{sight.born:.0f} s",  # which may be long before the page begins
        "parents": parents,
        "fitness": score,
        "modules": f"{one.body.num_modules}, {one.body.num_hinges} hinges",
    }
    if sight.cause:
        info["dies"] = {"age": "of age", "energy": "of an empty battery"}.get(
            sight.cause, sight.cause
        )
    return Actor(
        name=f"#{one.number}", robot=sight.robot, time=sight.time, qpos=sight.qpos,
        start=max(sight.born, start), end=sight.end, info=info,
    )  # fmt: skip
