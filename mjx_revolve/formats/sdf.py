"""A robot in its water as an SDF world for Gazebo (gz-sim), by Gazebo's own plugins.

Each part of a module is a link of its own, welded to its neighbours, since Gazebo's water acts on
links: so the drag and the added mass of every part carry over as they are, and buoyancy nearly so.
A comment in the file says what does not.

Sources: gz-sim, `src/systems/` `buoyancy`, `hydrodynamics`, `lift_drag`, `thruster` and
`joint_position_controller`; sdformat, `sdf/1.11` (both as of August 2026).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from mjx_revolve.body.module_types import Part
from mjx_revolve.engine.robot import Robot
from mjx_revolve.formats.links import (
    BASE,
    Link,
    Shape,
    exact,
    make_links,
    matrix,
    numbers,
    plain,
    rest_pose,
    roll_pitch_yaw,
    to_list,
    to_text,
)
from mjx_revolve.formats.mjcf import near_bed
from mjx_revolve.water.thrusters import thrust

# Gazebo's usual step [s]: its water is explicit.
_STEP = 0.001
# A link must weigh something; what has no mass of its own gets this [kg].
_LEAST = 1e-6
# Radius of a ballast, as `robot.py` has it [m].
_BALLAST = 1e-3
# Share of a thruster's mass that is its propeller, and thrust coefficient K_T of a propeller at
# standstill (Carlton, Marine Propellers and Propulsion, chapter 6); both only make it spin.
_ROTOR, _THRUST_COEFFICIENT = 0.05, 0.3

_NOTE = """
  {title} in its water, for Gazebo Harmonic or newer (gz-sim 8, with its default physics, DART):
      gz sim FILE
  Topics: /model/{model}/joint/HINGE/0/cmd_pos for a hinge's angle [rad], and
  /model/{model}/joint/NAME_propeller_joint/cmd_thrust for a thruster's thrust [N].
  Each part of a module is a link, welded to the others; the frames NAME_link and base_link are the
  links of the URDF and of the rollout's bag.

  The water, by Gazebo's plugins:
{water}
  What does not carry over:
{missing}
"""


@dataclass(frozen=True)
class _Inertia:
    """Mass [kg], centre of mass [m], and inertia about it [kg·m²], in a part's frame."""

    mass: float
    center: np.ndarray
    matrix: np.ndarray


def make_sdf(robot: Robot, meshes: str = "meshes/", start: np.ndarray | None = None) -> str:
    """The robot's world as SDF.

    Args:
        robot: from `build_robot`.
        meshes: what the names of mesh files begin with.
        start: `[nq]` where the robot begins, its hinges at rest; by default 1 m deep.

    Returns:
        The XML text.
    """
    links = make_links(robot)
    start = robot.start_qpos() if start is None else np.asarray(start, np.float64)
    name = plain(robot.morphology.name)
    root = Element("sdf", version="1.11")
    world = SubElement(root, "world", name=plain(f"{name}_{robot.world.name}"))
    water = _set_world(robot, world)
    model = SubElement(world, "model", name=name, canonical_link=links[0].shapes[0].name)
    _pose(model, start[:3], matrix(start[3:7] / np.linalg.norm(start[3:7])))
    _text(model, "self_collide", "false")
    for link in links:
        _add_link(robot, model, links, link, meshes)
    for link in links[1:]:
        _add_hinge(model, link, links[link.parent])
    water += _add_forces(robot, model, links)
    _plugin(model, "joint-state-publisher", "JointStatePublisher")
    _plugin(
        model,
        "odometry-publisher",
        "OdometryPublisher",
        odom_frame="odom",
        robot_base_frame=BASE,
        dimensions="3",
    )
    note = _NOTE.format(
        title=robot.morphology.name,
        model=name,
        water=to_list(water),
        missing=to_list(_missing(robot)),
    )
    return to_text(root, note)


