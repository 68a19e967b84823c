"""A robot as other programs see it: links, joints and shapes, with names that they all accept.

What is welded together is one link. URDF, ROS topics and SDF take their frames from here, so that a
transform in a bag fits the link of the same name in a URDF. MuJoCo bodies are links one to one.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from xml.etree import ElementTree

import mujoco
import numpy as np
import trimesh

from mjx_revolve.body.module_types import Part
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.body.placement import Module
from mjx_revolve.body.solids import part_mesh
from mjx_revolve.engine.robot import Robot

# The names of ROS (REP 105) for what does not move, for where a robot's odometry starts, and for
# the robot's main part.
WORLD, ODOM, BASE = "world", "odom", "base_link"

# Colour of a module whose YAML gives none: that of its geoms in the model.
_GREY = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class Joint:
    """A motorised hinge at the origin of its link.

    Attributes:
        name: of its module, in letters that every program takes.
        axis: `[3]` unit vector, link frame.
        range: lowest and highest angle [rad]; 0 is the rest pose.
        effort: largest torque of the motor [N·m].
        speed: largest speed of the motor [rad/s].
        damping: viscous friction [N·m·s/rad].
        stiffness: of the position servo [N·m/rad].
    """

    name: str
    axis: np.ndarray
    range: tuple[float, float]
    effort: float
    speed: float
    damping: float
    stiffness: float


@dataclass(frozen=True)
class Shape:
    """A part of a module, placed on its link.

    Attributes:
        name: unique in the robot: those of module and part.
        row: of the fluid table.
        part: what it is.
        mesh: name of its mesh, without suffix; equal parts share one.
        rgb: colour from 0 to 1.
        position: `[3]` of the part's frame, link frame [m].
        rotation: `[3, 3]` link from part.
    """

    name: str
    row: int
    part: Part
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
        shapes: what it is made of.
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
    shapes: tuple[Shape, ...]


def make_links(robot: Robot) -> tuple[Link, ...]:
    """The robot's links, each after its parent.

    Args:
        robot: from `build_robot`.

    Returns:
        The links, in the order of MuJoCo's bodies.
    """
    model = robot.mj_model
    servo = {int(model.actuator_trnid[k, 0]): k for k in robot.servos}
    names = _unique(
        [BASE] + [f"{plain(model.body(b).name)}_link" for b in range(2, model.nbody)],
        taken={WORLD, ODOM},
    )
    joints = _unique([plain(model.body(b).name) for b in range(1, model.nbody)], taken={*names})
    shapes = _make_shapes(robot, taken={*names, *joints})
    links = []
    for body in range(1, model.nbody):
        joint = int(model.body_jntadr[body])
        axes = matrix(model.body_iquat[body])
        links.append(
            Link(
                name=names[body - 1],
                body=body,
                parent=int(model.body_parentid[body]) - 1,
                joint=_make_joint(robot, joint, servo[joint], joints[body - 1])
                if body > 1
                else None,
                position=model.body_pos[body].copy(),
                rotation=matrix(model.body_quat[body]),
                mass=float(model.body_mass[body]),
                center_of_mass=model.body_ipos[body].copy(),
                inertia=axes @ np.diag(model.body_inertia[body]) @ axes.T,
                shapes=tuple(s for s in shapes if robot.fluid.body[s.row] == body),
            )
        )
    return tuple(links)


def make_meshes(morphology: Morphology) -> dict[str, trimesh.Trimesh]:
    """The meshes of a robot's parts, part frame [m].

    Args:
        morphology: the robot's modules.

    Returns:
        By the names that `Shape.mesh` has.
    """
    names, parts = _mesh_names(morphology), _parts(morphology)
    found: dict[str, trimesh.Trimesh] = {}
    for name, (module, part) in zip(names, parts, strict=True):
        if name not in found:
            found[name] = part_mesh(module.kind, part)
    return found


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
    return re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"


def matrix(quat: np.ndarray) -> np.ndarray:
    """`[3, 3]` rotation of a quaternion (w, x, y, z)."""
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, np.asarray(quat, np.float64))
    return flat.reshape(3, 3)


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


def numbers(values: Iterable[float] | float) -> str:
    """Numbers as XML has them: twelve digits, rounding errors around 0 left out."""
    rounded = np.round(np.atleast_1d(np.asarray(values, np.float64)), 15) + 0.0
    return " ".join(f"{x:.12g}" for x in rounded)


def exact(values: Iterable[float] | float) -> str:
    """Numbers as XML has them, however small: twelve digits."""
    return " ".join(f"{x + 0.0:.12g}" for x in np.atleast_1d(np.asarray(values, np.float64)))


def to_text(root: ElementTree.Element, comment: str) -> str:
    """An XML document, indented.

    Args:
        root: of the document.
        comment: that stands above it; a line each.

    Returns:
        The text.
    """
    ElementTree.indent(root)
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0"?>\n{to_comment(comment)}\n{body}\n'


def to_comment(text: str) -> str:
    """An XML comment; two hyphens, which none may hold, are spread."""
    text = text.strip("\n")
    while "--" in text:
        text = text.replace("--", "- -")
    return f"<!--\n{text}\n-->"


def to_list(lines: Iterable[str]) -> str:
    """Lines of a comment, each wrapped behind a dash."""
    return "\n".join(
        textwrap.fill(line, 98, initial_indent="  - ", subsequent_indent="    ") for line in lines
    )


def _make_joint(robot: Robot, joint: int, servo: int, name: str) -> Joint:
    model = robot.mj_model
    low, high = map(float, model.jnt_range[joint])
    return Joint(
        name=name,
        axis=model.jnt_axis[joint].copy(),
        range=(low, high),
        effort=float(model.actuator_forcerange[servo, 1]),
        speed=float(model.jnt_user[joint, 0]),
        damping=float(model.dof_damping[model.jnt_dofadr[joint]]),
        stiffness=float(model.actuator_gainprm[servo, 0]),
    )


def _parts(morphology: Morphology) -> list[tuple[Module, Part]]:
    """Modules and parts in the order of the fluid table."""
    return [(module, part) for module in morphology.modules for part in module.kind.parts]


def _make_shapes(robot: Robot, taken: set[str]) -> list[Shape]:
    table, parts = robot.fluid, _parts(robot.morphology)
    names = _unique([plain(f"{m.name}_{p.name}") for m, p in parts], taken)
    return [
        Shape(
            name=name,
            row=row,
            part=part,
            mesh=mesh,
            rgb=module.rgb if module.rgb is not None else _GREY,
            position=table.position[row],
            rotation=table.rotation[row],
        )
        for row, (name, mesh, (module, part)) in enumerate(
            zip(names, _mesh_names(robot.morphology), parts, strict=True)
        )
    ]


def _mesh_names(morphology: Morphology) -> list[str]:
    """For each part the name of its mesh: that of type and part, numbered where shapes differ."""
    seen: dict[str, list[object]] = {}
    names = []
    for module, part in _parts(morphology):
        stem = plain(f"{module.kind.name}_{part.name}").lower()
        # All that a mesh depends on.
        drawn = (module.kind.hinge, part.boxes, part.volume, part.position, part.thruster)
        shapes = seen.setdefault(stem, [])
        if drawn not in shapes:
            shapes.append(drawn)
        number = shapes.index(drawn)
        names.append(f"{stem}_{number + 1}" if number else stem)
    return names


def _unique(names: list[str], taken: set[str]) -> list[str]:
    """The names, those that are taken with a number at the end."""
    taken, found = {*taken}, []
    for name in names:
        count, other = 2, name
        while other in taken:
            other, count = f"{name}_{count}", count + 1
        taken.add(other)
        found.append(other)
    return found
