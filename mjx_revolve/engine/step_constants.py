"""All numbers that the step needs of robots, one column for each body, part and point.

Read from the assembly and its fluid table, for all bodies at a time; `select_bodies` then takes the
columns of any bodies as the constants of a `Level`. Each kind of column ends (for bodies: begins)
with a column without effect, which pads rows and levels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np

from mjx_revolve.body.placement import counted, turned
from mjx_revolve.engine.assembly import Assembly
from mjx_revolve.engine.fluid_table import FluidTable
from mjx_revolve.engine.level import (
    DragBound,
    Hinges,
    InertiaBox,
    Level,
    PartLaws,
    Parts,
    Points,
    Shells,
    ThrusterMounts,
)
from mjx_revolve.engine.self_pairs import hinge_levers
from mjx_revolve.numerics.inertia import SpatialInertia
from mjx_revolve.numerics.spatial import SYM, clean
from mjx_revolve.water.added_mass import CarriedWater
from mjx_revolve.water.buoyancy import find_buoyancy_law
from mjx_revolve.water.drag import drags_whole_bodies, find_drag_law
from mjx_revolve.water.laws import (
    DragLaw,
    PartDragLaw,
    PartField,
    map_fields,
    part_numbers,
)
from mjx_revolve.water.plate_wake import thinness

# Stiffness of a joint's end stop, as full effort per this overshoot [rad]. A choice: stiff enough
# to keep within a degree of the real range; the step treats it implicitly, so it is stable.
LIMIT_OVERSHOOT = 0.008
# Share of its top speed up to which a servo gives its full effort [-]. A choice, between the
# straight line of a bare motor (0) and Revolve's box of effort and speed (1).
TORQUE_CURVE_KNEE = 0.75
# A hinge of this inertia does not move [kg·m²]: so overflow rows and padding are held.
IMMOBILE_INERTIA = 1e30
_NO_PAIRS = np.zeros((0, 2), int)
# Stands for infinity where arithmetic must stay finite.
NO_LIMIT = 1e30


class StepConstants(NamedTuple):
    """Numbers are NumPy arrays, component by component.

    Attributes:
        assembly: the robots.
        pairs: `[pairs, 2]` parts of one robot that can meet, rows of the fluid table.
        hinges: `[nbody]`, by the moving bodies; 0, the world, is nothing, and so is a root's.
        bodies: `[nbody]` mass, moment and inertia, and the inertia box or None.
        bounds: `[nbody]` of the drag's gradient.
        parts: `[npart + 1]` a `Parts` of all laws, in the order of the fluid table.
        points: `[npoint + 1]` (position, mass share, `Points.fall`), or None without a bed.
        laws: those that parts obey, in order.
        part_laws: `[npart]` which of them each part obeys.
        part_body: `[npart]` bodies that carry them, as `Assembly` numbers them.
        point_body: `[npoint]` bodies of the contact points.
        frame: `[nbody, 3, 3]` body frame from the step's own frame, which has z along the hinge.
    """

    assembly: Assembly
    pairs: np.ndarray
    hinges: Hinges
    bodies: tuple[Any, ...]
    bounds: DragBound
    parts: Parts
    points: Any
    laws: tuple[PartLaws, ...]
    part_laws: np.ndarray
    part_body: np.ndarray
    point_body: np.ndarray
    frame: np.ndarray


# ------------------------------------------------------------------ small algebra on columns


def _skews(r: np.ndarray) -> np.ndarray:
    """`[n, 3]` to `[n, 3, 3]`."""
    found = np.zeros((len(r), 3, 3))
    found[:, [1, 2, 0], [2, 0, 1]] = -r[:, [0, 1, 2]]
    found[:, [2, 0, 1], [1, 2, 0]] = r[:, [0, 1, 2]]
    return found


def _z_frame(axis: np.ndarray) -> np.ndarray:
    """A rotation with the axis as its third column; a permutation for an axis along x, y or z."""
    axis = axis / np.linalg.norm(axis)
    k = int(np.argmax(np.abs(axis)))
    if abs(abs(axis[k]) - 1) < 1e-12:
        frame = np.eye(3)[:, [(k + 1) % 3, (k + 2) % 3, k]]
        return frame * np.sign(axis[k]) if axis[k] > 0 else frame @ np.diag([1.0, -1.0, -1.0])
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], 1)


def _z_frames(axes: np.ndarray) -> np.ndarray:
    """`[n, 3, 3]` of `[n, 3]` axes, which are few different ones."""
    different = {axis.tobytes(): axis for axis in axes}
    frames = {key: _z_frame(axis) for key, axis in different.items()}
    return np.array([frames[axis.tobytes()] for axis in axes])


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


def read_constants(assembly: Assembly, pairs: np.ndarray = _NO_PAIRS) -> StepConstants:
    """Reads the columns of a robot, or of several one behind the other.

    Args:
        assembly: of the robots.
        pairs: `[pairs, 2]` parts of one robot that can meet, rows of the fluid table.

    Returns:
        The columns.
    """
    table, count = assembly.fluid, len(assembly.parent)
    frame = hinge_frames(assembly)
    points, touching = None, np.zeros(0, int)
    if assembly.world.bed is not None:
        touching, place = assembly.points
        place = turned(frame[touching].swapaxes(1, 2), place)
        share = assembly.mass / np.maximum(np.bincount(touching, minlength=count), 1)
        # A padded point has no mass, so its spring, damper and friction vanish.
        points = (
            _vec(_end(place, 0.0)),
            _end(share[touching], 0.0),
            _end(_falls(assembly)[touching], 0.0),
        )
    pushing = np.zeros(len(table.volume), bool)
    pushing[assembly.thruster_row] = True
    marks = pushing, table.coupled, table.stated
    each = list(zip(table.buoyancy, table.drag, *(x.tolist() for x in marks), strict=True))
    laws = sorted(set(each))
    number = {law: k for k, law in enumerate(laws)}
    drags = {name: find_drag_law(name) for name in sorted({*table.drag})}
    numbers = {
        name: part_numbers(law, table, assembly.world)
        for name, law in drags.items()
        if isinstance(law, PartDragLaw)
    }
    return StepConstants(
        assembly=assembly,
        pairs=pairs,
        hinges=_read_hinges(assembly, frame, pairs),
        bodies=_read_bodies(assembly, frame),
        bounds=_read_bounds(assembly, frame, drags, numbers),
        parts=_read_parts(assembly, frame, numbers),
        points=points,
        laws=tuple(PartLaws(*law) for law in laws),
        part_laws=np.array([number[law] for law in each]),
        part_body=table.body,
        point_body=touching,
        frame=frame,
    )


def _falls(assembly: Assembly) -> np.ndarray:
    """`[nbody]` acceleration at which each body, or its whole robot, would begin to sink [m/s²]."""
    table, world = assembly.fluid, assembly.world
    lifted = np.bincount(table.body, world.density * table.lifted, len(assembly.mass))
    fallen = []
    for owner in (np.arange(len(assembly.mass)), assembly.robot + 1):
        mass, lift = (np.bincount(owner, x) for x in (assembly.mass, lifted))
        fallen.append((world.gravity * (1 - lift / np.maximum(mass, 1e-12)))[owner])
    return np.maximum(np.maximum(*fallen), 0.0)


def hinge_frames(assembly: Assembly) -> np.ndarray:
    """`[nbody, 3, 3]` body frame from the step's own frame, which has z along the hinge."""
    return _z_frames(assembly.axis)


