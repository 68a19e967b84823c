"""All numbers that the step needs of a compiled robot, one column for each body, part and point.

Read once from the MuJoCo model and the fluid table, for all bodies at a time; `pick` then takes the
columns of any bodies as the constants of a `Level`. Each kind of column ends, or for bodies begins,
with one that stands for nothing: what rows and levels are padded with.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from mjx_revolve.engine.level import (
    Hinges,
    InertiaBox,
    Laws,
    Level,
    Mounts,
    Parts,
    Points,
)
from mjx_revolve.engine.robot import Robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.inertia import SpatialInertia
from mjx_revolve.numerics.spatial import SYM, clean
from mjx_revolve.water.drag import ellipsoid_constants
from mjx_revolve.water.lift_drag import PlateTable

# Stiffness of a joint's end stop, as full effort per this overshoot [rad]. A choice: stiff enough
# to keep within half a degree of the real range; the step treats it implicitly, so it is stable.
LIMIT_OVERSHOOT = 0.008
# Share of its top speed up to which a servo gives its full effort [-]. A choice, between the
# straight line of a bare motor (0) and Revolve's box of effort and speed (1).
KNEE = 0.75
# A hinge of this inertia does not move [kg·m²]: that is how riders and padding are held.
LOCKED = 1e30
# Stands for infinity where arithmetic must stay finite.
_FAR = 1e30


class Columns(NamedTuple):
    """Leaves are NumPy arrays, component by component.

    Attributes:
        hinges: `[nbody]`, by MuJoCo's bodies; 0, the world, is nothing, and so is the root's.
        bodies: `[nbody]` mass, moment and inertia, and the inertia box or None.
        parts: `[npart + 1]` a `Parts` of all laws, in the order of the fluid table.
        points: `[npoint + 1]` (position, mass share), or None without a bed.
        laws: `[npart]` of the parts.
        part_body: `[npart]` MuJoCo's bodies that carry them.
        point_body: `[npoint]` likewise.
        parent: `[nbody]` MuJoCo's parents.
        frame: `[nbody, 3, 3]` MuJoCo's body frame from ours, whose z is the hinge.
    """

    hinges: Hinges
    bodies: tuple[Any, ...]
    parts: Parts
    points: Any
    laws: tuple[Laws, ...]
    part_body: np.ndarray
    point_body: np.ndarray
    parent: np.ndarray
    frame: np.ndarray


# ------------------------------------------------------------------ small algebra on columns


def _rotations(quats: np.ndarray) -> np.ndarray:
    """`[n, 4]` unit quaternions to `[n, 3, 3]`."""
    found = np.zeros((len(quats), 9))
    for matrix, quat in zip(found, quats, strict=True):
        mujoco.mju_quat2Mat(matrix, quat)
    return clean(found.reshape(-1, 3, 3))


def _skews(r: np.ndarray) -> np.ndarray:
    """`[n, 3]` to `[n, 3, 3]`."""
    found = np.zeros((len(r), 3, 3))
    found[:, [1, 2, 0], [2, 0, 1]] = -r[:, [0, 1, 2]]
    found[:, [2, 0, 1], [1, 2, 0]] = r[:, [0, 1, 2]]
    return found


def _z_frame(axis: np.ndarray) -> np.ndarray:
    """A rotation whose third column is the axis; a permutation where the axis allows it."""
    axis = axis / np.linalg.norm(axis)
    k = int(np.argmax(np.abs(axis)))
    if abs(abs(axis[k]) - 1) < 1e-12:
        frame = np.eye(3)[:, [(k + 1) % 3, (k + 2) % 3, k]]
        return frame * np.sign(axis[k]) if axis[k] > 0 else frame @ np.diag([1.0, -1.0, -1.0])
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], 1)


def _vec(x: np.ndarray) -> Any:
    x = clean(x)
    return tuple(x[:, i] for i in range(3))


def _mat(x: np.ndarray) -> Any:
    x = clean(x)
    return tuple(tuple(x[:, i, j] for j in range(3)) for i in range(3))


def _sym(x: np.ndarray) -> Any:
    x = np.where(np.abs(x) < 1e-15, 0, x)
    return tuple(x[:, i, j] for i, j in SYM)


def _end(x: Any, blank: Any) -> np.ndarray:
    """A column more, that stands for nothing."""
    x = np.asarray(x)
    return np.concatenate([x, np.broadcast_to(np.asarray(blank, x.dtype), (1, *x.shape[1:]))])


# ------------------------------------------------------------------ reading


def read_columns(robot: Robot) -> Columns:
    """Reads the columns of a robot.

    Args:
        robot: compiled.

    Returns:
        The columns.

    Raises:
        InputError: the model holds a joint that the population step cannot do; it is named.
    """
    frame = _frames(robot)
    points, touching = None, np.zeros(0, int)
    if robot.world.bed is not None:
        touching = robot.contact_body
        place = np.einsum("pji,pj->pi", frame[touching], robot.contact_position)
        count = np.maximum(np.bincount(touching, minlength=robot.mj_model.nbody), 1)
        share = (robot.mj_model.body_mass / count)[touching]
        # A padded point has no mass, so its spring, damper and friction vanish.
        points = (_vec(_end(place.reshape(-1, 3), 0.0)), _end(share, 0.0))
    table = robot.fluid
    pushing = np.isin(np.arange(len(table.volume)), robot.thruster_row)
    return Columns(
        hinges=_read_hinges(robot, frame),
        bodies=_read_bodies(robot, frame),
        parts=_read_parts(robot, frame),
        points=points,
        laws=tuple(map(Laws, table.buoyancy, table.drag, pushing.tolist())),
        part_body=table.body,
        point_body=touching,
        parent=robot.mj_model.body_parentid,
        frame=frame,
    )


def _frames(robot: Robot) -> np.ndarray:
    """`[nbody, 3, 3]` MuJoCo's body frame from ours."""
    m = robot.mj_model
    frame = np.broadcast_to(np.eye(3), (m.nbody, 3, 3)).copy()
    driven = {int(m.actuator_trnid[k, 0]) for k in robot.servos}
    for body in range(1, m.nbody):
        name, joint = m.body(body).name, int(m.body_jntadr[body])
        kind = m.jnt_type[joint] if m.body_jntnum[body] == 1 else None
        if body == 1 and kind == mujoco.mjtJoint.mjJNT_FREE:
            continue
        if body == 1 or kind != mujoco.mjtJoint.mjJNT_HINGE or np.any(m.jnt_pos[joint]):
            raise InputError(
                f"engine population: body {name!r}: expected one hinge at the body's origin below "
                "one free root; use engine: mjx"
            )
        if joint not in driven:
            raise InputError(f"engine population: joint {name!r}: expected a servo; found none")
        frame[body] = _z_frame(m.jnt_axis[joint])
    return frame


