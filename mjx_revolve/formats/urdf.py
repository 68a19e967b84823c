"""A robot as URDF, for ROS and everything that reads its robots.

Source: the ROS wiki's "urdf/XML". Frames are MuJoCo's: a link's origin is its hinge, all joint
angles are 0 at rest. The water has no place in URDF; `sdf.py` takes it to Gazebo.
"""

from __future__ import annotations

from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.formats.links import (
    Link,
    Shape,
    exact,
    make_links,
    numbers,
    plain,
    roll_pitch_yaw,
    to_text,
)

_NOTE = """
  {title}: {links} links, {joints} hinges, {mass:.6g} kg. SI units; angles are 0 at rest.
  Link names are those of the transforms in the rollout's bag, joint names those of its joint
  states. URDF knows no water: buoyancy, drag, added mass and thrusters are left out, and the
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
    root = Element("robot", name=plain(robot.morphology.name))
    # Without these MuJoCo's importer drops folders of meshes, what is only seen, and the base.
    compiler = {"strippath": "false", "discardvisual": "false", "fusestatic": "false"}
    SubElement(SubElement(root, "mujoco"), "compiler", compiler)
    for rgb in sorted({shape.rgb for link in links for shape in link.shapes}):
        material = SubElement(root, "material", name=_material(rgb))
        SubElement(material, "color", rgba=numbers([*rgb, 1.0]))
    for link in links:
        _add_link(root, link, meshes)
    for link in links[1:]:
        _add_joint(root, link, links[link.parent])
    note = _NOTE.format(
        title=robot.morphology.name,
        links=len(links),
        joints=len(links) - 1,
        mass=sum(link.mass for link in links),
    )
    return to_text(root, note)


def _material(rgb: tuple[float, float, float]) -> str:
    return "rgb_" + "_".join(f"{x:.6g}" for x in rgb)


def _origin(parent: Element, position: Any, rotation: np.ndarray) -> None:
    xyz, rpy = numbers(position), numbers(roll_pitch_yaw(rotation))
    SubElement(parent, "origin", xyz=xyz, rpy=rpy)


def _add_link(root: Element, link: Link, meshes: str | None) -> None:
    element = SubElement(root, "link", name=link.name)
    inertial = SubElement(element, "inertial")
    _origin(inertial, link.center_of_mass, np.eye(3))
    SubElement(inertial, "mass", value=exact(link.mass))
    entries = {
        "i" + "xyz"[i] + "xyz"[j]: exact(link.inertia[i, j]) for i in range(3) for j in range(i, 3)
    }
    SubElement(inertial, "inertia", entries)
    for shape in link.shapes:
        if meshes is None:
            _add_boxes(element, "visual", shape)
        else:
            visual = SubElement(element, "visual", name=shape.name)
            _origin(visual, shape.position, shape.rotation)
            geometry = SubElement(visual, "geometry")
            SubElement(geometry, "mesh", filename=f"{meshes}{shape.mesh}.stl")
            SubElement(visual, "material", name=_material(shape.rgb))
    for shape in link.shapes:
        if shape.part.contact:
            _add_boxes(element, "collision", shape)


def _add_boxes(element: Element, kind: str, shape: Shape) -> None:
    for k, box in enumerate(shape.part.boxes):
        name = shape.name if kind == "visual" else f"{shape.name}_{kind}"
        name = f"{name}_{k}" if k else name
        child = SubElement(element, kind, name=name)
        position = shape.position + shape.rotation @ np.asarray(box.position)
        _origin(child, position, shape.rotation)
        SubElement(SubElement(child, "geometry"), "box", size=numbers(box.size))
        if kind == "visual":
            SubElement(child, "material", name=_material(shape.rgb))


def _add_joint(root: Element, link: Link, parent: Link) -> None:
    joint = link.joint
    assert joint is not None
    element = SubElement(root, "joint", name=joint.name, type="revolute")
    _origin(element, link.position, link.rotation)
    SubElement(element, "parent", link=parent.name)
    SubElement(element, "child", link=link.name)
    SubElement(element, "axis", xyz=numbers(joint.axis))
    low, high = joint.range
    SubElement(
        element,
        "limit",
        lower=exact(low),
        upper=exact(high),
        effort=exact(joint.effort),
        velocity=exact(joint.speed),
    )
    SubElement(element, "dynamics", damping=exact(joint.damping), friction="0")