def _read_hinges(assembly: Assembly, frame: np.ndarray, pairs: np.ndarray) -> Hinges:
    position, rotation = assembly.from_parents()
    up = frame[assembly.parent].swapaxes(1, 2)
    # At rest, ours of the child seen from ours of the parent.
    rest = clean(up @ rotation @ frame)
    toward = _z_frames(rest[:, :, 2])
    offset = clean(turned(toward.swapaxes(1, 2), rest[:, :, 0]))
    jointed = assembly.parent > 0

    def column(x: np.ndarray, blank: Any) -> np.ndarray:
        """Without the world's and the roots', which are nothing."""
        return np.where(jointed.reshape(-1, *[1] * (x.ndim - 1)), x, blank)

    effort, damping = assembly.effort, assembly.damping
    low, high = assembly.range.T
    zero = np.zeros(len(jointed))
    motor = motor_line(assembly.speed, effort, damping)
    limits = column(low, 0.0), column(high, 0.0)
    low, high = assembly.stops.T
    return Hinges(
        rotation=_mat(column(toward, np.eye(3))),
        offset=(column(offset[:, 0], 1.0), column(offset[:, 1], 0.0)),
        position=_vec(column(turned(up, position), 0.0)),
        armature=column(zero, IMMOBILE_INERTIA),
        damping=column(damping, 0.0),
        gain=column(assembly.stiffness, 0.0),
        stiffness=column(assembly.stiffness, 0.0),
        implicit_stiffness=column(assembly.implicit_stiffness, 0.0),
        servo_damping=zero,
        effort=(column(-effort, 0.0), column(effort, 0.0)),
        target=limits,
        range=(column(low, -NO_LIMIT), column(high, NO_LIMIT)),
        stop=column(effort / LIMIT_OVERSHOOT, 0.0),
        motor=(column(motor[0], NO_LIMIT), column(motor[1], 0.0), column(motor[2], 1.0)),
        base_inertia=column(_base_inertias(assembly), 1.0),
        lever=hinge_levers(assembly, pairs),
    )