def _read_hinges(robot: Robot, frame: np.ndarray) -> Hinges:
    m = robot.mj_model
    moving = np.arange(2, m.nbody)
    joint = m.body_jntadr[moving]
    servo = {int(m.actuator_trnid[k, 0]): k for k in robot.servos}
    act = np.array([servo[int(j)] for j in joint], int)
    dof = m.jnt_dofadr[joint]
    up = frame[m.body_parentid[moving]].swapaxes(1, 2)
    # At rest, ours of the child seen from ours of the parent.
    rest = up @ _rotations(m.body_quat[moving]) @ frame[moving]
    toward = np.array([_z_frame(x) for x in clean(rest[:, :, 2])]).reshape(-1, 3, 3)
    offset = np.einsum("bji,bj->bi", toward, rest[:, :, 0])[:, :2]
    effort = _limits(m.actuator_forcerange[act], m.actuator_forcelimited[act])
    target = _limits(m.actuator_ctrlrange[act], m.actuator_ctrllimited[act])
    limits = _limits(m.jnt_range[joint], m.jnt_limited[joint])
    strong = np.where(np.isfinite(effort[:, 1]), effort[:, 1], 1.0)
    top = m.jnt_user[joint, 0] if m.nuser_jnt else np.full(len(joint), np.inf)
    damping = m.dof_damping[dof]

    def column(x: np.ndarray, blank: Any) -> np.ndarray:
        """With the world's and the root's, which are nothing."""
        none = np.broadcast_to(np.asarray(blank, float), (2, *x.shape[1:]))
        return np.concatenate([none, x])

    pair = lambda x, low, high: (column(x[:, 0], low), column(x[:, 1], high))  # noqa: E731
    motor = motor_line(top, effort[:, 1], damping)
    return Hinges(
        rotation=_mat(column(toward, np.eye(3))),
        offset=pair(clean(offset), 1.0, 0.0),
        position=_vec(column(np.einsum("bij,bj->bi", up, m.body_pos[moving]), 0.0)),
        armature=column(m.dof_armature[dof], LOCKED),
        damping=column(damping, 0.0),
        gain=column(m.actuator_gainprm[act, 0], 0.0),
        stiffness=column(-m.actuator_biasprm[act, 1], 0.0),
        servo_damping=column(-m.actuator_biasprm[act, 2], 0.0),
        effort=pair(effort, 0.0, 0.0),
        target=pair(target, 0.0, 0.0),
        range=pair(limits, -_FAR, _FAR),
        stop=column(strong / LIMIT_OVERSHOOT, 0.0),
        motor=(column(motor[0], _FAR), column(motor[1], 0.0), column(motor[2], 1.0)),
        base_inertia=column(_base_inertias(robot)[2:], 1.0),
    )