def part_inertia(part: Part) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass of a part with its ballast, as the MuJoCo model has it.

    Args:
        part: whose mass is spread evenly over its main box.

    Returns:
        Mass [kg], `[3]` centre of mass, part frame [m], and `[3, 3]` inertia about it [kg·m²].
    """
    square = np.asarray(part.boxes[0].size) ** 2
    box = _Inertia(part.mass, np.zeros(3), np.diag(part.mass / 12 * (square.sum() - square)))
    ball = _Inertia(
        part.ballast_mass,
        np.asarray(part.ballast_position, float),
        0.4 * part.ballast_mass * _BALLAST**2 * np.eye(3),
    )
    whole = _sum(box, ball)
    return whole.mass, whole.center, whole.matrix


def _sum(a: _Inertia, b: _Inertia, sign: float = 1.0) -> _Inertia:
    """Two bodies as one; with `sign` -1, the first without the second."""
    mass = a.mass + sign * b.mass
    if mass <= 0:
        return _Inertia(0.0, np.zeros(3), np.zeros((3, 3)))
    center = (a.mass * a.center + sign * b.mass * b.center) / mass
    matrix = np.zeros((3, 3))
    for one, share in ((a, 1.0), (b, sign)):
        arm = one.center - center
        matrix += share * (one.matrix + one.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm)))
    return _Inertia(mass, center, matrix)


def _rotor(part: Part) -> tuple[_Inertia, float]:
    """A thruster's propeller as a thin disc, part frame, and its diameter [m]."""
    assert part.thruster is not None
    axis = np.asarray(part.thruster.axis)
    across = np.abs(axis) < 0.99 * np.abs(axis).max()
    diameter = 0.9 * float(np.asarray(part.boxes[0].size)[across].min())
    mass = max(_ROTOR * part.mass, _LEAST)
    along = np.outer(axis, axis)
    matrix = mass * diameter**2 / 16 * (np.eye(3) + along)
    return _Inertia(mass, np.asarray(part.thruster.position, float), matrix), diameter


# ------------------------------------------------------------------------- elements


def _text(parent: Element, tag: str, text: str, **attributes: str) -> Element:
    child = SubElement(parent, tag, attributes)
    child.text = text
    return child


def _pose(
    parent: Element, position: Any, rotation: np.ndarray, relative_to: str | None = None
) -> None:
    text = f"{numbers(position)} {numbers(roll_pitch_yaw(rotation))}"
    attributes = {} if relative_to is None else {"relative_to": relative_to}
    _text(parent, "pose", text, **attributes)


def _plugin(parent: Element, file: str, kind: str, **fields: str) -> Element:
    """A gz-sim system; its fields in the order given."""
    plugin = SubElement(
        parent, "plugin", filename=f"gz-sim-{file}-system", name=f"gz::sim::systems::{kind}"
    )
    for tag, text in fields.items():
        _text(plugin, tag, text)
    return plugin


def _material(parent: Element, rgb: tuple[float, float, float]) -> None:
    material = SubElement(parent, "material")
    for tag in ("ambient", "diffuse"):
        _text(material, tag, numbers([*rgb, 1.0]))
    _text(material, "specular", "0.2 0.2 0.2 1")


def _inertial(parent: Element, inertia: _Inertia) -> Element:
    element = SubElement(parent, "inertial")
    _pose(element, inertia.center, np.eye(3))
    _text(element, "mass", exact(max(inertia.mass, _LEAST)))
    matrix = inertia.matrix if inertia.mass > 0 else _LEAST * 1e-4 * np.eye(3)
    entries = SubElement(element, "inertia")
    for i in range(3):
        for j in range(i, 3):
            _text(entries, "i" + "xyz"[i] + "xyz"[j], exact(matrix[i, j]))
    return element


# ------------------------------------------------------------------------- the world


