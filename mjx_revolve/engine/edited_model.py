"""Numbers of a MuJoCo model that a user has edited, in place of those of the assembly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import mujoco
import numpy as np

from mjx_revolve.engine.assembly import Assembly
from mjx_revolve.engine.step_constants import (
    LIMIT_OVERSHOOT,
    NO_LIMIT,
    StepConstants,
    motor_line,
)
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.numerics.spatial import quat_to_matrix

# What an edit must leave as it is: the tables of water and contact follow from it.
_FIXED = (
    *("body_parentid", "body_pos", "body_quat", "body_jntadr", "jnt_pos", "jnt_axis"),
    # Forces that our step does not have.
    *("jnt_stiffness", "dof_frictionloss", "actuator_gear", "qpos_spring", "body_gravcomp"),
    *("jnt_actfrclimited", "jnt_actfrcrange", "actuator_dyntype", "actuator_gaintype"),
    # What our step takes from the robot.
    *("qpos0", "actuator_trnid", "actuator_biastype", "jnt_type"),
    *("jnt_stiffnesspoly", "dof_dampingpoly"),  # of newer MuJoCo
)
# What it must leave as it is of a thruster, and of the site where it pushes.
_THRUST = ("dynprm", "gainprm", "ctrlrange", "ctrllimited", "forcerange", "forcelimited")
_SITE = ("pos", "quat", "bodyid")
# Numbers that must be finite: any, above 0, and not below 0.
_ANY = ("body_ipos", "body_iquat", "actuator_gainprm", "actuator_biasprm")
_POSITIVE, _NOT_NEGATIVE = ("body_mass", "body_inertia"), ("dof_armature", "dof_damping")
_COUNTS = ("nbody", "nq", "nv", "nu", "neq", "ntendon")


def check_edit(model: mujoco.MjModel, built: mujoco.MjModel, name: str) -> None:
    """Refuses an edited model with other bodies, hinges or actuators.

    Args:
        model: the edited one.
        built: the robot's.
        name: of the robot.

    Raises:
        InputError: it differs in more than masses, inertias, hinges and servos, or a number of
            these is none that a robot can have.
    """
    thrust = built.actuator_trntype == mujoco.mjtTrn.mjTRN_SITE
    at = built.actuator_trnid[thrust, 0]

    def fixed(m: mujoco.MjModel) -> dict[str, Any]:
        """Numbers that an edit must leave as they are."""
        found = {x: getattr(m, x) for x in _FIXED if hasattr(m, x)}
        found |= {f"opt.{x}": getattr(m.opt, x) for x in ("timestep", "gravity", "disableflags")}
        found |= {f"{x} of the core": getattr(m, x)[:6] for x in ("dof_armature", "dof_damping")}
        found["actuator_biasprm"] = m.actuator_biasprm[:, 0]
        found["actuator_gainprm"] = m.actuator_gainprm[:, 1:]
        push = {f"actuator_{x}": thrust for x in _THRUST} | {f"site_{x}": at for x in _SITE}
        return found | {f"{x} of a thruster": getattr(m, x)[rows] for x, rows in push.items()}

    changed = [x for x in _COUNTS if getattr(model, x) != getattr(built, x)]
    if not changed:
        pairs = zip(fixed(model).items(), fixed(built).values(), strict=True)
        changed = [x for (x, new), old in pairs if not np.allclose(new, old, atol=1e-9)]
    if changed:
        expected = "other masses, inertias, hinges or servos only"
        found = f"another {', '.join(changed)} (edit the morphology or the world instead)"
        raise InputError(f"model of {name!r}", expected, found)
    for x in (*_ANY, *_POSITIVE, *_NOT_NEGATIVE):
        numbers = getattr(model, x)
        fits, wanted = np.isfinite(numbers).all(), "finite numbers"
        if x in _POSITIVE:  # the world, the first body, has none
            fits, wanted = fits and (numbers[1:] > 0).all(), f"{wanted} > 0"
        elif x in _NOT_NEGATIVE:
            fits, wanted = fits and (numbers >= 0).all(), f"{wanted} >= 0"
        if not fits:
            raise InputError(f"model of {name!r}: {x}", wanted, show(numbers.ravel().tolist()))
    speeds = model.jnt_user[1:, 0]  # of the hinges; the core's joint has none
    if not np.all(speeds > 0):
        expected, found = "top speeds > 0, infinite for none", show(speeds.tolist())
        raise InputError(f"model of {name!r}: jnt_user", expected, found)
    limits = {
        "jnt_range": "jnt_limited",
        "actuator_forcerange": "actuator_forcelimited",
        "actuator_ctrlrange": "actuator_ctrllimited",
    }
    for x, limited in limits.items():
        low, high = getattr(model, x)[getattr(model, limited).astype(bool)].T
        if not np.all(low < high):
            found = show(getattr(model, x).tolist())
            raise InputError(f"model of {name!r}: {x}", "the lowest below the highest", found)


def edited_assembly(assembly: Assembly, model: mujoco.MjModel, servos: Sequence[int]) -> Assembly:
    """An assembly of one robot with the masses, inertias, hinges' ranges and springs of a model."""
    axes = quat_to_matrix(model.body_iquat)
    joint, reach = model.body_jntadr[2:], assembly.range.copy()
    # A hinge that an edit frees of its limits has no end stop, not even where neighbours meet.
    limited = model.jnt_limited[joint].astype(bool)[:, None]
    reach[2:] = np.where(limited, model.jnt_range[joint], reach[2:])
    dof, act = model.jnt_dofadr[joint], _servos_of(model, servos)

    def filled(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        return np.concatenate([old[:2], new]) if servos else old

    edited = replace(
        assembly,
        mass=model.body_mass.copy(),
        center=model.body_ipos.copy(),
        inertia=np.einsum("bij,bj,bkj->bik", axes, model.body_inertia, axes),
        inertia_axes=axes,
        range=reach,
        damping=filled(assembly.damping, model.dof_damping[dof]),
        stiffness=filled(assembly.stiffness, -model.actuator_biasprm[act, 1]),
    )
    return edited.with_split_springs(filled(np.zeros(len(reach)), model.dof_armature[dof]))


def _servos_of(model: mujoco.MjModel, servos: Sequence[int]) -> np.ndarray:
    """The actuators of the hinges, in the order of the bodies that these carry."""
    servo = {int(model.actuator_trnid[k, 0]): k for k in servos}
    return np.array([servo[int(j)] for j in model.body_jntadr[2:]], int)


def edited_constants(
    constants: StepConstants, model: mujoco.MjModel, servos: Sequence[int]
) -> StepConstants:
    """The constants of one robot with the hinges and servos of a model.

    Args:
        constants: of the assembly with the model's masses, ranges and springs.
        model: the edited one.
        servos: its actuators that turn hinges.

    Returns:
        The constants; those of the world and the root, which have no hinge, as they were.
    """
    if not servos:
        return constants
    joint = model.body_jntadr[2:]
    act = _servos_of(model, servos)
    dof = model.jnt_dofadr[joint]
    effort = _limits(model.actuator_forcerange[act], model.actuator_forcelimited[act])
    target = _limits(model.actuator_ctrlrange[act], model.actuator_ctrllimited[act])
    stops = np.stack([np.asarray(x, float)[2:] for x in constants.hinges.range], 1)
    limits = _limits(stops, model.jnt_limited[joint])
    strong = np.where(np.isfinite(effort[:, 1]), effort[:, 1], 1.0)
    ours = constants.hinges
    edited = {
        "armature": model.dof_armature[dof],
        "gain": model.actuator_gainprm[act, 0],
        "servo_damping": -model.actuator_biasprm[act, 2],
        "effort": tuple(np.clip(effort, -NO_LIMIT, NO_LIMIT).T),  # 0 times infinity is no gradient
        "target": tuple(target.T),
        "range": tuple(limits.T),
        "stop": strong / LIMIT_OVERSHOOT,
        "motor": motor_line(model.jnt_user[joint, 0], effort[:, 1], model.dof_damping[dof]),
    }
    built = {name: getattr(ours, name) for name in edited}

    def filled(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        """A column, behind the numbers of the world and the root."""
        return np.concatenate([np.asarray(old, float)[:2], new])

    return constants._replace(hinges=ours._replace(**jax.tree.map(filled, built, edited)))


def _limits(ranges: np.ndarray, limited: np.ndarray) -> np.ndarray:
    """`[n, 2]` ranges, infinite where there are none."""
    return np.where(limited.astype(bool)[:, None], ranges, [-np.inf, np.inf])
