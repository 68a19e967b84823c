"""Recordings of robots whose coefficients are known: simulated, sampled, and made as bad as real ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.simulate import simulate
from mjx_revolve.fitting.parameters import read_free, split_free, with_values
from mjx_revolve.fitting.recording import Recording, Signal
from mjx_revolve.water.flow import Water


def record_motion(
    robot: Robot,
    ctrl: np.ndarray,
    *,
    rate: float = 30.0,
    position_noise: float = 0.005,
    attitude_noise: float = np.pi / 180,
    current: Sequence[float] = (0.0, 0.0, 0.0),
    qvel: np.ndarray | None = None,
    seed: int = 0,
    name: str = "synthetic",
) -> Recording:
    """A recording of what a robot does under commands.

    Args:
        robot: with the coefficients that are to be found.
        ctrl: `[T, nu]` commands, a row for each step of its world.
        rate: of frames [Hz].
        position_noise: standard deviation of each coordinate [m].
        attitude_noise: of the rotation about each axis [rad].
        current: of the water [m/s].
        qvel: `[nv]` velocities at the start; at rest by default.
        seed: of the noise.
        name: of the recording.
    """
    import jax

    with jax.enable_x64(True):
        water = Water(robot.world.surface_height, tuple(map(float, current)))
        found = simulate(robot, ctrl, qvel=qvel, water=water)
    draw, dt = np.random.default_rng(seed), robot.world.timestep
    step_time = np.asarray(found.time, float)
    time = np.arange(step_time[0], step_time[-1], 1 / rate)
    qpos = np.asarray(found.qpos, float)
    flat = np.stack([np.interp(time, step_time, column) for column in qpos.T], -1)
    place = flat[:, :3] + position_noise * draw.normal(size=(len(time), 3))
    turn = Rotation.from_quat(flat[:, 3:7], scalar_first=True)
    noisy = turn * Rotation.from_rotvec(attitude_noise * draw.normal(size=(len(time), 3)))
    columns = np.concatenate([place, noisy.as_quat(scalar_first=True)], 1)
    names = ("x", "y", "z", "qw", "qx", "qy", "qz")
    signals = {n: Signal(time, x) for n, x in zip(names, columns.T, strict=True)}
    modules = robot.morphology.modules
    actuators = [robot.mj_model.actuator(k).name for k in range(robot.mj_model.nu)]
    begun = dt * np.arange(len(ctrl))
    known = {m.name for m in modules}
    for k, actuator in enumerate(actuators):
        assert actuator in known
        signals[f"command.{actuator}"] = Signal(begun, np.asarray(ctrl)[:, k])
    return Recording(name, signals)
