"""A robot in its water as an SDF world for Gazebo (gz-sim), by Gazebo's own plugins.

Each part of a module is a link of its own, welded to its neighbours, since Gazebo's water acts on
links: so drag and added mass of every part are exported exactly, and buoyancy nearly so. A comment
in the file lists the differences.

Sources: gz-sim, `src/systems/` `buoyancy`, `hydrodynamics`, `lift_drag`, `thruster` and
`joint_position_controller`; sdformat, `sdf/1.11` (both as of August 2026).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from xml.etree.ElementTree import Element

import jax
import numpy as np

from mjx_revolve.engine.mujoco_model import SAND
from mjx_revolve.engine.robot import Robot
from mjx_revolve.formats.inertias import moments, part_spread, propeller
from mjx_revolve.formats.links import (
    BASE,
    Link,
    PlacedPart,
    inertia_entries,
    make_links,
    missing_flow,
    near_bed,
    plain,
    rest_pose,
    roll_pitch_yaw,
    unique_names,
    words_on_laws,
)
from mjx_revolve.formats.xml_text import Value, node, nodes, to_document, to_list
from mjx_revolve.numerics.spatial import quat_to_matrix
from mjx_revolve.water.buoyancy import find_buoyancy_law
from mjx_revolve.water.drag import find_drag_law
from mjx_revolve.water.face_drag import FACES, FaceNumbers
from mjx_revolve.water.fossen import FOSSEN
from mjx_revolve.water.laws import part_numbers
from mjx_revolve.water.lift_drag import LIFT_DRAG, PlateNumbers
from mjx_revolve.water.thrusters import thrust

# Gazebo's usual step [s]: its water is explicit.
_STEP = 0.001
# Thrust coefficient K_T of a propeller at standstill (Carlton, Marine Propellers and Propulsion,
# chapter 6); it only makes it spin.
_THRUST_COEFFICIENT = 0.3
# Gazebo's names of forces and of velocities, after Fossen.
_FORCES = "xyzkmn", "UVWPQR"

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
    model = node(
        "model",
        _pose(start[:3], quat_to_matrix(start[3:7] / np.linalg.norm(start[3:7]))),
        node("self_collide", len(robot.assembly.meeting_pairs) > 0),
        *(one for link in links for one in _link(robot, links, link, meshes)),
        *(_hinge(robot, link, links[link.parent]) for link in links[1:]),
        *(one for link in links for one in _forces(robot, link)),
        _plugin("joint-state-publisher"),
        _plugin("odometry-publisher", odom_frame="odom", robot_base_frame=BASE, dimensions=3),
        name=name,
        canonical_link=_root(robot, links[0]).name,
    )
    world = node("world", *_surroundings(robot), model, name=plain(f"{name}_{robot.world.name}"))
    note = _NOTE.format(
        title=robot.morphology.name,
        model=name,
        water=to_list(_water(robot)),
        missing=to_list(_missing(robot, links)),
    )
    return to_document(node("sdf", world, version="1.11"), note)


# ------------------------------------------------------------------------- elements


def _pose(position: Iterable[float], rotation: np.ndarray, **relative_to: str) -> Element:
    return node("pose", [*position, *roll_pitch_yaw(rotation)], **relative_to)


def _plugin(file: str, *content: Element, **fields: Value) -> Element:
    """A gz-sim system, such as "lift-drag", LiftDrag; its fields in the order given."""
    name = f"gz::sim::systems::{file.title().replace('-', '')}"
    return node("plugin", *content, *nodes(**fields), filename=f"gz-sim-{file}-system", name=name)


def _inertial(
    mass: float, center: np.ndarray, inertia: np.ndarray, more: Iterable[Element] = ()
) -> Element:
    entries = nodes(**inertia_entries(inertia))
    pose = _pose(center, np.eye(3))
    return node("inertial", pose, node("mass", mass), node("inertia", *entries), *more)


def _material(rgb: tuple[float, float, float]) -> Element:
    color = [*rgb, 1]
    return node("material", *nodes(ambient=color, diffuse=color, specular=[0.2, 0.2, 0.2, 1]))


# ------------------------------------------------------------------------- the world


def _surroundings(robot: Robot) -> Iterator[Element]:
    """Physics, plugins, light and bed."""
    world, bed = robot.world, near_bed(robot)
    physics = nodes(max_step_size=_STEP, real_time_factor=1)
    yield node("physics", *physics, name="water", type="dart")
    yield node("gravity", [0, 0, -world.gravity])
    yield _plugin("physics")
    yield _plugin("user-commands")
    yield _plugin("scene-broadcaster")
    if _floats(robot):
        surface = nodes(above_depth=world.surface_height, density=0)
        graded = [node("default_density", world.density), node("density_change", *surface)]
        yield _plugin("buoyancy", node("graded_buoyancy", *graded))
    colors = nodes(ambient=[0.5, 0.6, 0.65, 1], background=[0.25, 0.5, 0.6, 1], grid=False)
    yield node("scene", *colors)
    yield node(
        "light",
        _pose([0, 0, 10], np.eye(3)),
        *nodes(diffuse=[0.9, 0.9, 0.9, 1], specular=[0.3, 0.3, 0.3, 1]),
        *nodes(direction=[-0.4, 0.3, -0.9], cast_shadows=True),
        type="directional",
        name="sun",
    )
    if bed is not None and bed.kind == "flat":
        plane = nodes(normal=[0, 0, 1], size=[bed.extent, bed.extent])
        rough = node("friction", node("ode", *nodes(mu=bed.friction, mu2=bed.friction)))
        solid, seen = (node("geometry", node("plane", *plane)) for _ in range(2))
        yield node(
            "model",
            node("static", True),
            _pose([0, 0, bed.height], np.eye(3)),
            node(
                "link",
                node("collision", solid, node("surface", rough), name="collision"),
                node("visual", seen, _material(SAND), name="visual"),
                name="bed",
            ),
            name=unique_names(["bed"], {plain(robot.morphology.name)})[0],
        )


def _floats(robot: Robot) -> bool:
    lifts = any(find_buoyancy_law(name).lifts for name in robot.fluid.buoyancy)
    return lifts and robot.world.density > 0


# ------------------------------------------------------------------------- the robot


def _link(robot: Robot, links: tuple[Link, ...], link: Link, meshes: str) -> Iterator[Element]:
    """The link's own frame, and its parts as links that are welded to one of them."""
    position, rotation = rest_pose(links, link.body - 1)
    first = _root(robot, link)
    back = first.rotation.T
    place = _pose(-back @ first.position, back, relative_to=first.name)
    yield node("frame", place, name=link.name, attached_to=first.name)
    for part in link.parts:
        mesh = node("geometry", node("mesh", node("uri", f"{meshes}{part.mesh}.stl")))
        yield node(
            "link",
            _pose(position + rotation @ part.position, rotation @ part.rotation),
            _inertial(*moments(part_spread(part.part)), _carried(robot, part)),
            node("visual", mesh, _material(part.rgb), name="visual"),
            *_collision(robot, part),
            name=part.name,
        )
        if part is not first:
            ends = nodes(parent=first.name, child=part.name)
            yield node("joint", *ends, name=f"{part.name}_weld", type="fixed")
        if part.part.thruster is not None:
            yield from _rotor(part, f"{part.name}_propeller")