def _set_world(robot: Robot, parent: Element) -> list[str]:
    """Physics, plugins, light and bed; returns what the buoyancy is, in words."""
    world, lines = robot.world, []
    physics = SubElement(parent, "physics", name="water", type="dart")
    _text(physics, "max_step_size", exact(_STEP))
    _text(physics, "real_time_factor", "1")
    _text(parent, "gravity", numbers([0, 0, -world.gravity]))
    _plugin(parent, "physics", "Physics")
    _plugin(parent, "user-commands", "UserCommands")
    _plugin(parent, "scene-broadcaster", "SceneBroadcaster")
    if any(law != "off" for law in robot.fluid.buoyancy) and world.density > 0:
        plugin = _plugin(parent, "buoyancy", "Buoyancy")
        graded = SubElement(plugin, "graded_buoyancy")
        _text(graded, "default_density", exact(world.density))
        change = SubElement(graded, "density_change")
        _text(change, "above_depth", exact(world.surface_height))
        _text(change, "density", "0")
        lines.append(
            "Buoyancy lifts with the volume of the collision boxes, so these have the volume that "
            "a part displaces, at its centre of volume, and the proportions of its box: not its "
            "size"
        )
    scene = SubElement(parent, "scene")
    _text(scene, "ambient", "0.5 0.6 0.65 1")
    _text(scene, "background", "0.25 0.5 0.6 1")
    _text(scene, "grid", "false")
    light = SubElement(parent, "light", type="directional", name="sun")
    _pose(light, [0, 0, 10], np.eye(3))
    _text(light, "diffuse", "0.9 0.9 0.9 1")
    _text(light, "specular", "0.3 0.3 0.3 1")
    _text(light, "direction", "-0.4 0.3 -0.9")
    _text(light, "cast_shadows", "true")
    bed = near_bed(robot)
    if bed is not None and bed.kind == "flat":
        model = SubElement(parent, "model", name="bed")
        _text(model, "static", "true")
        _pose(model, [0, 0, bed.height], np.eye(3))
        link = SubElement(model, "link", name="bed")
        for kind in ("collision", "visual"):
            element = SubElement(link, kind, name=kind)
            plane = SubElement(SubElement(element, "geometry"), "plane")
            _text(plane, "normal", "0 0 1")
            _text(plane, "size", numbers([bed.extent, bed.extent]))
            if kind == "collision":
                friction = SubElement(SubElement(SubElement(element, "surface"), "friction"), "ode")
                _text(friction, "mu", exact(bed.friction))
                _text(friction, "mu2", exact(bed.friction))
            else:
                _material(element, (0.76, 0.70, 0.50))
    return lines


# ------------------------------------------------------------------------- the robot


def _add_link(
    robot: Robot, model: Element, links: tuple[Link, ...], link: Link, meshes: str
) -> None:
    """The parts of a link as links, welded to the first of them, and the link's own frame."""
    position, rotation = rest_pose(links, link.body - 1)
    first = link.shapes[0]
    frame = SubElement(model, "frame", name=link.name, attached_to=first.name)
    _pose(
        frame,
        -first.rotation.T @ first.position,
        first.rotation.T,
        relative_to=first.name,
    )
    for shape in link.shapes:
        element = SubElement(model, "link", name=shape.name)
        _pose(element, position + rotation @ shape.position, rotation @ shape.rotation)
        inertia = _Inertia(*part_inertia(shape.part))
        if shape.part.thruster is not None:
            inertia = _sum(inertia, _rotor(shape.part)[0], -1.0)
        inertial = _inertial(element, inertia)
        _add_carried(robot, inertial, shape)
        visual = SubElement(element, "visual", name="visual")
        mesh = SubElement(SubElement(visual, "geometry"), "mesh")
        _text(mesh, "uri", f"{meshes}{shape.mesh}.stl")
        _material(visual, shape.rgb)
        _add_collision(robot, element, shape)
        if shape is not first:
            weld = SubElement(model, "joint", name=f"{shape.name}_weld", type="fixed")
            _text(weld, "parent", first.name)
            _text(weld, "child", shape.name)
        if shape.part.thruster is not None:
            _add_rotor(model, shape)


