"""What a user has changed in a robot's compiled MuJoCo model: the engines heed it.

MJX takes the model as it is. The population step takes its numbers from the assembly, so that
nothing has to be compiled; where there is a model, what differs in it from the assembly was changed
by hand, and counts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mjx_revolve.engine.assembly import Assembly
from mjx_revolve.engine.columns import LIMIT_OVERSHOOT, Columns, motor_line
from mjx_revolve.engine.robot import Robot
from mjx_revolve.numerics.spatial import quat_to_rows

# Numbers nearer to each other than this are the same but for rounding.
_SAME = 1e-9


def changed_assembly(robot: Robot) -> Assembly:
    """The assembly of a robot, with masses and inertias as its model has them.

    Args:
        robot: compiled by MuJoCo or not.

    Returns:
        The assembly; its very own one where nothing was changed.
    """
    ours = robot.assembly
    if not robot.is_compiled:
        return ours
    m = robot.mj_model
    axes = np.stack([np.stack(row, -1) for row in quat_to_rows(tuple(m.body_iquat.T))], 1)
    inertia = np.einsum("bij,bj,bkj->bik", axes, m.body_inertia, axes)
    found: dict[str, Any] = {"mass": m.body_mass, "center": m.body_ipos, "inertia": inertia}
    differing = {n: x.copy() for n, x in found.items() if not _same(x, getattr(ours, n))}
    return replace(ours, **differing) if differing else ours


def changed_columns(robot: Robot, columns: Columns) -> Columns:
    """The columns of one robot, with hinges and servos as its model has them.

    Args:
        robot: compiled by MuJoCo or not.
        columns: as the assembly has them.

    Returns:
        The columns, in which only what was changed differs.
    """
    if not robot.is_compiled or not robot.num_hinges:
        return columns
    m, ours = robot.mj_model, columns.hinges
    joint = m.body_jntadr[2:]
    servo = {int(m.actuator_trnid[k, 0]): k for k in robot.servos}
    act = np.array([servo[int(j)] for j in joint], int)
    effort = _limits(m.actuator_forcerange[act], m.actuator_forcelimited[act])
    target = _limits(m.actuator_ctrlrange[act], m.actuator_ctrllimited[act])
    limits = _limits(m.jnt_range[joint], m.jnt_limited[joint])
    damping = m.dof_damping[m.jnt_dofadr[joint]]
    strong = np.where(np.isfinite(effort[:, 1]), effort[:, 1], 1.0)
    found: dict[str, Any] = {
        "armature": m.dof_armature[m.jnt_dofadr[joint]],
        "damping": damping,
        "gain": m.actuator_gainprm[act, 0],
        "stiffness": -m.actuator_biasprm[act, 1],
        "servo_damping": -m.actuator_biasprm[act, 2],
        "effort": tuple(effort.T),
        "target": tuple(target.T),
        "range": tuple(limits.T),
        "stop": strong / LIMIT_OVERSHOOT,
        "motor": motor_line(m.jnt_user[joint, 0], effort[:, 1], damping),
    }
    changes: dict[str, Any] = {}
    for name, x in found.items():
        old = getattr(ours, name)
        one = not isinstance(old, tuple)
        olds, news = ((old,), (x,)) if one else (old, x)
        if all(_same(new, o[2:]) for new, o in zip(news, olds, strict=True)):
            continue
        whole = []
        for new, o in zip(news, olds, strict=True):
            whole.append(np.array(o, float))
            whole[-1][2:] = new
        changes[name] = whole[0] if one else tuple(whole)
    return columns._replace(hinges=ours._replace(**changes)) if changes else columns


def _limits(ranges: np.ndarray, limited: np.ndarray) -> np.ndarray:
    """`[n, 2]` ranges, infinite where there are none."""
    return np.where(limited.astype(bool)[:, None], ranges, [-np.inf, np.inf])


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.allclose(a, b, rtol=_SAME, atol=_SAME * _SAME))
