"""A robot as URDF, for ROS and everything that reads its robots.

Source: the ROS wiki's "urdf/XML". Frames are MuJoCo's: a link's origin is its hinge, all joint
angles are 0 at rest. The water has no place in URDF; `sdf.py` takes it to Gazebo.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.formats.links import (
    Link,
    PlacedPart,
    inertia_entries,
    make_links,
    plain,
    roll_pitch_yaw,
)
from mjx_revolve.formats.xml_text import node, to_document

_NOTE = """
  {title}: {links} links, {joints} hinges, {mass:.6g} kg. SI units; angles are 0 at rest.
  Link names are those of the transforms in the rollout's bag, joint names those of its joint
  states. URDF has no water: buoyancy, drag, added mass and thrusters are left out, and the
  weight is that in air.
"""


def make_urdf(robot: Robot, meshes: str | None = "meshes/") -> str:
    """The robot as URDF.

    Args:
        robot: from `build_robot`.
        meshes: what the names of mesh files begin with (`package://my_robot/meshes/`); None draws
            the modules' boxes instead, which needs no files.

    Returns:
        The XML text.
    """
    links = make_links(robot)
    colors = sorted({part.rgb for link in links for part in link.parts})
    root = node(
        "robot",
        # Without these MuJoCo's importer drops folders of meshes, what is only seen, and the base.
        node("mujoco", node("compiler", strippath=False, discardvisual=False, fusestatic=False)),
        *(node("material", node("color", rgba=[*rgb, 1]), name=_material(rgb)) for rgb in colors),
        *(_link(link, meshes) for link in links),
        *(_joint(link, links[link.parent]) for link in links[1:]),
        name=plain(robot.morphology.name),
    )
    note = _NOTE.format(
        title=robot.morphology.name,
        links=len(links),
        joints=len(links) - 1,
        mass=sum(link.mass for link in links),
    )
    return to_document(root, note)


def _material(rgb: tuple[float, float, float]) -> str:
    return "rgb_" + "_".join(f"{x:.6g}" for x in rgb)


def _origin(position: np.ndarray, rotation: np.ndarray) -> Element:
    return node("origin", xyz=position, rpy=roll_pitch_yaw(rotation))


def _link(link: Link, meshes: str | None) -> Element:
    inertial = node(
        "inertial",
        _origin(link.center_of_mass, np.eye(3)),
        node("mass", value=link.mass),
        node("inertia", **inertia_entries(link.inertia)),
    )
    seen, solid = [], []
    for part in link.parts:
        material = node("material", name=_material(part.rgb))
        if meshes is None:
            seen += _boxes("visual", part, part.name, material)
        else:
            mesh = node("geometry", node("mesh", filename=f"{meshes}{part.mesh}.stl"))
            origin = _origin(part.position, part.rotation)
            seen.append(node("visual", origin, mesh, material, name=part.name))
        if part.part.contact:
            solid += _boxes("collision", part, f"{part.name}_collision")
    return node("link", inertial, *seen, *solid, name=link.name)


def _boxes(kind: str, part: PlacedPart, name: str, *more: Element) -> list[Element]:
    """An element for each box of a part."""
    return [
        node(
            kind,
            _origin(part.position + part.rotation @ np.asarray(box.position), part.rotation),
            node("geometry", node("box", size=box.size)),
            *more,
            name=f"{name}_{k}" if k else name,
        )
        for k, box in enumerate(part.part.boxes)
    ]


def _joint(link: Link, parent: Link) -> Element:
    joint = link.joint
    assert joint is not None
    return node(
        "joint",
        _origin(link.position, link.rotation),
        node("parent", link=parent.name),
        node("child", link=link.name),
        node("axis", xyz=joint.axis),
        node("limit", **joint.limit),
        node("dynamics", damping=joint.damping, friction=0),
        name=joint.name,
        type="revolute",
    )