def _add_carried(robot: Robot, inertial: Element, shape: Shape) -> None:
    """Added mass and entrained water of a part: diagonal, since its link is its box's frame."""
    density, table = robot.world.density, robot.fluid
    mass = density * table.carried_mass[shape.row]
    moment = density * table.carried_inertia[shape.row]
    if not (mass.any() or moment.any()):
        return
    element = SubElement(inertial, "fluid_added_mass")
    for tag, value in zip(("xx", "yy", "zz", "pp", "qq", "rr"), [*mass, *moment], strict=True):
        _text(element, tag, exact(value))


def _add_collision(robot: Robot, element: Element, shape: Shape) -> None:
    """A box with the part's displaced volume, for Gazebo's buoyancy, and for contact."""
    table, row = robot.fluid, shape.row
    if table.buoyancy[row] == "off" or table.volume[row] <= 0:
        return
    size = 2 * table.half_size[row]
    size = size * (table.volume[row] / size.prod()) ** (1 / 3)
    collision = SubElement(element, "collision", name="collision")
    _pose(collision, table.center_of_volume[row], np.eye(3))
    _text(SubElement(SubElement(collision, "geometry"), "box"), "size", exact(size))
    if not shape.part.contact:
        contact = SubElement(SubElement(collision, "surface"), "contact")
        _text(contact, "collide_bitmask", "0")


def _add_rotor(model: Element, shape: Shape) -> None:
    """A propeller that turns about the thrust's axis, for Gazebo's thruster to push at."""
    part = shape.part
    inertia, _ = _rotor(part)
    name = f"{shape.name}_propeller"
    element = SubElement(model, "link", name=name)
    _pose(element, inertia.center, np.eye(3), relative_to=shape.name)
    _inertial(element, _Inertia(inertia.mass, np.zeros(3), inertia.matrix))
    joint = SubElement(model, "joint", name=f"{name}_joint", type="revolute")
    _text(joint, "parent", shape.name)
    _text(joint, "child", name)
    axis = SubElement(joint, "axis")
    assert part.thruster is not None
    _text(axis, "xyz", numbers(part.thruster.axis))


def _add_hinge(model: Element, link: Link, parent: Link) -> None:
    joint = link.joint
    assert joint is not None
    element = SubElement(model, "joint", name=joint.name, type="revolute")
    _pose(element, np.zeros(3), np.eye(3), relative_to=link.name)
    _text(element, "parent", parent.shapes[0].name)
    _text(element, "child", link.shapes[0].name)
    axis = SubElement(element, "axis")
    _text(axis, "xyz", numbers(joint.axis))
    limit = SubElement(axis, "limit")
    for tag, value in zip(
        ("lower", "upper", "effort", "velocity"),
        (*joint.range, joint.effort, joint.speed),
        strict=True,
    ):
        _text(limit, tag, exact(value))
    _text(SubElement(axis, "dynamics"), "damping", exact(joint.damping))


def _add_forces(robot: Robot, model: Element, links: tuple[Link, ...]) -> list[str]:
    """Plugins of drag, fins, thrusters and servos; returns what they are, in words."""
    lines = []
    world, table = robot.world, robot.fluid
    if table.carried_mass.any():
        lines.append("fluid_added_mass carries the added mass, and the water inside, of each part")
    for link in links:
        for shape in link.shapes:
            law = table.drag[shape.row]
            if law == "lift_drag":
                _add_fin(robot, model, shape)
            elif law != "off":
                _add_drag(robot, model, shape)
            if shape.part.thruster is not None:
                _add_thruster(robot, model, shape)
        if link.joint is not None:
            effort = exact(link.joint.effort)
            _plugin(
                model,
                "joint-position-controller",
                "JointPositionController",
                joint_name=link.joint.name,
                p_gain=exact(link.joint.stiffness),
                i_gain="0",
                d_gain="0",
                cmd_max=effort,
                cmd_min=f"-{effort}",
            )
    if set(table.drag) - {"off", "lift_drag"}:
        lines.append("Hydrodynamics drags each part with the coefficients of its faces")
    if "lift_drag" in table.drag:
        lines.append("LiftDrag lifts and drags the fins")
    if any(world.current):
        lines.append("the drag knows the current")
    if robot.num_thrusters:
        lines.append("Thruster pushes at propellers, which are links of their own")
    return lines