def motor_line(top: Any, effort: Any, damping: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The line between speed and torque near the top speed; see `servos.servo`.

    Args:
        top: the top speed [rad/s]; infinite for none.
        effort: the largest torque [N·m].
        damping: of the hinge [N·m·s/rad].

    Returns:
        Torque at the top speed [N·m], gradient -dτ/dω [N·m·s/rad], top speed [rad/s]; without a
        limit, the line lies far above any torque.
    """
    limited = np.isfinite(top) & np.isfinite(effort)
    speed = np.where(limited, top, 1.0)
    friction = np.where(limited, damping * speed, NO_LIMIT)
    gradient = np.maximum(
        (np.where(limited, effort, 0) - friction) / ((1 - TORQUE_CURVE_KNEE) * speed), 0
    )
    return friction, np.where(limited, gradient, 0.0), speed


def _base_inertias(assembly: Assembly) -> np.ndarray:
    """For each body, the inertia about its hinge's axis of all that the hinge does not move.

    Bodies and the water that they carry, at rest; `[nbody]` [kg·m²].
    """
    table, layout, density = assembly.fluid, assembly.layout, assembly.world.density
    turn, place = assembly.rotation, assembly.position

    def seen(center: np.ndarray, linear: np.ndarray, angular: np.ndarray) -> np.ndarray:
        """`[n, 3, 3, 3]` spatial inertias about the core's origin: angular, cross, linear."""
        x = _skews(center)
        cross = x @ linear
        return np.stack([angular - cross @ x, cross, linear], 1)

    unit = np.eye(3)
    inertia = turn @ assembly.inertia @ turn.swapaxes(1, 2)
    center = place + turned(turn, assembly.center)
    found = seen(center, assembly.mass[:, None, None] * unit, inertia)
    if table.carries:
        carried = _carried_about(table, density, layout.rotation, layout.position)
        np.add.at(found, table.body, np.stack(carried, 1))
    # A subtree is a run of bodies.
    runs = np.stack([np.arange(len(found)), assembly.end], 1).ravel()
    below = np.add.reduceat(np.append(found, found[:1], 0), runs)[::2]
    angular, cross, linear = (below[assembly.roots[assembly.robot]] - below).swapaxes(0, 1)
    spin = turned(turn, assembly.axis)
    # How the core's origin would move.
    pace = np.cross(place, spin)
    about = spin * (turned(angular, spin) + 2 * turned(cross, pace)) + pace * turned(linear, pace)
    return np.sum(about, 1)


def _read_bodies(assembly: Assembly, frame: np.ndarray) -> tuple[Any, ...]:
    """Mass, moment, inertia about the origin, and the inertia box."""
    back, mass = frame.swapaxes(1, 2), assembly.mass
    center = turned(back, assembly.center)
    x = _skews(center)
    inertia = back @ assembly.inertia @ frame - mass[:, None, None] * (x @ x)
    box = None
    if drags_whole_bodies(assembly.world.drag):
        size, axes = inertia_boxes(assembly)
        box = InertiaBox(_mat(back @ axes), _vec(center), _vec(size))
    return mass.copy(), _vec(mass[:, None] * center), _sym(inertia), box


def inertia_boxes(assembly: Assembly) -> tuple[np.ndarray, np.ndarray]:
    """MuJoCo's inertia boxes: uniform, of the bodies' masses and principal inertias.

    Args:
        assembly: of the robots.

    Returns:
        Edges `[nbody, 3]` [m] and axes `[nbody, 3, 3]`, body frame.
    """
    i, axes = _principal(assembly)
    edges = np.maximum(i[:, [1, 0, 0]] + i[:, [2, 2, 1]] - i, 0)
    return np.sqrt(6 * edges / np.maximum(assembly.mass, 1e-30)[:, None]), axes


def _principal(assembly: Assembly) -> tuple[np.ndarray, np.ndarray]:
    """`[nbody, 3]` principal inertias and `[nbody, 3, 3]` axes, body frame, as MuJoCo has them.

    A body of equal inertias has no axes of its own; then its box is a matter of MuJoCo's method,
    and of a body that is one box, that box's axes count; of an edited model, its own.
    """
    if assembly.inertia_axes is not None:
        own = assembly.inertia_axes
        return np.einsum("bji,bjk,bki->bi", own, assembly.inertia, own), own
    table, parts = assembly.fluid, assembly.layout.parts
    pieces = np.array([(p.mass > 0) + (p.ballast_mass > 0) for p in parts])[assembly.layout.kind]
    single = np.bincount(table.body, pieces, len(assembly.parent)) == 1
    moments, axes = np.zeros((len(single), 3)), np.tile(np.eye(3), (len(single), 1, 1))
    quat, matrix = np.zeros(4), np.zeros(9)
    for k in range(1, len(single)):
        if single[k]:
            [row] = np.flatnonzero((table.body == k) & (pieces > 0))
            axes[k] = table.rotation[row]
            moments[k] = np.diag(axes[k].T @ assembly.inertia[k] @ axes[k])
            continue
        mujoco.mju_eig3(moments[k], matrix, quat, assembly.inertia[k].ravel())
        axes[k] = matrix.reshape(3, 3)
    return moments, axes


# A uniform cube's inertia is .22 of its mass times the square of half its diagonal, and no body of
# the catalogue's modules has less than .1. Below this share, it counts instead of the mass.
_HEAVY_MIDDLE = 0.08
# Steeper than any step can take explicitly, and its square is a float32; a choice.
_UNBOUNDED = 1e9


def _read_bounds(
    assembly: Assembly, frame: np.ndarray, laws: Mapping[str, DragLaw], numbers: Mapping[str, Any]
) -> DragBound:
    """Bounds of the gradient of each body's drag: each part's is g ρ A v, with the largest face A.

    What drags a thin part acts across it, where it carries far more water than any other way. As
    the step compares all drag with what a body carries at least, that of thin parts counts less.
    """
    table, density, mass = assembly.fluid, assembly.world.density, assembly.mass
    x, y, z = 2 * table.half_size.T
    face, steep = np.max([x * y, y * z, z * x], 0), np.empty(len(x))
    # What modules state, twice: across a body two faces meet the flow.
    stated = np.broadcast_to(table.coefficients["drag_coefficient"].T, (3, len(x))).max(0)
    stated = 2 * stated * table.factors.get("drag", 1.0)
    for name, law in laws.items():
        bound = law.steepest
        if callable(bound):
            found = getattr(numbers[name], "density", density) * bound(numbers[name])
        else:
            most = _UNBOUNDED if bound is None else bound
            found = np.maximum(most, stated if law.by_faces else 0.0) * density * face
        steep = np.where(np.array(table.drag) == name, found, steep)
    if table.carries:
        least, across = density * table.carried_mass.min(-1), table.half_size.argmin(-1)
        more = density * table.carried_mass[np.arange(len(x)), across] - least
        mass = mass + np.bincount(table.body, least, len(mass))
        whole = mass[table.body]
        steep *= whole / (whole + thinness(2 * table.half_size) * more)
    # What turns easily for its mass, as with ballast in its middle.
    corner = np.linalg.norm(table.half_size, axis=1)
    corner = corner + np.linalg.norm(table.position - assembly.center[table.body], axis=1)
    reach = np.full(len(mass), 1e-9)
    np.maximum.at(reach, table.body, corner)
    turns = np.linalg.eigvalsh(assembly.inertia)[:, -1] / np.maximum(assembly.mass, 1e-12)
    mass = mass * np.minimum(turns / (_HEAVY_MIDDLE * reach**2), 1)
    at = turned(frame[table.body].swapaxes(1, 2), table.position)
    x = _skews(at)

    def total(each: np.ndarray) -> np.ndarray:
        found = np.zeros((len(mass), *each.shape[1:]))
        np.add.at(found, table.body, each)
        return found

    return DragBound(
        steep=total(steep),
        moment=_vec(total(steep[:, None] * at)),
        inertia=_sym(total(-steep[:, None, None] * (x @ x))),
        corners=total(steep * np.linalg.norm(table.half_size, axis=1)),
        mass=mass,
    )


def _read_parts(assembly: Assembly, frame: np.ndarray, drag: Mapping[str, Any]) -> Parts:
    """All parts, with the numbers of every law that any of them obeys."""
    table, world = assembly.fluid, assembly.world
    back = frame[table.body].swapaxes(1, 2)
    turn = clean(back @ table.rotation)
    position = turned(back, table.position)
    # The part's axes in the frame that describes it: the body's where both have the same.
    square = np.all((turn == 0) | (np.abs(turn) == 1), (1, 2))
    swap = np.where(square[:, None, None], turn, np.eye(3))
    whole = drags_whole_bodies(world.drag)
    numbers: dict[str, Any] = dict(
        position=position,
        rotation=turn @ swap.swapaxes(1, 2),
        half_size=table.half_size,
        center_position=position + turned(turn, table.center_of_volume),
        volume=table.volume,
        bulk=8 * table.half_size.prod(-1) if whole else None,
        exposed=table.exposed if world.surface_tension else None,
        drag=drag,
        carried=_carried(assembly, turn, position) if table.carries else None,
        mounts=_mounts(assembly, turn, position) if len(assembly.thruster_row) else None,
    )
    parts = Parts(PartLaws("", ""), len(table.volume) + 1, **numbers)
    turns = {"vector": swap, "size": np.abs(swap)}

    def column(field: PartField, x: Any) -> Any:
        """A number along the axes that describe the parts, and that of a part of no effect."""
        blank = field.blank(world) if callable(field.blank) else field.blank
        if not isinstance(x, np.ndarray):  # components already
            return jax.tree.map(lambda component: _end(component, blank), x)
        if field.axes == "matrix":
            x = swap @ x @ swap.swapaxes(1, 2)
        elif field.axes != "none":
            x = turned(turns[field.axes], x)
        x = _end(x, blank)
        return x if x.ndim == 1 else _vec(x) if x.ndim == 2 else _mat(x)

    return map_fields(column, parts)


def _carried_about(
    table: FluidTable, density: float, turn: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Carried water about an origin: `[npart, 3, 3]` angular, cross and linear.

    Args:
        table: of the parts.
        density: of the water [kg/m³].
        turn: `[npart, 3, 3]` of the parts.
        position: `[npart, 3]` of the parts [m].
    """
    x, across = _skews(position), turn.swapaxes(1, 2)
    linear = density * (turn * table.carried_mass[:, None]) @ across
    angular = density * (turn * table.carried_inertia[:, None]) @ across
    if not table.coupled.any():
        return angular - x @ linear @ x, x @ linear, linear
    more = density * table.coupling
    linear = linear + turn @ more[:, :3, :3] @ across
    angular = angular + turn @ more[:, 3:, 3:] @ across
    own = turn @ more[:, 3:, :3] @ across
    once = own @ x
    return angular - once - once.swapaxes(1, 2) - x @ linear @ x, own + x @ linear, linear


def _carried(assembly: Assembly, turn: np.ndarray, position: np.ndarray) -> CarriedWater:
    table, density = assembly.fluid, assembly.world.density
    angular, cross, linear = _carried_about(table, density, turn, position)
    own: Any = density * table.carried_mass, density * table.carried_inertia
    entrained = table.entrained if assembly.world.near_surface else None
    inertia = SpatialInertia(_sym(angular), _mat(cross), _sym(linear))
    return CarriedWater(inertia, own[0], own[1], entrained)


def _mounts(assembly: Assembly, turn: np.ndarray, position: np.ndarray) -> ThrusterMounts:
    count, rows = len(position), assembly.thruster_row
    jets = [part.thruster for part in assembly.thruster_part if part.thruster is not None]
    which, axis, place = np.full(count, -1), np.zeros((count, 3)), np.zeros((count, 3))
    ratio = np.zeros(count)
    which[rows] = counted(np.bincount(assembly.layout.body[rows]))[1]
    ratio[rows] = [jet.torque_ratio for jet in jets]
    axis[rows] = turned(turn[rows], np.array([jet.axis for jet in jets]))
    place[rows] = position[rows] + turned(turn[rows], np.array([jet.position for jet in jets]))
    columns: Any = which, axis, place, ratio
    return ThrusterMounts(*columns)


# ------------------------------------------------------------------ picking


def select_bodies(
    columns: StepConstants,
    bodies: np.ndarray,
    parts: dict[PartLaws, np.ndarray],
    points: np.ndarray,
    shells: np.ndarray,
    root: bool,
    count: int,
    finish: Any,
    owners: np.ndarray | None = None,
) -> Level:
    """The constants of some bodies.

    Args:
        columns: of a robot, or of several, one behind the other.
        bodies: `[...]` which columns of the bodies.
        parts: of each group, which columns of the parts, `[..., npart, ...]` with the parts on the
            axis before the last.
        points: which columns of the points, laid out alike.
        shells: which columns of the parts may meet others of the robot, laid out alike.
        root: whether they are roots, which no hinge carries.
        count: how many bodies move together.
        finish: what becomes of each picked array.
        owners: which bodies the parts belong to; by default `bodies`.

    Returns:
        The level.
    """

    def take(index: np.ndarray) -> Callable[[np.ndarray], Any]:
        return lambda x: finish(x[index])

    mass, moment, inertia, box = jax.tree.map(take(bodies), columns.bodies)
    groups = []
    for laws, index in sorted(parts.items()):
        own = replace(
            columns.parts,
            drag=columns.parts.drag.get(laws.drag),
            exposed=columns.parts.exposed if find_buoyancy_law(laws.buoyancy).lifts else None,
            mounts=columns.parts.mounts if laws.pushes else None,
        )
        picked = jax.tree.map(take(index), own)
        groups.append(replace(picked, laws=laws, count=index.shape[-2]))
    touching, boxes = None, None
    if points.shape[-2] and columns.points is not None:
        touching = Points(points.shape[-2], *jax.tree.map(take(points), columns.points))
    if shells.shape[-2]:
        own = columns.parts
        shapes = own.position, own.rotation, own.half_size
        boxes = Shells(shells.shape[-2], *jax.tree.map(take(shells), shapes))
    return Level(
        count=count,
        hinges=None if root else jax.tree.map(take(bodies), columns.hinges),
        mass=mass,
        moment=moment,
        inertia=inertia,
        box=box,
        bound=jax.tree.map(take(bodies if owners is None else owners), columns.bounds),
        parts=tuple(groups),
        points=touching,
        shells=boxes,
    )