def _carried(robot: Robot, part: PlacedPart) -> Iterator[Element]:
    """Added mass and entrained water of a part: its link is its box's frame."""
    table = robot.fluid
    diagonal = [*table.carried_mass[part.row], *table.carried_inertia[part.row]]
    carried = robot.world.density * (np.diag(diagonal) + table.coupling[part.row])
    if carried.any():
        pairs = [(i, j) for i in range(6) for j in range(i, 6) if i == j or carried[i, j]]
        entries = {"xyzpqr"[i] + "xyzpqr"[j]: carried[i, j] for i, j in pairs}
        yield node("fluid_added_mass", *nodes(**entries))


def _collision(robot: Robot, part: PlacedPart) -> Iterator[Element]:
    """A box with the part's displaced volume, for Gazebo's buoyancy, and for contact.

    Where nothing is lifted, of its own size.
    """
    table, row = robot.fluid, part.row
    size, lifted = 2 * table.half_size[row], _is_lifted(robot, part)
    if lifted:
        size = size * (table.volume[row] / size.prod()) ** (1 / 3)
    elif not _is_solid(robot, part):
        return
    pose = _pose(lifted * table.center_of_volume[row], np.eye(3))
    box = node("geometry", node("box", node("size", size)))
    ghost = node("surface", node("contact", node("collide_bitmask", 0)))
    yield node("collision", pose, box, *([] if part.part.contact else [ghost]), name="collision")


