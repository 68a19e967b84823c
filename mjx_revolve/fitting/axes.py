"""Whether a recording's axes are meant otherwise than they are read.

What is simulated of a recording from where it begins, second by second, is held beside what is
simulated of it with its columns read in the other usual ways.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from mjx_revolve.fitting.estimate import recording_costs
from mjx_revolve.fitting.problem import NOISE, FitProblem, make_problem
from mjx_revolve.fitting.recording import TimeSeries
from mjx_revolve.inputs.errors import InputError

# Another way is named where it leaves a third of the sum of squares. A choice.
_BETTER = 3.0
# Signals that another way takes from another one, with the sign.
_WAYS: dict[str, dict[str, tuple[str, float]]] = {
    "qw, qx, qy, qz hold x, y, z, w": {
        "qw": ("qz", 1), "qx": ("qw", 1), "qy": ("qx", 1), "qz": ("qy", 1)},
    "qx, qy, qz, qw hold w, x, y, z": {
        "qw": ("qx", 1), "qx": ("qy", 1), "qy": ("qz", 1), "qz": ("qw", 1)},
    "qw, qx, qy, qz turn the world to the robot: qw=COLUMN*-1": {"qw": ("qw", -1)},
    "z points down: z=COLUMN*-1": {"z": ("z", -1)},
    "z points down and y to the right, of the water and of the robot: y, z, qy and qz=COLUMN*-1": {
        "y": ("y", -1), "z": ("z", -1), "qy": ("qy", -1), "qz": ("qz", -1)},
    "yaw turns clockwise: yaw=COLUMN*-1": {"yaw": ("yaw", -1)},
    "y points to the right and yaw turns clockwise: y and yaw=COLUMN*-1": {
        "y": ("y", -1), "yaw": ("yaw", -1)},
    "y points to the right, of the water and of the robot: y, pitch and yaw=COLUMN*-1": {
        "y": ("y", -1), "pitch": ("pitch", -1), "yaw": ("yaw", -1)},
    "y points to the right, of the water and of the robot: y and pitch=COLUMN*-1": {
        "y": ("y", -1), "pitch": ("pitch", -1)},
    "z points down and y to the right, of the water and of the robot: y, z, pitch and yaw="
    "COLUMN*-1": {"y": ("y", -1), "z": ("z", -1), "pitch": ("pitch", -1), "yaw": ("yaw", -1)},
}  # fmt: skip


def _read_so(
    signals: Mapping[str, TimeSeries], way: Mapping[str, tuple[str, float]]
) -> dict[str, TimeSeries] | None:
    """The signals, read in another way; None where one that it is about is not there."""
    if not {source for source, _ in way.values()} <= set(signals):
        return None
    changed = {
        name: TimeSeries(signals[source].time, sign * signals[source].value)
        for name, (source, sign) in way.items()
    }
    return {**signals, **changed}


def find_other_axes(problem: FitProblem) -> list[str]:
    """Lines about recordings that suit the robot far better if they are read in another way."""
    local = {name.partition("_")[0] for name in problem.local}
    free = [*(p.name for p in problem.parameters), *sorted(local)]

    def cost(one: FitProblem) -> list[float]:
        return recording_costs(one.in_pieces(), [one.origin()], NOISE)[0].tolist()

    best = [(x / _BETTER, "") for x in cost(problem)]
    for words, way in _WAYS.items():
        read = [_read_so(r.signals, way) for r in problem.recordings]
        pairs = zip(problem.recordings, read, strict=True)
        others = [r if x is None else replace(r, signals=x) for r, x in pairs]
        if any(x is not None for x in read):
            try:
                costs = cost(make_problem(problem.robot, others, free, problem.settings))
            except InputError:  # marks say that it is not so
                continue
            best = [min(old, (x, words)) for old, x in zip(best, costs, strict=True)]
    return [
        f"{recording.name}: the robot would move far more like this if {words} (--map)"
        for recording, (_, words) in zip(problem.recordings, best, strict=True)
        if words
    ]
