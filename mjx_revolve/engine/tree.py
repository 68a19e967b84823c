"""The compiled MuJoCo model as levels of bodies: the constants of the population step.

Bodies at equal depth in the tree are stacked on the first axis, so one operation moves all of them.
Each moving body's frame is turned so that its hinge is its z axis, which makes the joint's motion
subspace constant (Featherstone 2008, Rigid Body Dynamics Algorithms, § 4.4).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjx_revolve.body.module_types import Thruster
from mjx_revolve.engine.robot import Robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.spatial import SYM, Mat, Scalar, Sym, Vec, fold
from mjx_revolve.water.drag import ellipsoid_constants
from mjx_revolve.water.lift_drag import LiftDrag

# Stiffness of a joint's end stop, as full effort per this overshoot [rad]. A choice: stiff enough
# to keep within half a degree of the real range; the step treats it implicitly, so it is stable.
LIMIT_OVERSHOOT = 0.008
# Share of its top speed up to which a servo gives its full effort [-]. A choice, between the
# straight line of a bare motor (0) and Revolve's box of effort and speed (1).
KNEE = 0.75


@dataclass(frozen=True)
class Parts:
    """Constants of those parts of a level that obey the same laws, `[npart, nbody, 1]` or a float.

    Attributes are those of `fluid_table.FluidTable`, in the level's body frames, times the water's
    density where a force needs it. Bodies with fewer parts are padded with parts that do nothing.
    A part that stands square on its body is described along the body's axes, so that its rotation
    folds away.

    Attributes:
        rows: `[npart][nbody]` rows of the fluid table, -1 for padding.
        buoyancy: their buoyancy law.
        drag: their drag law.
    """

    rows: tuple[tuple[int, ...], ...]
    buoyancy: str
    drag: str
    position: Vec
    rotation: Mat
    half_size: Vec
    center_position: Vec
    volume: Scalar
    exposed: Vec
    drag_linear: Vec
    drag_angular: Vec
    carried_linear: Sym
    carried_cross: Mat
    carried_angular: Sym
    plate: LiftDrag | None
    plate_area: Scalar
    plate_forward: Vec
    plate_upward: Vec
    plate_center: Vec
    ellipsoid: Any


@dataclass(frozen=True)
class Propeller:
    """Constants of one thruster.

    Attributes:
        index: which of the robot's thrusters it is.
        body: where its body stands in the level.
        group: which of the level's `parts` holds the part that carries it.
        slot: where in that group.
        axis: of its thrust, unit vector in the level's body frame.
        position: where it pushes, body frame [m].
        disc: area of the propeller's disc [m²].
        thruster: curve, lag and limits.
    """

    index: int
    body: int
    group: int
    slot: int
    axis: Vec
    position: Vec
    disc: float
    thruster: Thruster


@dataclass(frozen=True)
class Points:
    """Contact points of one level, each `[npoint, nbody, 1]` or a float."""

    position: Vec
    mass: Scalar


@dataclass(frozen=True)
class Level:
    """Constants of the bodies at one depth of the tree, each `[nbody, 1]` or a float.

    Attributes:
        body: MuJoCo ids of the bodies.
        frame: `[nbody, 3, 3]` MuJoCo's body frame from ours, whose z is the hinge.
        parent: for each, where its parent stands in the level above.
        rotation: parent from child where the hinge stands at the angle `-offset`; the same for all
            hinges that point the same way, so that it mostly folds away.
        offset: cosine and sine of the angle that is added to the joint angle [-].
        position: of the joint in the parent's frame [m].
        mass: [kg].
        moment: mass times centre of mass [kg·m].
        inertia: about the body frame's origin [kg·m²].
        armature: of the hinge [kg·m²].
        damping: of the hinge, passive [N·m·s/rad].
        gain: of the servo, per target angle [N·m/rad].
        stiffness: of the servo, per joint angle [N·m/rad].
        servo_damping: of the servo, per joint speed [N·m·s/rad].
        effort: torque limits of the servo, low and high [N·m].
        target: limits of the servo's target, low and high [rad].
        range: limits of the joint, low and high [rad].
        stop: stiffness of the end stops [N·m/rad].
        top_speed: of the servo [rad/s]; infinite where the model states none.
        motor: the line between speed and torque near the top speed, or None where no servo has
            one: torque at the top speed [N·m], slope [N·m·s/rad], top speed [rad/s].
        base_inertia: of all that is on the parent's side of the hinge, about its axis, at rest
            [kg·m²].
        box_rotation: body from inertial frame, for MuJoCo's inertia-box law.
        box_position: centre of mass [m].
        box_size: edges of the box of equal inertia [m].
        parts: what the water acts on, in groups that obey the same laws.
        propellers: what drives it beside its hinges.
        points: what may touch the bed.
    """

    body: tuple[int, ...]
    frame: np.ndarray
    parent: tuple[int, ...]
    rotation: Mat
    offset: tuple[Scalar, Scalar]
    position: Vec
    mass: Scalar
    moment: Vec
    inertia: Sym
    armature: Scalar
    damping: Scalar
    gain: Scalar
    stiffness: Scalar
    servo_damping: Scalar
    effort: tuple[Scalar, Scalar]
    target: tuple[Scalar, Scalar]
    range: tuple[Scalar, Scalar]
    stop: Scalar
    top_speed: Scalar
    motor: Any
    base_inertia: Scalar
    box_rotation: Mat
    box_position: Vec
    box_size: Vec
    parts: tuple[Parts, ...]
    propellers: tuple[Propeller, ...]
    points: Points | None


@dataclass(frozen=True, eq=False)
class Tree:
    """A robot for the population step.

    Attributes:
        levels: root first.
        qpos_index: where the hinges, level by level, stand in MuJoCo's qpos.
        qvel_index: the same in qvel.
        ctrl_index: the same in ctrl, then the thrusters; hinges without a servo are refused.
        carries: whether water is carried along by any part.
        robot: the source.
    """

    levels: tuple[Level, ...]
    qpos_index: np.ndarray
    qvel_index: np.ndarray
    ctrl_index: np.ndarray
    carries: bool
    robot: Robot


def _clean(x: np.ndarray) -> np.ndarray:
    """Rounds 1e-17 to 0 and 0.9999999 to 1, so that products with them fold away."""
    near = np.round(x)
    return np.where(np.abs(x - near) < 1e-12, near, x)


def _rotation(quat: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quat, np.float64))
    return _clean(matrix.reshape(3, 3))


def _is_permutation(rotation: np.ndarray) -> bool:
    """Whether it only exchanges axes, and turns some round."""
    return bool(np.all((rotation == 0) | (np.abs(rotation) == 1)))


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


def _skew(r: np.ndarray) -> np.ndarray:
    return np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])


def _vec(rows: Any) -> Vec:
    """`[..., 3]` to three constants `[..., 1]`."""
    a = _clean(np.asarray(rows, np.float64))
    return tuple(fold(a[..., i, None]) for i in range(3))


def _mat(rows: Any) -> Mat:
    a = _clean(np.asarray(rows, np.float64))
    return tuple(tuple(fold(a[..., i, j, None]) for j in range(3)) for i in range(3))


def _sym(rows: Any) -> Sym:
    a = np.asarray(rows, np.float64)
    a = np.where(np.abs(a) < 1e-15, 0, a)
    return tuple(fold(a[..., i, j, None]) for i, j in SYM)


def _num(rows: Any) -> Scalar:
    return fold(np.asarray(rows, np.float64)[..., None])


def make_tree(robot: Robot, contact: bool = True) -> Tree:
    """Reads the constants of the population step from a compiled robot.

    Args:
        robot: from `build_robot`.
        contact: whether the robot can touch the bed; without, its points are left out.

    Returns:
        The tree.

    Raises:
        InputError: the model holds a joint that the population step cannot do; it is named.
    """
    m = robot.mj_model
    depth, frames = depths_and_frames(robot)
    servo = {int(m.actuator_trnid[k, 0]): k for k in robot.servos}
    bodies = [
        [b for b in depth if depth[b] == d] for d in range(max(depth.values(), default=0) + 1)
    ]
    levels = []
    for d, ids in enumerate(bodies):
        above = bodies[d - 1] if d else []
        levels.append(make_level(robot, ids, above, frames, servo, contact))
    joints = [int(m.body_jntadr[b]) for ids in bodies[1:] for b in ids]
    return Tree(
        levels=tuple(levels),
        qpos_index=m.jnt_qposadr[joints].astype(np.int32) if joints else np.zeros(0, np.int32),
        qvel_index=m.jnt_dofadr[joints].astype(np.int32) if joints else np.zeros(0, np.int32),
        ctrl_index=np.array([*(servo[j] for j in joints), *robot.thrusters], np.int32),
        carries=bool(np.any(robot.fluid.carried_mass) or np.any(robot.fluid.carried_inertia)),
        robot=robot,
    )


def depths_and_frames(robot: Robot) -> tuple[dict[int, int], dict[int, np.ndarray]]:
    """Depth in the tree, and MuJoCo's body frame from ours, of each body.

    Raises:
        InputError: the model holds a joint that the population step cannot do; it is named.
    """
    m = robot.mj_model
    depth: dict[int, int] = {}
    frames: dict[int, np.ndarray] = {}
    driven = {int(m.actuator_trnid[k, 0]) for k in robot.servos}
    for body in range(1, m.nbody):
        name, joint, parent = m.body(body).name, int(m.body_jntadr[body]), m.body_parentid[body]
        kind = m.jnt_type[joint] if m.body_jntnum[body] == 1 else None
        if body == 1 and kind == mujoco.mjtJoint.mjJNT_FREE:
            depth[body], frames[body] = 0, np.eye(3)
            continue
        if body == 1 or kind != mujoco.mjtJoint.mjJNT_HINGE or np.any(m.jnt_pos[joint]):
            raise InputError(
                f"engine population: body {name!r}: expected one hinge at the body's origin below "
                "one free root; use engine: mjx"
            )
        if joint not in driven:
            raise InputError(f"engine population: joint {name!r}: expected a servo; found none")
        depth[body], frames[body] = depth[parent] + 1, _z_frame(m.jnt_axis[joint])
    return depth, frames


def make_level(
    robot: Robot,
    ids: list[int],
    above: list[int],
    frames: dict[int, np.ndarray],
    servo: dict[int, int],
    contact: bool,
    assigned: list[list[int]] | None = None,
) -> Level:
    """The constants of some bodies whose parents are all `above`.

    `assigned` says which rows of the fluid table each of them holds; by default all of its own. A
    body that is listed more than once has its mass and its hinge in each place.
    """
    m = robot.mj_model
    rotation, offset, position, moment, inertia, box_rotation, box_position, box_size = (
        [] for _ in "12345678"
    )
    for b in ids:
        c = frames[b]
        up = frames[int(m.body_parentid[b])] if above else np.eye(3)
        rest = up.T @ _rotation(m.body_quat[b]) @ c if above else np.eye(3)
        toward = _z_frame(_clean(rest[:, 2]))
        rotation.append(toward)
        offset.append((toward.T @ rest)[:2, 0])
        position.append(up.T @ m.body_pos[b] if above else np.zeros(3))
        com = c.T @ m.body_ipos[b]
        axes = c.T @ _rotation(m.body_iquat[b])
        mass = m.body_mass[b]
        moment.append(mass * com)
        inertia.append(axes @ np.diag(m.body_inertia[b]) @ axes.T - mass * _skew(com) @ _skew(com))
        i = m.body_inertia[b]
        # MuJoCo: a uniform box of the same mass and principal inertia.
        edges = np.maximum(
            np.array([i[1] + i[2] - i[0], i[0] + i[2] - i[1], i[0] + i[1] - i[2]]), 0
        )
        box_size.append(np.sqrt(6 * edges / mass))
        box_rotation.append(axes)
        box_position.append(com)
    if above:
        joint = [int(m.body_jntadr[b]) for b in ids]
        dof = [int(m.jnt_dofadr[j]) for j in joint]
        act = [servo[j] for j in joint]
        effort = m.actuator_forcerange[act]
        free = ~m.actuator_forcelimited[act].astype(bool)
        effort = np.where(free[:, None], [-np.inf, np.inf], effort)
        target = np.where(
            m.actuator_ctrllimited[act].astype(bool)[:, None],
            m.actuator_ctrlrange[act],
            [-np.inf, np.inf],
        )
        limited = m.jnt_limited[joint].astype(bool)[:, None]
        limits = np.where(limited, m.jnt_range[joint], [-np.inf, np.inf])
        strong = np.where(np.isfinite(effort[:, 1]), effort[:, 1], 1.0)
        top = m.jnt_user[joint, 0] if m.nuser_jnt else np.full(len(joint), np.inf)
        hinge = {
            "armature": _num(m.dof_armature[dof]),
            "damping": _num(m.dof_damping[dof]),
            "gain": _num(m.actuator_gainprm[act, 0]),
            "stiffness": _num(-m.actuator_biasprm[act, 1]),
            "servo_damping": _num(-m.actuator_biasprm[act, 2]),
            "effort": (_num(effort[:, 0]), _num(effort[:, 1])),
            "target": (_num(target[:, 0]), _num(target[:, 1])),
            "range": (_num(limits[:, 0]), _num(limits[:, 1])),
            "stop": _num(strong / LIMIT_OVERSHOOT),
            "top_speed": _num(top),
            "motor": _motor_line(top, effort[:, 1], m.dof_damping[dof]),
            "base_inertia": _num(_base_inertias(robot)[ids]),
        }
    else:
        pair = (0.0, 0.0)
        zero = dict.fromkeys(
            (
                "armature", "damping", "gain", "stiffness", "servo_damping", "stop", "top_speed",
                "base_inertia",
            ),
            0.0,
        )  # fmt: skip
        hinge = {**zero, "motor": None, "effort": pair, "target": pair, "range": pair}
    where = {b: k for k, b in enumerate(above)}
    if assigned is None:
        assigned = [list(np.flatnonzero(np.equal(robot.fluid.body, b))) for b in ids]
    parts = make_parts(robot, ids, frames, assigned)
    return Level(
        body=tuple(ids),
        frame=np.array([frames[b] for b in ids]),
        parent=tuple(where[int(m.body_parentid[b])] for b in ids) if above else (),
        rotation=_mat(rotation),
        offset=tuple(_num(_clean(x)) for x in np.transpose(offset)),
        position=_vec(position),
        mass=_num(m.body_mass[ids]),
        moment=_vec(moment),
        inertia=_sym(inertia),
        box_rotation=_mat(box_rotation),
        box_position=_vec(box_position),
        box_size=_vec(box_size),
        parts=parts,
        propellers=_propellers(robot, ids, frames, parts),
        points=make_points(robot, ids, frames) if contact else None,
        **hinge,
    )


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
    found = np.full(m.nbody, np.inf)
    for b in range(2, m.nbody):
        moved = np.zeros(m.nbody, bool)
        moved[b] = True
        for c in range(b + 1, m.nbody):
            moved[c] = moved[m.body_parentid[c]]
        axis, anchor = data.xaxis[m.body_jntadr[b]], data.xpos[b]
        swing = np.einsum("pji,pj->pi", axes, np.cross(axis, center - anchor))
        turn = np.einsum("pji,j->pi", axes, axis)
        about = np.sum(mass * swing**2 + inertia * turn**2, 1)
        found[b] = about[~moved[body]].sum()
    return found


def _motor_line(top: np.ndarray, effort: np.ndarray, damping: np.ndarray) -> Any:
    """Torque at the top speed, slope and top speed of each servo; see `servos.servo`."""
    limited = np.isfinite(top) & np.isfinite(effort)
    if not np.any(limited):
        return None
    speed = np.where(limited, top, 1.0)
    # Where there is no limit, the line lies far above any torque.
    friction = np.where(limited, damping * speed, 1e30)
    slope = np.where(limited, np.maximum((effort - friction) / ((1 - KNEE) * speed), 0), 0.0)
    return _num(friction), _num(slope), _num(speed)


def _stack(rows: list[list[Any]], empty: Any) -> np.ndarray:
    """`[nbody][k]` ragged to `[kmax, nbody, ...]`, padded with `empty`."""
    most = max(len(row) for row in rows)
    return np.array([[row[k] if k < len(row) else empty for row in rows] for k in range(most)])


def make_parts(
    robot: Robot, ids: list[int], frames: dict[int, np.ndarray], assigned: list[list[int]]
) -> tuple[Parts, ...]:
    """The groups of parts of some bodies; `assigned` as in `make_level`."""
    table = robot.fluid
    here = [p for row in assigned for p in row]
    laws = sorted({(table.buoyancy[p], table.drag[p]) for p in here})
    groups = []
    for buoyancy, drag in laws:
        alike = [p for p in here if (table.buoyancy[p], table.drag[p]) == (buoyancy, drag)]
        rows = [[p for p in row if p in alike] for row in assigned]
        # Nothing acts on a group that neither floats nor drags nor carries nor pushes.
        active = np.any(table.carried_mass[alike]) or set(alike) & set(robot.thruster_row)
        if (buoyancy, drag) != ("off", "off") or active:
            groups.append(_group(robot, ids, frames, rows, buoyancy, drag))
    return tuple(groups)


def _group(
    robot: Robot,
    ids: list[int],
    frames: dict[int, np.ndarray],
    rows: list[list[int]],
    buoyancy: str,
    drag: str,
) -> Parts:
    table, world = robot.fluid, robot.world

    def gather(value: Any, empty: Any) -> np.ndarray:
        return _stack(
            [[value(p, frames[b]) for p in row] for b, row in zip(ids, rows, strict=True)], empty
        )

    def turn(p: int, c: np.ndarray) -> np.ndarray:
        return _clean(c.T @ table.rotation[p])

    def carried(p: int, c: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        r, t = c.T @ table.position[p], turn(p, c)
        linear = world.density * t @ np.diag(table.carried_mass[p]) @ t.T
        angular = world.density * t @ np.diag(table.carried_inertia[p]) @ t.T
        x = _skew(r)
        return linear, x @ linear, angular - x @ linear @ x

    def centre(p: int, c: np.ndarray) -> np.ndarray:
        return c.T @ (table.position[p] + table.rotation[p] @ table.center_of_volume[p])

    def swap(p: int, c: np.ndarray) -> np.ndarray:
        """The part's axes in the frame that describes it: the body's where both have the same."""
        t = turn(p, c)
        return t if _is_permutation(t) else np.eye(3)

    def size(field: np.ndarray, empty: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
        """What a part has along each of its axes, either way."""
        return gather(lambda p, c: np.abs(swap(p, c)) @ field[p], np.asarray(empty))

    zero3, zero33, eye = np.zeros(3), np.zeros((3, 3)), np.eye(3)
    plate, ellipsoid = None, None
    if drag == "lift_drag":
        plate = _plate(gather, table.plate, world.density)
    if drag == "ellipsoid":
        # Three columns of `geom_fluid` are along the geom's axes, and three about them.
        geom_fluid = robot.mj_model.geom_fluid[_main_geoms(robot)]
        laws = gather(lambda p, c: geom_fluid[p, :6], np.zeros(6))
        along, about = size(geom_fluid[:, 6:9]), size(geom_fluid[:, 9:])
        k = ellipsoid_constants(
            size(table.half_size, np.ones(3)),
            np.concatenate([laws, along, about], -1),
            world.density,
            world.viscosity,
        )
        ellipsoid = {
            name: tuple(fold(x[..., None]) for x in value)
            if isinstance(value, tuple)
            else fold(value[..., None])
            for name, value in k.items()
        }
    return Parts(
        rows=tuple(map(tuple, gather(lambda p, c: p, -1))),
        buoyancy=buoyancy,
        drag=drag,
        position=_vec(gather(lambda p, c: c.T @ table.position[p], zero3)),
        rotation=_mat(gather(lambda p, c: turn(p, c) @ swap(p, c).T, eye)),
        half_size=_vec(size(table.half_size, np.ones(3))),
        center_position=_vec(gather(centre, zero3)),
        volume=_num(gather(lambda p, c: table.volume[p], 0.0)),
        exposed=_vec(size(table.exposed)),
        drag_linear=_vec(size(world.density * table.drag_linear)),
        drag_angular=_vec(size(world.density * table.drag_angular)),
        carried_linear=_sym(gather(lambda p, c: carried(p, c)[0], zero33)),
        carried_cross=_mat(gather(lambda p, c: carried(p, c)[1], zero33)),
        carried_angular=_sym(gather(lambda p, c: carried(p, c)[2], zero33)),
        plate=plate,
        plate_area=_num(gather(lambda p, c: table.plate_area[p], 0.0)),
        plate_forward=_vec(gather(lambda p, c: swap(p, c) @ table.plate_forward[p], eye[0])),
        plate_upward=_vec(gather(lambda p, c: swap(p, c) @ table.plate_upward[p], eye[2])),
        plate_center=_vec(gather(lambda p, c: swap(p, c) @ table.plate_center[p], zero3)),
        ellipsoid=ellipsoid,
    )


def _plate(gather: Any, plates: tuple[LiftDrag, ...], density: float) -> LiftDrag:
    """One `LiftDrag` whose numbers are arrays, each part's own."""
    usual = LiftDrag(density=density)
    plates = tuple(dataclasses.replace(p, density=p.density or density) for p in plates)
    numbers = {}
    for field in dataclasses.fields(LiftDrag):
        value = getattr(usual, field.name)
        if isinstance(value, int | float):
            stacked = gather(lambda p, c, name=field.name: float(getattr(plates[p], name)), value)
            numbers[field.name] = _num(stacked)
    plate = object.__new__(LiftDrag)  # not through its checks, which are for a user's numbers
    for field in dataclasses.fields(LiftDrag):
        object.__setattr__(plate, field.name, numbers.get(field.name, getattr(usual, field.name)))
    return plate