def _rotor(part: PlacedPart, name: str) -> Iterator[Element]:
    """A propeller that turns about the thrust's axis, for Gazebo's thruster to push at."""
    assert part.part.thruster is not None
    mass, center, inertia = moments(propeller(part.part)[0])
    pose = _pose(center, np.eye(3), relative_to=part.name)
    yield node("link", pose, _inertial(mass, np.zeros(3), inertia), name=name)
    axis = node("axis", node("xyz", part.part.thruster.axis))
    ends = nodes(parent=part.name, child=name)
    yield node("joint", *ends, axis, name=f"{name}_joint", type="revolute")


def _is_solid(robot: Robot, part: PlacedPart) -> bool:
    """Whether others collide with it."""
    return part.part.contact and (_is_lifted(robot, part) or not _floats(robot))


def _is_lifted(robot: Robot, part: PlacedPart) -> bool:
    lifted = robot.fluid.buoyancy[part.row] != "off" and robot.fluid.volume[part.row] > 0
    return lifted and _floats(robot)


def _root(robot: Robot, link: Link) -> PlacedPart:
    """The part that joints connect: links that none connects collide."""
    return next((part for part in link.parts if _is_solid(robot, part)), link.parts[0])


def _hinge(robot: Robot, link: Link, parent: Link) -> Element:
    joint, module = link.joint, robot.fluid.module
    assert joint is not None
    # A hinge's own two parts overlap; what has none to collide, overlaps the module before it.
    own = int(module[link.parts[0].row])
    for k in (own, robot.morphology.modules[own].parent):
        around = [p for p in parent.parts if module[p.row] == k and _is_solid(robot, p)]
        if around:
            break
    frame = around[0] if around else _root(robot, parent)
    return node(
        "joint",
        _pose(np.zeros(3), np.eye(3), relative_to=link.name),
        *nodes(parent=frame.name, child=_root(robot, link).name),
        node(
            "axis",
            node("xyz", joint.axis),
            node("limit", *nodes(**joint.limit)),
            node("dynamics", node("damping", joint.damping)),
        ),
        name=joint.name,
        type="revolute",
    )


# ------------------------------------------------------------------------- forces


def _forces(robot: Robot, link: Link) -> Iterator[Element]:
    """Plugins of drag, fins, thrusters and servos."""
    for part in link.parts:
        stand_in = find_drag_law(robot.fluid.drag[part.row]).sdf.stand_in
        if stand_in:
            yield PLUGINS[stand_in](robot, part)
        if stand_in == "lift_drag":  # Gazebo's plugin lacks drag against turning
            plate: PlateNumbers = part_numbers(LIFT_DRAG, robot.fluid, robot.world)
            yield _damping(robot, part, [0, 0, 0, *plate.angular[part.row]])
        if part.part.thruster is not None:
            yield _thruster(robot, part)
    if link.joint is not None:
        yield _plugin(
            "joint-position-controller",
            joint_name=link.joint.name,
            p_gain=link.joint.stiffness,
            i_gain=0,
            d_gain=0,
            cmd_max=link.joint.limit["effort"],
            cmd_min=-link.joint.limit["effort"],
        )


def _face_drag(robot: Robot, part: PlacedPart) -> Element:
    """Drag of the faces."""
    numbers: FaceNumbers = part_numbers(FACES, robot.fluid, robot.world)
    return _damping(robot, part, [*numbers.linear[part.row], *numbers.angular[part.row]])


def _stated_drag(robot: Robot, part: PlacedPart) -> Element:
    """Damping that a module states itself."""
    numbers = part_numbers(FOSSEN, robot.fluid, robot.world)
    n = jax.tree.map(lambda x: np.asarray(x)[part.row], numbers)
    linear = np.block([[n.linear, n.cross.T], [n.cross, n.angular]])
    return _damping(robot, part, [*n.quadratic, *n.angular_quadratic], linear)


