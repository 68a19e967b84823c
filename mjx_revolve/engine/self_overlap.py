"""How deep modules of one robot overlap while it moves."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mjx_revolve.engine.kinematics import body_poses
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.self_pairs import candidate_pairs
from mjx_revolve.numerics.boxes import box_gap, pair_of

# Configurations times pairs that are compared at a time, for memory's sake.
_BLOCK = 200_000


class SelfOverlap(NamedTuple):
    """The deepest overlap of modules of a robot over time.

    Attributes:
        depth: `[T]` [m]; 0 where none overlap.
        first: `[T]` index of the one module, -1 for none.
        second: `[T]` index of the other module, -1 for none.
    """

    depth: Float[np.ndarray, " T"]
    first: Int[np.ndarray, " T"]
    second: Int[np.ndarray, " T"]


def self_overlap(robot: Robot, qpos: Float[np.ndarray, "T nq"]) -> SelfOverlap:
    """How deep modules of a robot overlap, exactly: by the 15 separating axes of their main boxes.

    Compared are parts of different rigid bodies, but for those of a rigid body and of the one that
    carries it by a hinge, and for modules that are built into each other.

    Args:
        robot: from `build_robot`.
        qpos: of a trajectory.

    Returns:
        The deepest overlap at each time.
    """
    table, pairs = robot.fluid, candidate_pairs(robot.assembly)
    qpos = np.asarray(qpos, np.float64)
    depth, which = np.zeros(len(qpos)), np.full(len(qpos), -1)
    radius = np.linalg.norm(table.half_size, axis=1)
    i, j = pairs.T
    step = max(1, _BLOCK // max(len(pairs), 1))
    for start in range(0, len(qpos) if len(pairs) else 0, step):
        rows = qpos[start : start + step]
        poses: Any = body_poses(robot, rows)  # type: ignore[arg-type]  # of NumPy's arrays
        position, rotation = poses
        turn = rotation[:, table.body] @ table.rotation
        center = position[:, table.body]
        center = center + (rotation[:, table.body] @ table.position[:, :, None])[..., 0]
        near = np.linalg.norm(center[:, j] - center[:, i], axis=2) < radius[i] + radius[j]
        t, k = np.nonzero(near)
        a, b = i[k], j[k]
        pair = pair_of(
            center[t, a], turn[t, a], table.half_size[a],
            center[t, b], turn[t, b], table.half_size[b],
        )  # fmt: skip
        gap = np.zeros(near.shape)
        gap[near] = box_gap(pair)
        deepest = np.argmin(gap, 1)
        found = -gap[np.arange(len(rows)), deepest]
        depth[start : start + step] = np.maximum(found, 0)
        which[start : start + step] = np.where(found > 0, deepest, -1)
    modules = np.append(pairs, [[0, 0]], 0)[which]
    first, second = np.where(which[:, None] < 0, -1, table.module[modules]).T
    return SelfOverlap(depth, first, second)
