"""What the water does to each part of a robot along a trajectory: for pictures and reports.

The same pure laws as in the engines, which sum over parts and turn forces into accelerations at
once; here each part keeps its own. What is left out is no force of its own: added and entrained
water count as inertia.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.rollout import Trajectory
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.spatial import (
    Mat,
    Scalar,
    Vec,
    cross,
    matTvec,
    matvec,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.buoyancy import buoyancy, submersion, surface_tension
from mjx_revolve.water.drag import ellipsoid, ellipsoid_constants, inertia_box, quadratic_drag
from mjx_revolve.water.flow import Water, flow, surface, water_of, wave_convection
from mjx_revolve.water.lift_drag import lift_drag
from mjx_revolve.water.thrusters import clamp_command, thrust


@dataclass(frozen=True, eq=False)
class Forces:
    """Forces on a robot's parts at some rows of a trajectory; rows of parts as in the fluid table.

    Attributes:
        rows: `[S]` rows of the trajectory.
        time: `[S]` [s].
        place: `[S, npart, 3]` centres of the parts' boxes, world frame [m].
        buoyancy: `[S, npart, 3]` force of the water's pressure, world frame [N]: Archimedes', what
            accelerating water adds to it, and the pull of the surface where the world has one.
        drag: `[S, npart, 3]` of the water that flows past, the lift of fins included, world frame
            [N].
        thrust: `[S, npart, 3]` of the thrusters, world frame [N].
    """

    rows: np.ndarray
    time: np.ndarray
    place: np.ndarray
    buoyancy: np.ndarray
    drag: np.ndarray
    thrust: np.ndarray


@dataclass(frozen=True, eq=False)
class Motion:
    """How parts are placed and move, world frame.

    Attributes:
        place: `[S, npart, 3]` centres of their boxes [m].
        turn: `[S, npart, 3, 3]` world from part.
        velocity: `[S, npart, 3]` of the centres [m/s].
        spin: `[S, npart, 3]` angular velocity [rad/s].
    """

    place: np.ndarray
    turn: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray


def part_motion(robot: Robot, qpos: np.ndarray, qvel: np.ndarray) -> Motion:
    """Where a robot's parts are and how they move, by MuJoCo's own kinematics.

    Args:
        robot: from `build_robot`.
        qpos: `[S, nq]`.
        qvel: `[S, nv]`.

    Returns:
        Of the parts, in the order of the fluid table.
    """
    model, table = robot.mj_model, robot.fluid
    data, body = mujoco.MjData(model), table.body
    place, turn, velocity, spin = [], [], [], []
    for q, v in zip(np.asarray(qpos, float), np.asarray(qvel, float), strict=True):
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        frame = data.xmat.reshape(-1, 3, 3)[body]
        at = data.xpos[body] + np.einsum("pij,pj->pi", frame, table.position)
        # MuJoCo gives velocities at the centre of mass of the whole robot.
        arm = at - data.subtree_com[1]
        place.append(at)
        turn.append(frame @ table.rotation)
        velocity.append(data.cvel[body, 3:] + np.cross(data.cvel[body, :3], arm))
        spin.append(data.cvel[body, :3])
    return Motion(*(np.array(x) for x in (place, turn, velocity, spin)))


def module_forces(
    robot: Robot, trajectory: Trajectory, every: int = 1, water: Water | None = None
) -> Forces:
    """Buoyancy, drag and thrust on each part along a trajectory.

    Args:
        robot: that made it.
        trajectory: what it did.
        every: rows from one that is looked at to the next.
        water: as given to `simulate`: surface and current, each a number or a row for each step;
            by default the world's, without its gusts.

    Returns:
        The forces; `sum_modules` adds up those of a module.

    Raises:
        InputError: the trajectory is another robot's, or `every` is not at least 1.
    """
    model = robot.mj_model
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise InputError(f"every: expected a whole number of at least 1; found {every!r}")
    count = np.shape(trajectory.time)[0]
    for name, width in (("qpos", model.nq), ("qvel", model.nv), ("ctrl", model.nu)):
        shape = np.shape(getattr(trajectory, name))
        if shape != (count, width):
            raise InputError(f"trajectory.{name}: expected {[count, width]}; found {list(shape)}")
    rows = np.arange(0, count, every)
    qpos, qvel = np.asarray(trajectory.qpos)[rows], np.asarray(trajectory.qvel)[rows]
    motion = part_motion(robot, qpos, qvel)
    if trajectory.command is None:  # no lag is known of: what was asked for
        command = np.asarray(trajectory.ctrl)[rows][:, list(robot.thrusters)]
    else:
        command = np.asarray(trajectory.command)[rows]
    time = np.asarray(trajectory.time, float)[rows]
    now = water_at(robot, rows, time, count, water)
    parts = jax.jit(lambda *x: _forces(robot, *x))(_vectors(motion), now, command.T)
    # [component][npart, S] to [S, npart, 3].
    return Forces(rows, time, motion.place, *(np.stack(x, -1).swapaxes(0, 1) for x in parts))


def sum_modules(robot: Robot, force: np.ndarray) -> np.ndarray:
    """Forces on modules from those on their parts.

    Args:
        robot: whose.
        force: `[S, npart, 3]` [N].

    Returns:
        `[S, nmodule, 3]` [N], in the order of the morphology.
    """
    own = robot.fluid.module == np.arange(robot.morphology.num_modules)[:, None]
    return np.einsum("spi,mp->smi", force, own.astype(force.dtype))


def water_at(
    robot: Robot, rows: np.ndarray, time: np.ndarray, steps: int, water: Water | None = None
) -> Water:
    """The water at rows of a trajectory.

    Args:
        robot: in whose world.
        rows: `[S]` of them.
        time: `[S]` their times [s].
        steps: how many rows the trajectory has.
        water: as given to `simulate`; by default the world's, without its gusts.

    Returns:
        Water of `[S]` each.
    """
    base = water_of(robot.world) if water is None else water
    # A row of the trajectory is the state after its step, which the next step's water meets.
    after = np.minimum(rows + 1, steps - 1)
    pick = lambda x: np.broadcast_to(np.asarray(x, np.float32), (steps,))[after]  # noqa: E731
    now: Water = jax.tree.map(pick, base)
    return now._replace(time=(now.time + time).astype(np.float32))


def _vectors(motion: Motion) -> tuple[Vec, Mat, Vec, Vec]:
    """Components of `[npart, S]` each."""
    split = lambda x: tuple(jnp.asarray(x[..., i].T) for i in range(3))  # noqa: E731
    turn = tuple(split(motion.turn[..., i, :]) for i in range(3))
    return split(motion.place), turn, split(motion.velocity), split(motion.spin)


def _rows(x: Any, rows: list[int]) -> Any:
    """Some parts of a quantity, whatever tuples it is made of."""
    return jax.tree.map(lambda a: a[np.array(rows)], x)


def _column(table: np.ndarray, rows: list[int]) -> Any:
    """Rows of a table to meet `[nrow, S]`: one array, or a tuple of three."""
    some = jnp.asarray(table[rows])[..., None]
    return some if table.ndim == 1 else tuple(some[:, i] for i in range(3))


def _forces(robot: Robot, motion: Any, water: Water, command: Any) -> tuple[Vec, Vec, Vec]:
    """Buoyancy, drag and thrust, world frame, `[npart, S]` each component."""
    table, world = robot.fluid, robot.world
    place, turn, velocity, spin = motion
    flowing, pushing = flow(world, water, *place)
    if world.waves:
        pushing = vadd(pushing, wave_convection(world, water, *place))
    shape = place[0].shape
    wide = lambda v: tuple(jnp.broadcast_to(x, shape) for x in v)  # noqa: E731
    # The pressure's gradient holds up what is still, and pushes along with moving water.
    gradient = wide(vadd((0.0, 0.0, world.gravity), pushing))
    relative = vsub(velocity, wide(flowing))
    lift: list[Any] = [None] * shape[0]
    drag, shares = list(lift), list(lift)
    groups: dict[Any, list[int]] = {}
    for p, laws in enumerate(zip(table.buoyancy, table.drag, table.plate, strict=True)):
        # Fins of a kind share their coefficients; other laws do not care for them.
        key = laws if laws[1] == "lift_drag" else laws[:2]
        groups.setdefault(str(key), []).append(p)
    for rows in groups.values():
        some = _rows((place, turn, relative, spin, gradient), rows)
        held, share = _pressure(robot, rows, some[0], some[1], some[4], water)
        v, w = (matTvec(some[1], x) for x in some[2:4])
        dragged = matvec(some[1], vscale(share, _drag(robot, rows, v, w)))
        for k, p in enumerate(rows):
            lift[p], drag[p], shares[p] = (
                tuple(x[k] for x in wide_to(held, share)),
                tuple(x[k] for x in wide_to(dragged, share)),
                share[k],
            )
    if world.drag == "inertia_box":
        for p, force in _inertia_box(robot, motion, relative, shares).items():
            drag[p] = vadd(drag[p], force)
    driven = [(jnp.zeros(shape[1]),) * 3 for _ in range(shape[0])]
    for k, (p, part) in enumerate(zip(robot.thruster_row, robot.thruster_part, strict=True)):
        assert part.thruster is not None
        push = shares[p] * thrust(part.thruster, clamp_command(part.thruster, command[k]))
        axis = tuple(map(float, part.thruster.axis))
        frame = tuple(tuple(x[p] for x in row) for row in turn)
        driven[p] = vadd(driven[p], matvec(frame, vscale(push, axis)))
    stack = lambda parts: tuple(jnp.stack([x[i] for x in parts]) for i in range(3))  # noqa: E731
    return stack(lift), stack(drag), stack(driven)


def wide_to(vector: Vec, like: jax.Array) -> Vec:
    """A vector whose components all have the shape of `like`."""
    return tuple(jnp.broadcast_to(x, like.shape) for x in vector)


def _pressure(
    robot: Robot, rows: list[int], place: Vec, turn: Mat, gradient: Vec, water: Water
) -> tuple[Vec, Scalar]:
    """Buoyancy of parts of one law, world frame, and their submerged shares."""
    table, world = robot.fluid, robot.world
    law = table.buoyancy[rows[0]]
    center, half = _column(table.center_of_volume, rows), _column(table.half_size, rows)
    at = vadd(place, matvec(turn, center))
    height, slope = surface(world, water, at[0], at[1])
    below: Any = height - at[2]
    normal: Vec = (0.0, 0.0, 1.0)
    if slope is not None:
        # Distance to the surface's tangent plane, and its normal.
        steep = jax.lax.rsqrt(1 + slope[0] ** 2 + slope[1] ** 2)
        below, normal = below * steep, (-slope[0] * steep, -slope[1] * steep, steep)
    up = wide_to(matTvec(turn, normal), below)
    # Without buoyancy the water still drags what is below its surface.
    share, moment = submersion(up, below, half, "mask" if law == "off" else law)
    if law == "off":
        return (0.0, 0.0, 0.0), share
    force, _ = buoyancy(
        matTvec(turn, gradient), share, moment, _column(table.volume, rows), center, world.density
    )
    if world.surface_tension is not None:
        pull, _ = surface_tension(
            up,
            below,
            half,
            world.surface_tension.gamma,
            world.density * world.gravity,
            world.surface_tension.contact_angle,
            _column(table.exposed, rows),
        )
        force = vadd(force, pull)
    return matvec(turn, force), share


def _drag(robot: Robot, rows: list[int], v: Vec, w: Vec) -> Vec:
    """Drag on parts of one law, wholly under water, part frame."""
    table, world = robot.fluid, robot.world
    law = table.drag[rows[0]]
    if law == "faces":
        coefficient = _column(world.density * table.drag_linear, rows)
        return tuple(quadratic_drag(x, c, 1.0)[0] for x, c in zip(v, coefficient, strict=True))
    if law == "lift_drag":
        at = vadd(v, cross(w, _column(table.plate_center, rows)))
        forward, upward = (_column(x, rows) for x in (table.plate_forward, table.plate_upward))
        area, plate = _column(table.plate_area, rows), table.plate[rows[0]]
        return lift_drag(at, forward, upward, area, world.density, plate)
    if law == "ellipsoid":
        model, modules = robot.mj_model, robot.morphology.modules
        geoms = [
            model.geom(f"{module.name}/{part.name}").id
            for module in modules
            for part in module.kind.parts
        ]
        fluid = model.geom_fluid[geoms][rows]
        k = ellipsoid_constants(table.half_size[rows], fluid, world.density, world.viscosity)
        k = jax.tree.map(lambda x: jnp.asarray(x)[:, None], k)
        return ellipsoid(v, w, k, not world.added_mass)[0]
    return (0.0, 0.0, 0.0)


def _inertia_box(robot: Robot, motion: Any, relative: Vec, shares: list[Any]) -> dict[int, Vec]:
    """MuJoCo's law for whole bodies, shared out among their parts by volume; world frame."""
    model, table, world = robot.mj_model, robot.fluid, robot.world
    forces: dict[int, Vec] = {}
    for body in np.unique(table.body):
        rows = np.flatnonzero(table.body == body)
        weight = table.volume[rows] / max(table.volume[rows].sum(), 1e-30)
        share = sum(c * shares[p] for c, p in zip(weight, rows, strict=True))
        first = rows[0]
        turn, velocity, spin = _rows((motion[1], relative, motion[3]), [first])
        # From the part's frame to the body's inertial frame.
        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, model.body_iquat[body])
        inner = table.rotation[first].T @ axes.reshape(3, 3)
        arm = table.rotation[first].T @ (model.body_ipos[body] - table.position[first])
        into = lambda x, inner=inner: matTvec(inner, x)  # noqa: E731
        w = matTvec(turn, spin)
        v = vadd(matTvec(turn, velocity), cross(w, tuple(arm)))
        i = model.body_inertia[body]
        edges = np.maximum([i[1] + i[2] - i[0], i[0] + i[2] - i[1], i[0] + i[1] - i[2]], 0)
        size = tuple(np.sqrt(6 * edges / model.body_mass[body]))
        force, _ = inertia_box(into(v), into(w), size, world.density, world.viscosity)
        force = tuple(x[0] for x in matvec(turn, matvec(inner, force)))
        for c, p in zip(weight, rows, strict=True):
            forces[int(p)] = vscale(c * share, force)
    return forces
