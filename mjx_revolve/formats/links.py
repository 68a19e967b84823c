"""A robot as links, joints and parts in URDF's terms, with names that all programs accept.

Modules that are welded together are one link. URDF, ROS topics and SDF take their frames from here,
so that a transform in a bag fits the link of the same name in a URDF. Links are MuJoCo's bodies,
one to one.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from mjx_revolve.body.module_types import Part
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.body.placement import Module
from mjx_revolve.body.solids import part_mesh
from mjx_revolve.body.tree import free_name
from mjx_revolve.engine.mujoco_model import GREY
from mjx_revolve.engine.robot import Robot
from mjx_revolve.numerics.spatial import quat_to_matrix
from mjx_revolve.water.bed import Bed, bed_height
from mjx_revolve.water.buoyancy import BUOYANCY_LAWS
from mjx_revolve.water.drag import DRAG_LAWS
from mjx_revolve.water.laws import BuoyancyLaw, DragLaw, Export
from mjx_revolve.water.world import World

# The names of ROS (REP 105) for the fixed frame, for the odometry's, and for the robot's main part.
WORLD, ODOM, BASE = "world", "odom", "base_link"
# What SDF's elements add to the name of a part.
_ADDED = "", "_weld", "_propeller", "_propeller_joint"
# A bed within this depth below the surface is exported [m]: a robot starts 1 m deep.
_BED_DEPTH = 5.0
# What stands for no limit, as in SDF: URDF's readers take no infinity.
_ENDLESS = 1e16


@dataclass(frozen=True)
class Joint:
    """A motorised hinge at the origin of its link.

    Attributes:
        name: of its module, in letters that every program takes.
        axis: `[3]` unit vector, link frame.
        range: lowest and highest angle [rad]; 0 is the rest pose; infinite, as the two below, where
            an edited model has no limit.
        effort: largest torque of the motor [N·m].
        speed: largest speed of the motor [rad/s].
        damping: viscous friction [N·m·s/rad].
        stiffness: of the position servo [N·m/rad].
        qpos: index of its angle.
        qvel: index of its speed.
        ctrl: index of its servo's target.
    """

    name: str
    axis: np.ndarray
    range: tuple[float, float]
    effort: float
    speed: float
    damping: float
    stiffness: float
    qpos: int
    qvel: int
    ctrl: int

    @property
    def limit(self) -> dict[str, float]:
        """Angles [rad], torque [N·m] and speed [rad/s] as URDF and SDF call them."""
        names = "lower", "upper", "effort", "velocity"
        found = np.clip([*self.range, self.effort, self.speed], -_ENDLESS, _ENDLESS)
        return dict(zip(names, found.tolist(), strict=True))


@dataclass(frozen=True)
class PlacedPart:
    """A part of a module, placed on its link.

    Attributes:
        name: unique in the robot: those of module and part.
        row: of the fluid table.
        part: what it is.
        geoms: names of its boxes in the MuJoCo model.
        mesh: name of its mesh, without suffix; equal parts share one.
        rgb: colour from 0 to 1.
        position: `[3]` of the part's frame, link frame [m].
        rotation: `[3, 3]` link from part.
    """

    name: str
    row: int
    part: Part
    geoms: tuple[str, ...]
    mesh: str
    rgb: tuple[float, float, float]
    position: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class Link:
    """A rigid piece of the robot.

    Attributes:
        name: `base_link`, or the name of the hinge that moves it with `_link`.
        body: id in the MuJoCo model.
        parent: index among the links; -1 for the base.
        joint: that moves it; None for the base.
        position: `[3]` of its frame at rest, parent's frame [m].
        rotation: `[3, 3]` parent from link at rest.
        mass: [kg].
        center_of_mass: `[3]` link frame [m].
        inertia: `[3, 3]` about the centre of mass, link's axes [kg·m²].
        parts: what it is made of.
    """

    name: str
    body: int
    parent: int
    joint: Joint | None
    position: np.ndarray
    rotation: np.ndarray
    mass: float
    center_of_mass: np.ndarray
    inertia: np.ndarray
    parts: tuple[PlacedPart, ...]


def make_links(robot: Robot) -> tuple[Link, ...]:
    """The robot's links, each after its parent.

    Args:
        robot: from `build_robot`.

    Returns:
        The links, in the order of MuJoCo's bodies.
    """
    model = robot.mj_model
    modules = [model.body(body).name for body in range(1, model.nbody)]
    names = unique_names(
        [BASE] + [f"{plain(name)}_link" for name in modules[1:]], taken={WORLD, ODOM}
    )
    joints = unique_names([plain(name) for name in modules], taken={*names})
    parts = _place_parts(robot, taken={*names, *joints})
    links = []
    for body, (name, joint) in enumerate(zip(names, joints, strict=True), 1):
        axes = quat_to_matrix(model.body_iquat[body])
        links.append(
            Link(
                name=name,
                body=body,
                parent=int(model.body_parentid[body]) - 1,
                joint=_make_joint(robot, body, joint) if body > 1 else None,
                position=model.body_pos[body].copy(),
                rotation=quat_to_matrix(model.body_quat[body]),
                mass=float(model.body_mass[body]),
                center_of_mass=model.body_ipos[body].copy(),
                inertia=axes @ np.diag(model.body_inertia[body]) @ axes.T,
                parts=tuple(part for part in parts if robot.fluid.body[part.row] == body),
            )
        )
    return tuple(links)


def make_meshes(morphology: Morphology) -> dict[str, trimesh.Trimesh]:
    """The meshes of a robot's parts, part frame [m].

    Args:
        morphology: the robot's modules.

    Returns:
        By the names that `PlacedPart.mesh` has.
    """
    drawn = dict(zip(_mesh_names(morphology), _parts(morphology), strict=True))
    return {name: part_mesh(module.kind, part) for name, (module, part) in drawn.items()}


def rest_pose(links: tuple[Link, ...], index: int) -> tuple[np.ndarray, np.ndarray]:
    """Where a link is at rest.

    Args:
        links: from `make_links`.
        index: of the link.

    Returns:
        `[3]` position in the base's frame [m] and `[3, 3]` base from link.
    """
    link = links[index]
    if link.parent < 0:
        return np.zeros(3), np.eye(3)
    position, rotation = rest_pose(links, link.parent)
    return position + rotation @ link.position, rotation @ link.rotation


def plain(name: str) -> str:
    """A name of letters, digits and _ only, as ROS, Gazebo and XML all take it."""
    found = re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
    return f"m{found}" if re.fullmatch("world|__.*__", found) else found  # which Gazebo reserves


def roll_pitch_yaw(rotation: np.ndarray) -> np.ndarray:
    """Angles about the fixed axes x, then y, then z, as URDF and SDF have them.

    Args:
        rotation: `[3, 3]`.

    Returns:
        `[3]` [rad]; where the pitch is ±90°, so that roll and yaw turn alike, yaw is 0.
    """
    r = np.asarray(rotation, np.float64)
    level = np.hypot(r[0, 0], r[1, 0])
    pitch = np.arctan2(-r[2, 0], level)
    if level < 1e-9:
        return np.array([np.arctan2(-r[2, 0] * r[0, 1], r[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(r[2, 1], r[2, 2]), pitch, np.arctan2(r[1, 0], r[0, 0])])


def inertia_entries(inertia: np.ndarray) -> dict[str, float]:
    """The entries of a `[3, 3]` inertia by the names that URDF and SDF have for them."""
    return {f"i{'xyz'[i]}{'xyz'[j]}": inertia[i, j] for i in range(3) for j in range(i, 3)}


def near_bed(robot: Robot) -> Bed | None:
    """The bed of a robot's world, if it is near enough to be exported.

    Args:
        robot: that starts at the origin.

    Returns:
        The bed, or None.
    """
    bed = robot.world.bed
    if bed is None:
        return None
    deep = robot.world.surface_height - float(bed_height(bed, np.float64(0), np.float64(0)))
    return bed if deep <= _BED_DEPTH else None


def missing_flow(world: World) -> list[tuple[object, str]]:
    """Flow that other simulators lack: for each kind, whether the world has it, and its name."""
    names = ("shear", "current_field", "gust", "waves", "surface_tension")
    return [(getattr(world, name), f"the world's {name.replace('_', ' ')}") for name in names]


def _make_joint(robot: Robot, body: int, name: str) -> Joint:
    model, joint = robot.mj_model, int(robot.mj_model.body_jntadr[body])
    endless = -math.inf, math.inf
    low, high = map(float, model.jnt_range[joint] if model.jnt_limited[joint] else endless)
    [servo] = [k for k in robot.servos if model.actuator_trnid[k, 0] == joint]
    dof = int(model.jnt_dofadr[joint])
    torque = model.actuator_forcerange[servo] if model.actuator_forcelimited[servo] else endless
    return Joint(
        name=name,
        axis=model.jnt_axis[joint].copy(),
        range=(low, high),
        effort=float(torque[1]),
        speed=float(model.jnt_user[joint, 0]),
        damping=float(model.dof_damping[dof]),
        stiffness=float(model.actuator_gainprm[servo, 0]),
        qpos=int(model.jnt_qposadr[joint]),
        qvel=dof,
        ctrl=servo,
    )


def _parts(morphology: Morphology) -> list[tuple[Module, Part]]:
    """Modules and parts in the order of the fluid table."""
    return [(module, part) for module in morphology.modules for part in module.kind.parts]


def _place_parts(robot: Robot, taken: set[str]) -> list[PlacedPart]:
    table, parts = robot.fluid, _parts(robot.morphology)
    names = unique_names([plain(f"{m.name}_{p.name}") for m, p in parts], taken, _ADDED)
    rows = zip(names, _mesh_names(robot.morphology), parts, strict=True)
    return [
        PlacedPart(
            name=name,
            row=row,
            part=part,
            geoms=tuple(
                f"{module.name}/{part.name}" + (f"/{k}" if k else "")
                for k in range(len(part.boxes))
            ),
            mesh=mesh,
            rgb=module.rgb if module.rgb is not None else GREY,
            position=table.position[row],
            rotation=table.rotation[row],
        )
        for row, (name, mesh, (module, part)) in enumerate(rows)
    ]


def _mesh_names(morphology: Morphology) -> list[str]:
    """For each part the name of its mesh: that of type and part, numbered where shapes differ."""
    parts = _parts(morphology)
    stems = [plain(f"{module.kind.name}_{part.name}").lower() for module, part in parts]
    taken = {*stems}
    # All that a mesh depends on.
    drawn = [
        (stem, module.kind.hinge, part.boxes, part.volume, part.position, part.thruster)
        for stem, (module, part) in zip(stems, parts, strict=True)
    ]
    names: dict[object, str] = {}
    for stem, shape in zip(stems, drawn, strict=True):
        if shape not in names:
            names[shape] = free_name(stem, taken) if stem in names.values() else stem
            taken.add(names[shape])
    return [names[shape] for shape in drawn]


def unique_names(names: list[str], taken: set[str], added: Sequence[str] = ("",)) -> list[str]:
    """The names, those that are taken with a number at the end.

    Args:
        names: in order; the first of equal ones stays.
        taken: others.
        added: what is put behind names in turn; all of that is unique, too.
    """
    taken, found = {*taken}, []
    for name in names:
        numbered = itertools.chain([name], (f"{name}_{k}" for k in itertools.count(2)))
        free = (one for one in numbered if taken.isdisjoint(f"{one}{end}" for end in added))
        found.append(next(free))
        taken |= {f"{found[-1]}{end}" for end in added}
    return found


def words_on_laws(
    robot: Robot, export: Callable[[DragLaw | BuoyancyLaw], Export]
) -> tuple[list[str], list[str], list[str]]:
    """The text of a file's comment on the laws of a robot's parts.

    Args:
        robot: from `build_robot`.
        export: of a law, for the file's format.

    Returns:
        Notes on what stands for its buoyancy laws, for its drag laws, and what is lost of both.
    """
    lifting = [export(law) for name, law in BUOYANCY_LAWS.items() if name in robot.fluid.buoyancy]
    dragging = [export(law) for name, law in DRAG_LAWS.items() if name in robot.fluid.drag]
    notes = [list(dict.fromkeys(x.note for x in some if x.note)) for some in (lifting, dragging)]
    return notes[0], notes[1], [x.missing for x in (*lifting, *dragging) if x.missing]