def _propellers(
    robot: Robot, ids: list[int], frames: dict[int, np.ndarray], parts: tuple[Parts, ...]
) -> tuple[Propeller, ...]:
    table, found = robot.fluid, []
    for index, row in enumerate(robot.thruster_row):
        body = int(table.body[row])
        if body not in ids:
            continue
        j = ids.index(body)
        group, slot = next(
            (g, k)
            for g, group in enumerate(parts)
            for k, rows in enumerate(group.rows)
            if rows[j] == row
        )
        thruster = robot.thruster_part[index].thruster
        assert thruster is not None
        turn = _clean(frames[body].T @ table.rotation[row])
        axis = turn @ np.asarray(thruster.axis)
        at = frames[body].T @ table.position[row] + turn @ np.asarray(thruster.position)
        across = np.prod(2 * table.half_size[row]) / (2 * table.half_size[row])
        found.append(
            Propeller(
                index=index,
                body=j,
                group=group,
                slot=slot,
                axis=tuple(float(x) for x in _clean(axis)),
                position=tuple(float(x) for x in _clean(at)),
                disc=float(np.pi / 4 * np.abs(np.asarray(thruster.axis)) @ across),
                thruster=thruster,
            )
        )
    return tuple(found)


def _main_geoms(robot: Robot) -> np.ndarray:
    """`[npart]` the geom of each part's main box: the ones that may carry MuJoCo's ellipsoid."""
    model = robot.mj_model
    names = [model.geom(g).name for g in range(model.ngeom)]
    main = [
        g
        for g, name in enumerate(names)
        if model.geom_bodyid[g] > 0 and not name.rsplit("/", 1)[-1].isdigit()
    ]
    # Geoms are grouped by body, table rows by module: match them by place.
    order = []
    for body, position in zip(robot.fluid.body, robot.fluid.position, strict=True):
        here = [g for g in main if model.geom_bodyid[g] == body]
        order.append(min(here, key=lambda g: np.abs(model.geom_pos[g] - position).sum()))
    return np.array(order)


def make_points(robot: Robot, ids: list[int], frames: dict[int, np.ndarray]) -> Points | None:
    """What may touch the bed, or None."""
    if robot.world.bed is None:
        return None
    rows = [list(np.flatnonzero(robot.contact_body == b)) for b in ids]
    if not any(rows):
        return None
    mass = robot.mj_model.body_mass
    return Points(
        position=_vec(
            _stack(
                [
                    [frames[b].T @ robot.contact_position[p] for p in row]
                    for b, row in zip(ids, rows, strict=True)
                ],
                np.zeros(3),
            )
        ),
        # A padded point has no mass, so its spring, damper and friction vanish.
        mass=_num(
            _stack([[mass[b] / len(row)] * len(row) for b, row in zip(ids, rows, strict=True)], 0.0)
        ),
    )