def _limits(ranges: np.ndarray, limited: np.ndarray) -> np.ndarray:
    """`[n, 2]` ranges, infinite where there are none."""
    return np.where(limited.astype(bool)[:, None], ranges, [-np.inf, np.inf])


def motor_line(top: Any, effort: Any, damping: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The line between speed and torque near the top speed; see `servos.servo`.

    Args:
        top: the top speed [rad/s]; infinite for none.
        effort: the largest torque [N·m].
        damping: of the hinge [N·m·s/rad].

    Returns:
        Torque at the top speed [N·m], slope [N·m·s/rad], top speed [rad/s]; where there is no
        limit, the line lies far above any torque.
    """
    limited = np.isfinite(top) & np.isfinite(effort)
    speed = np.where(limited, top, 1.0)
    friction = np.where(limited, damping * speed, _FAR)
    slope = np.maximum((np.where(limited, effort, 0) - friction) / ((1 - KNEE) * speed), 0)
    return friction, np.where(limited, slope, 0.0), speed


def _base_inertias(robot: Robot) -> np.ndarray:
    """For each body, the inertia about its hinge's axis of all that the hinge does not move.

    Bodies and the water that they carry, at rest; `[nbody]` [kg·m²].
    """
    m, table, density = robot.mj_model, robot.fluid, robot.world.density
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    turns = data.xmat.reshape(-1, 3, 3)
    # Bodies and parts alike: whose, centre, axes, mass and inertia along the axes.
    body = np.concatenate([np.arange(1, m.nbody), table.body])
    at = np.einsum("pij,pj->pi", turns[table.body], table.position)
    center = np.concatenate([data.xipos[1:], data.xpos[table.body] + at])
    axes = np.concatenate([data.ximat[1:].reshape(-1, 3, 3), turns[table.body] @ table.rotation])
    mass = np.concatenate([np.repeat(m.body_mass[1:, None], 3, 1), density * table.carried_mass])
    inertia = np.concatenate([m.body_inertia[1:], density * table.carried_inertia])
    moved = np.eye(m.nbody, dtype=bool)
    for c in range(2, m.nbody):
        moved[:, c] |= moved[:, m.body_parentid[c]]
    axis, anchor = data.xaxis[m.body_jntadr], data.xpos
    arm = np.cross(axis[:, None], center[None] - anchor[:, None])
    swing = np.einsum("pji,bpj->bpi", axes, arm)
    turn = np.einsum("pji,bj->bpi", axes, axis)
    about = np.sum(mass * swing**2 + inertia * turn**2, -1)
    return np.sum(np.where(moved[:, body], 0.0, about), 1)


def _read_bodies(robot: Robot, frame: np.ndarray) -> tuple[Any, ...]:
    """Mass, moment, inertia about the origin, and the inertia box."""
    m = robot.mj_model
    back = frame.swapaxes(1, 2)
    center = np.einsum("bij,bj->bi", back, m.body_ipos)
    axes = back @ _rotations(m.body_iquat)
    x = _skews(center)
    inertia = np.einsum("bij,bj,bkj->bik", axes, m.body_inertia, axes)
    inertia = inertia - m.body_mass[:, None, None] * (x @ x)
    box = None
    if robot.world.drag == "inertia_box":
        # MuJoCo: a uniform box of the same mass and principal inertia.
        i = m.body_inertia
        edges = np.maximum(i[:, [1, 0, 0]] + i[:, [2, 2, 1]] - i, 0)
        size = np.sqrt(6 * edges / np.maximum(m.body_mass, 1e-30)[:, None])
        box = InertiaBox(_mat(axes), _vec(center), _vec(size))
    return m.body_mass.copy(), _vec(m.body_mass[:, None] * center), _sym(inertia), box


def _read_parts(robot: Robot, frame: np.ndarray) -> Parts:
    """All parts, with the numbers of every law that any of them obeys."""
    table, world = robot.fluid, robot.world
    back = frame[table.body].swapaxes(1, 2)
    turn = clean(back @ table.rotation)
    position = np.einsum("pij,pj->pi", back, table.position)
    center = position + np.einsum("pij,pj->pi", turn, table.center_of_volume)
    # The part's axes in the frame that describes it: the body's where both have the same.
    square = np.all((turn == 0) | (np.abs(turn) == 1), (1, 2))
    swap = np.where(square[:, None, None], turn, np.eye(3))
    along = lambda x: np.einsum("pij,pj->pi", swap, x)  # noqa: E731
    size = lambda x: np.einsum("pij,pj->pi", np.abs(swap), x)  # noqa: E731
    drags = set(table.drag)
    linear = world.density * np.einsum("pij,pj,pkj->pik", turn, table.carried_mass, turn)
    angular = world.density * np.einsum("pij,pj,pkj->pik", turn, table.carried_inertia, turn)
    x = _skews(position)
    carried = None
    if np.any(table.carried_mass) or np.any(table.carried_inertia):
        carried = SpatialInertia(
            _sym(_end(angular - x @ linear @ x, 0.0)),
            _mat(_end(x @ linear, 0.0)),
            _sym(_end(linear, 0.0)),
        )
    facing = bool(drags & {"faces", "lift_drag"})
    plate: dict[str, Any] = {}
    if "lift_drag" in drags:
        plate = {
            "plate": PlateTable.of([p for p in (*table.plate, world.lift_drag)], world.density),
            "plate_area": _end(table.plate_area, 0.0),
            "plate_forward": _vec(_end(along(table.plate_forward), np.eye(3)[0])),
            "plate_upward": _vec(_end(along(table.plate_upward), np.eye(3)[2])),
            "plate_center": _vec(_end(along(table.plate_center), 0.0)),
        }
    return Parts(
        laws=Laws("", ""),
        count=len(table.volume) + 1,
        position=_vec(_end(position, 0.0)),
        rotation=_mat(_end(turn @ swap.swapaxes(1, 2), np.eye(3))),
        half_size=_vec(_end(size(table.half_size), 1.0)),
        center_position=_vec(_end(center, 0.0)),
        volume=_end(table.volume, 0.0),
        exposed=_vec(_end(size(table.exposed), 0.0)) if world.surface_tension else None,
        drag_linear=_vec(_end(size(world.density * table.drag_linear), 0.0)) if facing else None,
        drag_angular=_vec(_end(size(world.density * table.drag_angular), 0.0)) if facing else None,
        carried=carried,
        ellipsoid=_ellipsoids(robot, size) if "ellipsoid" in drags else None,
        mounts=_mounts(robot, turn, position) if robot.thruster_row else None,
        **plate,
    )


def _ellipsoids(robot: Robot, size: Any) -> Any:
    """Constants of MuJoCo's ellipsoid law of all parts."""
    m, world = robot.mj_model, robot.world
    fluid = m.geom_fluid[[m.geom(name).id for name in robot.part_geoms]]
    # Three columns of `geom_fluid` are along the geom's axes, and three about them.
    fluid = np.concatenate([fluid[:, :6], size(fluid[:, 6:9]), size(fluid[:, 9:])], 1)
    half = _end(size(robot.fluid.half_size), 1.0)
    return ellipsoid_constants(half, _end(fluid, 0.0), world.density, world.viscosity)


def _mounts(robot: Robot, turn: np.ndarray, position: np.ndarray) -> Mounts:
    count = len(position)
    which, axis, place = np.full(count, -1), np.zeros((count, 3)), np.zeros((count, 3))
    ratio = np.zeros(count)
    pairs = zip(robot.thruster_row, robot.thruster_part, strict=True)
    for index, (row, part) in enumerate(pairs):
        thruster = part.thruster
        assert thruster is not None
        which[row], ratio[row] = index, thruster.torque_ratio
        axis[row] = turn[row] @ np.asarray(thruster.axis)
        place[row] = position[row] + turn[row] @ np.asarray(thruster.position)
    return Mounts(_end(which, -1), _vec(_end(axis, 0.0)), _vec(_end(place, 0.0)), _end(ratio, 0.0))


# ------------------------------------------------------------------ picking


def pick_level(
    columns: Columns,
    bodies: np.ndarray,
    parts: dict[Laws, np.ndarray],
    points: np.ndarray | None,
    root: bool,
    count: int,
    finish: Any,
) -> Level:
    """The constants of some bodies.

    Args:
        columns: of a robot, or of several, one behind the other.
        bodies: `[...]` which columns of the bodies.
        parts: of each group, which columns of the parts, `[..., npart, ...]` with the parts on the
            axis before the last.
        points: which columns of the points, likewise, or None.
        root: whether they are roots, which no hinge carries.
        count: how many bodies move together.
        finish: what becomes of each picked array.

    Returns:
        The level.
    """
    take = lambda index: lambda x: finish(x[index])  # noqa: E731
    mass, moment, inertia, box = jax.tree.map(take(bodies), columns.bodies)
    groups = []
    for laws, index in sorted(parts.items()):
        found = jax.tree.map(take(index), only(columns.parts, laws))
        groups.append(replace(found, laws=laws, count=index.shape[-2]))
    touching = None
    if points is not None and columns.points is not None:
        place, share = jax.tree.map(take(points), columns.points)
        touching = Points(points.shape[-2], place, share)
    return Level(
        count=count,
        hinges=None if root else jax.tree.map(take(bodies), columns.hinges),
        mass=mass,
        moment=moment,
        inertia=inertia,
        box=box,
        parts=tuple(groups),
        points=touching,
    )


def only(parts: Parts, laws: Laws) -> Parts:
    """Parts without the numbers that their laws do not ask for."""
    gone: dict[str, Any] = {}
    if laws.drag != "lift_drag":
        gone |= dict.fromkeys(
            ("plate", "plate_area", "plate_forward", "plate_upward", "plate_center")
        )
    if laws.drag not in ("faces", "lift_drag"):
        gone["drag_angular"] = None
    if laws.drag != "faces":
        gone["drag_linear"] = None
    if laws.drag != "ellipsoid":
        gone["ellipsoid"] = None
    if laws.buoyancy == "off":
        gone["exposed"] = None
    if not laws.pushes:
        gone["mounts"] = None
    return replace(parts, **gone)