def _add_drag(robot: Robot, model: Element, shape: Shape) -> None:
    """Gazebo wants damping negative, after Fossen."""
    density, table = robot.world.density, robot.fluid
    values = [*table.drag_linear[shape.row], *table.drag_angular[shape.row]]
    tags = ("xUabsU", "yVabsV", "zWabsW", "kPabsP", "mQabsQ", "nRabsR")
    fields = {tag: exact(-density * x) for tag, x in zip(tags, values, strict=True)}
    _plugin(
        model,
        "hydrodynamics",
        "Hydrodynamics",
        link_name=shape.name,
        water_density=exact(density),
        default_current=numbers(robot.world.current),
        **fields,
    )


def _add_fin(robot: Robot, model: Element, shape: Shape) -> None:
    table, row = robot.fluid, shape.row
    plate = table.plate[row]
    names = ("a0", "cla", "cda", "cma", "alpha_stall", "cla_stall", "cda_stall", "cma_stall")
    density = robot.world.density if plate.density is None else plate.density
    _plugin(
        model,
        "lift-drag",
        "LiftDrag",
        link_name=shape.name,
        air_density=exact(density),
        area=exact(table.plate_area[row]),
        forward=numbers(table.plate_forward[row]),
        upward=numbers(table.plate_upward[row]),
        cp=numbers(table.plate_center[row]),
        radial_symmetry=str(plate.radial_symmetry).lower(),
        reversible="true",
        **{name: exact(getattr(plate, name)) for name in names},
    )


def _add_thruster(robot: Robot, model: Element, shape: Shape) -> None:
    thruster = shape.part.thruster
    assert thruster is not None
    low, high = thrust(thruster, np.array(thruster.range))
    diameter = _rotor(shape.part)[1]
    # Gazebo's formula has radians where K_T has turns; its sign is the propeller's hand.
    coefficient = _THRUST_COEFFICIENT / (2 * np.pi) ** 2
    hand = -1 if thruster.torque_ratio < 0 else 1
    _plugin(
        model,
        "thruster",
        "Thruster",
        joint_name=f"{shape.name}_propeller_joint",
        fluid_density=exact(robot.world.density),
        propeller_diameter=exact(diameter),
        thrust_coefficient=exact(hand * coefficient),
        velocity_control="true",
        max_thrust_cmd=exact(float(high)),
        min_thrust_cmd=exact(float(low)),
    )


def _missing(robot: Robot) -> list[str]:
    """What Gazebo's plugins lack of this robot and its world, a line each."""
    world, table = robot.world, robot.fluid
    lines = [
        "tilt at the surface: Gazebo cuts boxes as if they stood level",
        "the share of drag and added mass that is lost above the surface",
        "contact at the modules' true corners: the collision boxes are those of the buoyancy",
    ]
    if robot.num_hinges:
        lines.append("the fall of a servo's torque towards its top speed: its limit is sharp here")
    if "mask" in table.buoyancy:
        lines.append("buoyancy: mask, all or nothing at the surface")
    for law in ("ellipsoid", "inertia_box"):
        if law in table.drag:
            lines.append(f"drag: {law}, in whose place is the drag of the modules' faces")
    if "lift_drag" in table.drag:
        lines.append("the current at the fins: Gazebo's LiftDrag knows the wind only")
    if robot.num_thrusters:
        lines.append(
            "the thrusters' curves, lag and reaction torque, and that they lose thrust out of the "
            "water: the command is the thrust itself"
        )
    lines += [
        f"the world's {name.replace('_', ' ')}"
        for name in ("shear", "current_field", "gust", "waves", "surface_tension")
        if getattr(world, name)
    ]
    bed = near_bed(robot)
    if world.bed is not None and (bed is None or bed.kind != "flat"):
        lines.append("the bed")
    return lines