def _damping(
    robot: Robot, part: PlacedPart, quadratic: Iterable[float], linear: np.ndarray | None = None
) -> Element:
    """Gazebo's Hydrodynamics; it takes damping as negative, after Fossen."""
    tags = {f"{row}{axis}abs{axis}": x for row, axis, x in zip(*_FORCES, quadratic, strict=True)}
    if linear is not None:
        rows, axes = _FORCES
        tags |= {rows[i] + axes[j]: linear[i, j] for i, j in np.argwhere(linear)}
    return _plugin(
        "hydrodynamics",
        link_name=part.name,
        water_density=robot.world.density,
        default_current=robot.world.current,
        **{tag: -float(x) for tag, x in tags.items()},
    )


def _lift_drag(robot: Robot, part: PlacedPart) -> Element:
    numbers: PlateNumbers = part_numbers(LIFT_DRAG, robot.fluid, robot.world)
    plate = jax.tree.map(lambda x: x[part.row], numbers)
    names = ("a0", "cla", "cda", "cma", "alpha_stall", "cla_stall", "cda_stall", "cma_stall")
    return _plugin(
        "lift-drag",
        link_name=part.name,
        air_density=float(plate.density),
        area=plate.area,
        forward=plate.forward,
        upward=plate.upward,
        cp=plate.center,
        radial_symmetry=bool(plate.radial_symmetry),
        reversible=True,
        **{name: getattr(plate, name) for name in names},
    )


# Gazebo's plugins by the law that they have, as `DragLaw.sdf` names it.
PLUGINS = {"faces": _face_drag, "lift_drag": _lift_drag, "fossen": _stated_drag}


def _thruster(robot: Robot, part: PlacedPart) -> Element:
    thruster = part.part.thruster
    assert thruster is not None
    low, high = thrust(thruster, np.array(thruster.range))
    # Gazebo's formula has radians where K_T has turns; its sign is the propeller's hand.
    coefficient = _THRUST_COEFFICIENT / (2 * np.pi) ** 2
    return _plugin(
        "thruster",
        joint_name=f"{part.name}_propeller_joint",
        fluid_density=robot.world.density,
        propeller_diameter=propeller(part.part)[1],
        thrust_coefficient=-coefficient if thruster.torque_ratio < 0 else coefficient,
        velocity_control=True,
        max_thrust_cmd=float(high),
        min_thrust_cmd=float(low),
    )


# ------------------------------------------------------------------------- words


def _water(robot: Robot) -> list[tuple[object, str]]:
    """Parts of Gazebo's water: for each, whether it is used, and a description."""
    world, table = robot.world, robot.fluid
    lift, drag, _ = words_on_laws(robot, lambda law: law.sdf)
    return [
        *((_floats(robot), note) for note in lift),
        (
            table.carried_mass.any(),
            "fluid_added_mass carries the added mass, and the water inside, of each part",
        ),
        *((True, note) for note in drag),
        (any(world.current), "the drag includes the current"),
        (robot.num_thrusters, "Thruster pushes at propellers, which are links of their own"),
    ]


def _missing(robot: Robot, links: tuple[Link, ...]) -> list[tuple[object, str]]:
    """Properties that Gazebo lacks: for each, whether robot or world has it, and a description."""
    bed = near_bed(robot)
    return [
        (
            robot.edited_model is not None,
            "masses and inertias of the edited model: links have those of the modules",
        ),
        (True, "tilt at the surface: Gazebo cuts boxes as if they stood level"),
        (True, "the share of drag and added mass that is lost above the surface"),
        (
            _floats(robot),
            "contact at the modules' true corners: the collision boxes are those of the buoyancy",
        ),
        (
            any(p.part.contact and not _is_solid(robot, p) for link in links for p in link.parts),
            "contact of parts that the water does not lift",
        ),
        (
            robot.num_hinges,
            "the fall of a servo's torque towards its top speed: its limit is sharp here",
        ),
        *((True, text) for text in words_on_laws(robot, lambda law: law.sdf)[2]),
        (
            robot.num_thrusters,
            "the thrusters' curves, lag and reaction torque, and that they lose thrust out of the "
            "water: the command is the thrust itself",
        ),
        *missing_flow(robot.world),
        (robot.world.bed is not None and (bed is None or bed.kind != "flat"), "the bed"),
    ]
