"""Recordings simulated, many variants of a robot at once, window after window.

One compiled program steps a lane for each variant of each recording through all of it. Where a
window begins anew, the core is put where it was recorded, while hinges and thrusters' lags go on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.variants import Variants
from mjx_revolve.episodes.rollout import Rollout, RolloutState, StepInputs, open_loop
from mjx_revolve.numerics.xla import jit
from mjx_revolve.water.flow import Water

ROOT = 13
"""Numbers of a core's state: position, quaternion, velocity (world), angular velocity (body)."""


@dataclass(frozen=True)
class Drive:
    """What is given of all recordings; K windows of N steps, R recordings.

    Attributes:
        resets: `[K, R]` whether a window begins anew.
        angles: `[hinges, R]` at the start [rad].
        speeds: of the same hinges [rad/s].
        ctrl: `[K, N, nu, 2, R]` the robot's own order: as given, and a little later.
        later: `[V]` which variants have the later one.
        begin: `[R]` times of the waves at the start [s].
    """

    resets: np.ndarray
    angles: np.ndarray
    speeds: np.ndarray
    ctrl: np.ndarray
    later: np.ndarray
    begin: np.ndarray


@lru_cache(maxsize=8)
def _program(variants: Variants, lanes: int, steps: int, every: int) -> Any:
    """The jitted simulation of `lanes` variants of each recording."""
    world = variants.tree.world

    def run(
        numbers: PyTree, roots: PyTree, resets: PyTree, angles: PyTree, speeds: PyTree,
        ctrl: PyTree, later: PyTree, current: PyTree, begin: PyTree,
    ) -> PyTree:  # fmt: skip
        count = roots.shape[-1]
        wide = lambda x: jnp.broadcast_to(x[..., None, :], (*x.shape[:-1], lanes, x.shape[-1]))  # noqa: E731
        flat = lambda x: x.reshape(*x.shape[:-2], lanes * count)  # noqa: E731
        numbers = [flat(jnp.broadcast_to(x[..., None], (*x.shape, count))) for x in numbers]
        engine = variants.engine(numbers)
        water = Water(world.surface_height, tuple(flat(current)), time=flat(wide(begin)))
        rollout = Rollout(engine, open_loop, world, water)
        first = flat(roots[0])
        qpos = jnp.concatenate([first[:7], flat(wide(angles))])
        qvel = jnp.concatenate([first[7:], flat(wide(speeds))])

        def record(now: RolloutState, ctrl: PyTree, water: Water) -> PyTree:
            root = engine.root(now.state)
            angles = engine.tree.tree_to_joints(now.state.angle, root.position[0])
            pose = (*root.position, *root.quat)
            return jnp.stack([*pose, *root.velocity, *root.angular_velocity, *angles])

        def window(now: RolloutState, given: PyTree) -> PyTree:
            root, reset, ctrl = given
            fresh = flat(wide(reset[None]))[0]
            put = lambda a, b: tuple(jnp.where(fresh, y, x) for x, y in zip(a, b, strict=True))  # noqa: E731
            root, state = tuple(flat(root)), now.state
            state = state._replace(
                position=put(state.position, root[:3]),
                quat=put(state.quat, root[3:7]),
                velocity=put(state.velocity, root[7:10]),
                angular_velocity=put(state.angular_velocity, root[10:]),
            )
            now = now._replace(state=state)
            start = record(now, None, water)
            command = flat(jnp.where(later[:, None], ctrl[:, :, 1, None], ctrl[:, :, 0, None]))
            inputs = StepInputs(ctrl=command[:, engine.plant.source[:, 0]])
            now, records = rollout.advance(now, record, steps // every, every, inputs)
            return now, jnp.concatenate([start[None], records])

        now = rollout.init(engine.init(qpos, qvel))
        _, tracks = jax.lax.scan(window, now, (roots, resets, ctrl))
        return tracks.reshape(*tracks.shape[:3], lanes, count)

    return jit(run, fast=True)


def simulate_windows(
    variants: Variants,
    robots: Sequence[Robot],
    drive: Drive,
    roots: np.ndarray,
    current: np.ndarray,
    every: int,
) -> np.ndarray:
    """Simulates variants of all recordings.

    Args:
        variants: of the robots.
        robots: V of them.
        drive: what is given.
        roots: `[K, 13, V, R]` states of the core where windows begin.
        current: `[3, V, R]` [m/s].
        every: steps between records.

    Returns:
        `[V, R, K, 1 + N / every, 13 + hinges]` the core's states and the hinges' angles, at the
        beginning of each window and after every `every` steps of it.
    """
    steps = drive.ctrl.shape[1]
    with jax.enable_x64(True):
        run = _program(variants, len(robots), steps, every)
        given = (variants.stack(robots), roots, drive.resets, drive.angles, drive.speeds,
                 drive.ctrl, drive.later, current, drive.begin)  # fmt: skip
        found = np.asarray(run(*given))
    return np.moveaxis(found, (3, 4), (0, 1))
