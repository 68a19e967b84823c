"""Recordings of robots with known coefficients: simulated, with the errors of real recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from mjx_revolve.engine.robot import Robot
from mjx_revolve.fitting.problem import FitSettings, make_problem
from mjx_revolve.fitting.recording import RobotRecording, TimeSeries, sent_commands
from mjx_revolve.inputs.errors import InputError

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


def simulate_signals(
    robot: Robot,
    free: Sequence[str] = ("drag",),
    offsets: Sequence[float] | np.ndarray = (0.0,),
    ctrl: np.ndarray | None = None,
    current: Sequence[float] = (0.0, 0.0),
    velocity: Sequence[float] = (0.0,) * 6,
    duration: float = 5.0,
) -> dict[str, TimeSeries]:
    """What a robot does from rest, 1 m deep, by the program that fits use.

    Its hinges begin at their first commands, as in fits.

    Args:
        robot: with its usual numbers.
        free: names of those that are others.
        offsets: of them from their priors' medians (logarithms of factors).
        ctrl: `[T, nu]` commands, MuJoCo's order, a row for each step; none for `duration`.
        current: of the water beside the world's, horizontal [m/s].
        velocity: of the core at first: world frame [m/s], turning in its own [rad/s].
        duration: without commands [s].

    Returns:
        Pose and commands by signal.
    """
    if any(current[2:]):
        raise InputError("current", "a horizontal one", list(current))
    dt = robot.world.timestep
    count = round(duration / dt) if ctrl is None else len(ctrl)
    time = dt * np.arange(count + 1)
    still = TimeSeries(time[[0, -1]], np.zeros(2))
    signals = dict.fromkeys(("x", "y", "z", "yaw", "roll", "pitch"), still)
    commands = {} if ctrl is None else sent_commands(robot, ctrl)
    settings = FitSettings(window=float(time[-1]), held_out=0.0)
    whole = RobotRecording("simulated", signals | commands)
    problem = make_problem(robot, [whole], [*free, "current"], settings)
    problem.roots[0, 2] = robot.world.surface_height - 1.0
    problem.roots[0, 7:, 0] = velocity
    point = problem.origin()
    point.free[:] = offsets
    point.local[0] = current[:2]
    pieces = problem.simulate([point])[0, 0]
    track = np.concatenate([pieces[0], *pieces[1:, 1:]])
    at = problem.every * dt * np.arange(len(track))
    return commands | {n: TimeSeries(at, x) for n, x in zip(_POSE, track.T[:7], strict=True)}


def make_noisy(
    signals: Mapping[str, TimeSeries],
    rate: float = 30.0,
    position: float = 0.005,
    attitude: float = np.pi / 180,
    lost: float = 0.0,
    seed: int = 0,
    name: str = "synthetic",
) -> RobotRecording:
    """A recording as a camera would have made it.

    Args:
        signals: from `simulate_signals`.
        rate: of frames [Hz].
        position: standard deviation of the noise of each coordinate [m].
        attitude: of the rotation about each axis [rad].
        lost: share of frames that are lost.
        seed: of the noise.
        name: of the recording.
    """
    draw = np.random.default_rng(seed)
    known = signals["x"].time
    time = np.arange(known[0], known[-1], 1 / rate)
    time = time[(draw.random(len(time)) >= lost) | (time == time[0])]
    flat = np.stack([np.interp(time, *signals[n]) for n in _POSE], -1)
    flat[:, :3] += position * draw.normal(size=(len(time), 3))
    turn = Rotation.from_quat(flat[:, 3:], scalar_first=True)
    turn *= Rotation.from_rotvec(attitude * draw.normal(size=(len(time), 3)))
    flat[:, 3:] = turn.as_quat(scalar_first=True)
    seen = {n: TimeSeries(time, x) for n, x in zip(_POSE, flat.T, strict=True)}
    return RobotRecording(name, {**signals, **seen})
