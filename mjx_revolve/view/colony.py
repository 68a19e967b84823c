"""A recording of a run's colony: it is replayed from a checkpoint, and all poses are kept."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from mjx_revolve.episodes.run_reader import find_run
from mjx_revolve.evolution.colony_observer import ObservedRobot, observe_colony, open_colony
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.recording import Mark, Recording, ReplayRobot
from mjx_revolve.view.viewer import write_colony_page as write_colony_page

_GAP = 0.05  # from pose to pose [s]; what lies between is interpolated. A choice.
DURATION = 60.0
"""How long a colony is recorded by default [s]."""
Actor = ReplayRobot
"""The old name, for one more release; so does `write_colony_page` stand here, too."""
_CAUSES = {"age": "of age", "energy": "of an empty battery"}


def record_colony(
    folder: Path, begin: float | None = None, duration: float = DURATION
) -> Recording:
    """Replays a run's colony from a checkpoint, and records it.

    Up to the run's end the recording equals the run, in a process that has called
    `prepare_process`, as commands do: other options of the compiler give other last bits, which
    grow. From there on the colony is continued.

    Args:
        folder: the run folder, or its `champion` folder; it stays as it is.
        begin: where the recording begins [s]; None: at the newest checkpoint.
        duration: how long it is [s].

    Returns:
        The recording.

    Raises:
        InputError: it is no run of a colony, it has no checkpoint, or no robot is alive then.
    """
    folder = find_run(folder)
    config, fitness, search, begin = open_colony(folder, begin)
    colony = config.colony
    assert colony is not None
    observed, _ = observe_colony(config, fitness, search, begin, duration, _GAP)
    if not observed:
        raise InputError(folder, f"robots alive from {begin:g} s on", "none")
    # Poses are whole steps apart, perhaps less than `_GAP`; the first is that late.
    gaps = [float(one.time[1] - one.time[0]) for one in observed if len(one.time) > 1]
    start = min(float(one.time[0]) for one in observed) - min(gaps, default=_GAP)
    # A colony is advanced to the end of an interval.
    end = min(start + duration, max(float(one.time[-1]) for one in observed))
    depth = fitness.mixed.world.surface_height - config.task.depth
    marks = [Mark("clinic", (0.0, 0.0, depth), colony.birth.radius)]
    if colony.energy is not None:
        marks += [Mark("charger", place, colony.energy.reach) for place in colony.energy.chargers]
    return Recording(
        title=f"{folder.resolve().name}: a colony",
        # No robot swims twice the arena from one pose to the next: it has blown up.
        robots=[
            _replayed(one, start, end, 2 * colony.arena.size)
            for one in observed
            if one.time[0] <= end
        ],
        start=start,
        end=end,
        marks=marks,
        # No robot swims half of the arena from one pose to the next.
        leap=colony.arena.size / 2 if colony.arena.edge == "wrap" else None,
    )


def _replayed(observed: ObservedRobot, start: float, end: float, far: float) -> ReplayRobot:
    one = observed.individual
    gone = np.linalg.norm(np.diff(observed.qpos[:, :3], axis=0), axis=1) > far
    shown = (observed.time <= end + 1e-6) & ~np.r_[False, np.logical_or.accumulate(gone)]
    died = observed.end is not None and observed.end <= end + 1e-6
    unmeasured = "none" if observed.cause == "failed" else "not measured yet"
    info: dict[str, str | float] = {
        "born": f"{observed.born:.0f} s",  # which may be long before the recording begins
        "parents": " and ".join(f"#{number}" for number in one.parents) or "none",
        "fitness": unmeasured if math.isnan(one.score) else f"{one.score:.3g}",
        "modules": one.body.counts.replace(" modules", "", 1),
    }
    if died:
        info["dies"] = _CAUSES.get(observed.cause, observed.cause)
    return ReplayRobot(
        name=f"#{one.number}", robot=observed.robot, time=observed.time[shown],
        qpos=observed.qpos[shown], start=max(observed.born, start),
        end=observed.end if died else None, info=info,
    )  # fmt: skip
