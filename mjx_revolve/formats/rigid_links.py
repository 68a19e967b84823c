"""Rigid links of robots, read from URDF or from MuJoCo's MJCF.

The result is the same for both: links that hinges move, each with its shapes as boxes. Links that
are fixed to another one are merged into it. Unsupported properties are named in
`RigidRobot.missing`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import mujoco
import numpy as np
import trimesh

from mjx_revolve.formats.inertias import spread
from mjx_revolve.inputs.errors import InputError, reading
from mjx_revolve.inputs.xml_reader import load_robot_xml
from mjx_revolve.numerics.spatial import quat_to_matrix

Place = tuple[np.ndarray, np.ndarray]  # position [3] [m] and rotation [3, 3]
Color = tuple[float, ...]
_Hinge = tuple[np.ndarray, np.ndarray, dict[str, Any]]  # axis, anchor [m] and limits


@dataclass(frozen=True)
class Shape:
    """A shape as the box around it.

    Attributes:
        size: `[3]` edges of the box [m].
        position: `[3]` its centre, link frame [m].
        rotation: `[3, 3]` link from box.
        volume: of the shape itself [m³].
        center: `[3]` of that volume, link frame [m].
        rgb: colour from 0 to 1, or None.
    """

    size: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    volume: float
    center: np.ndarray
    rgb: Color | None = None


@dataclass
class RigidLink:
    """A link, all that is fixed to it included. Its frame is at rest that of all angles 0.

    Attributes:
        name: of its hinge; of the root, its own.
        parent: index among the links; -1 for the root.
        position: `[3]` of its frame, parent's frame [m].
        rotation: `[3, 3]` parent from link.
        axis: `[3]` of its hinge, link frame.
        anchor: `[3]` a point on it, link frame [m].
        limits: `range` [rad], `effort` [N·m] and `speed` [rad/s] of the hinge, where given.
        inertia: `[4, 4]` pseudo-inertia (see `inertias`), link frame.
        solid: shapes that collide.
        seen: visible shapes.
        both: those in `solid` that are all there is to see: of MJCF, what MuJoCo's viewer shows as
            well; of URDF, of links without visible shapes.
    """

    name: str
    parent: int
    position: np.ndarray
    rotation: np.ndarray
    axis: np.ndarray
    anchor: np.ndarray
    limits: dict[str, Any]
    inertia: np.ndarray = field(default_factory=lambda: np.zeros((4, 4)))
    solid: list[Shape] = field(default_factory=list)
    seen: list[Shape] = field(default_factory=list)
    both: list[Shape] = field(default_factory=list)


@dataclass
class RigidRobot:
    """A robot of rigid links.

    Attributes:
        name: of the robot.
        links: each after its parent.
        missing: properties that were not imported, in words.
    """

    name: str
    links: list[RigidLink] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)

    def _add(self, parent: int, place: Place, name: str, hinge: _Hinge | None) -> tuple[int, Place]:
        """A link's number, and its place in that one's frame; without a hinge, its parent's."""
        if parent >= 0 and hinge is None:
            return parent, place
        axis, anchor, limits = hinge or (np.array([0.0, 0.0, 1.0]), np.zeros(3), {})
        here = np.zeros(3), np.eye(3)
        position, rotation = place if parent >= 0 else here
        self.links.append(RigidLink(name, parent, position, rotation, axis, anchor, limits))
        return len(self.links) - 1, here


def read_rigid_robot(path: str | Path) -> RigidRobot:
    """Reads a robot of rigid links.

    Args:
        path: of a URDF or an MJCF file.

    Returns:
        The robot.

    Raises:
        InputError: the file cannot be read, or holds no such robot; the message says where.
    """
    root = load_robot_xml(path)
    with reading(path):
        read = _read_urdf if root.tag == "robot" else _read_mjcf
        robot = read(root, Path(path))
        if robot.links[0].inertia[3, 3] <= 0:
            raise InputError(robot.links[0].name, "a root with a mass", "none")
        for link in robot.links:
            # Shapes that do not collide stand for those that do, or are an eye on a hull. A choice:
            # those of less than half of its volume.
            seen, both = (sum(s.volume for s in shapes) for shapes in (link.seen, link.both))
            if link.seen and seen < both / 2:
                link.seen[:0] = link.both
        return robot


def box_around(kind: str, size: np.ndarray) -> tuple[np.ndarray, float]:
    """`[3]` edges of the box around a shape [m], and the shape's volume [m³].

    Args:
        kind: box, sphere, ellipsoid, cylinder or capsule; the last two along z.
        size: as MJCF has it: half edges, or a radius and half a length.
    """
    x, y, z = (*size, 0.0, 0.0)[:3]
    if kind == "box":
        return 2 * np.array([x, y, z]), 8 * x * y * z
    if kind == "sphere":
        return np.full(3, 2 * x), 4 / 3 * np.pi * x**3
    if kind == "ellipsoid":
        return 2 * np.array([x, y, z]), 4 / 3 * np.pi * x * y * z
    ends = x if kind == "capsule" else 0.0
    return 2 * np.array([x, x, y + ends]), np.pi * x**2 * (2 * y + 4 / 3 * ends)


def closed_volume(triangles: np.ndarray) -> tuple[float, np.ndarray] | None:
    """Volume [m³] and `[3]` centre of closed surfaces; None if `[n, 3, 3]` triangles leave holes.

    The areas of a closed surface, as vectors, add up to 0.
    """
    a, b, c = np.moveaxis(triangles - triangles.mean((0, 1)), 1, 0)
    area, six = np.cross(b - a, c - a), np.einsum("ni,ni->n", a, np.cross(b, c))
    if np.linalg.norm(area.sum(0)) > 1e-5 * np.linalg.norm(area, axis=1).sum() or six.sum() <= 0:
        return None
    center = ((a + b + c) * six[:, None]).sum(0) / six.sum() / 4
    return six.sum() / 6, center + triangles.mean((0, 1))


def _mesh(
    triangles: np.ndarray, place: Place, rgb: Color | None, name: str, missing: list[str]
) -> Shape:
    """The shape of a mesh, with triangles in the mesh's own frame."""
    position, rotation = place
    low, high = triangles.min((0, 1)), triangles.max((0, 1))
    size, middle = np.maximum(high - low, 1e-4), (low + high) / 2
    found = closed_volume(triangles) or closed_volume(triangles[:, ::-1])  # or inside out
    if found is None:
        missing.append(f"{name}: a mesh with holes; the box around it stands for its volume")
    volume, center = found or (float(np.prod(size)), middle)
    there = position + rotation @ middle
    return Shape(size, there, rotation, volume, position + rotation @ center, rgb)


# ------------------------------------------------------------------------------------------- URDF


def _numbers(element: Element | None, name: str, count: int, default: str | None) -> np.ndarray:
    """An attribute's numbers."""
    text = (element.get(name, default) if element is not None else default) or ""
    try:
        found = np.array([float(x) for x in text.split()])
    except ValueError:
        found = np.zeros(0)
    if found.shape != (count,) or not np.isfinite(found).all():
        tag = "none" if element is None else element.tag
        raise InputError(f"<{tag}> {name}", f"{count} numbers", repr(text or "none"))
    return found


def _origin(element: Element) -> Place:
    """Position and rotation of an element's `<origin>`: about fixed x, then y, then z."""
    origin = element.find("origin")
    roll, pitch, yaw = _numbers(origin, "rpy", 3, "0 0 0")
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(x), np.sin(x)) for x in (roll, pitch, yaw))
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return _numbers(origin, "xyz", 3, "0 0 0"), z @ y @ x


def _then(first: Place, second: Place) -> Place:
    """A place in the frame of another place."""
    return first[0] + first[1] @ second[0], first[1] @ second[1]


def _read_urdf(root: Element, path: Path) -> RigidRobot:
    robot = RigidRobot(root.get("name") or path.stem)
    links = {link.get("name", ""): link for link in root.findall("link")}
    for name, count in Counter(link.get("name", "") for link in root.findall("link")).items():
        if count > 1:
            raise InputError(f"link {name}", "each name once", f"{count} of it")
    below: dict[str, list[Element]] = {}
    children = set()
    for joint in root.findall("joint"):
        ends = [joint.find(tag) for tag in ("parent", "child")]
        names = [end.get("link", "") if end is not None else "" for end in ends]
        for name in names:
            if name not in links:
                where = f"joint {joint.get('name')}"
                raise InputError(where, "a link of the file", repr(name))
        below.setdefault(names[0], []).append(joint)
        if names[1] in children:
            raise InputError(f"link {names[1]}", "one parent", "two")
        children.add(names[1])
    tops = [name for name in links if name not in children]
    if len(tops) != 1:
        raise InputError(f"expected one root link; found {', '.join(tops) or 'none'}")
    colors = {one.get("name", ""): one.find("color") for one in root.findall("material")}
    top, place, reached = tops[0], (np.zeros(3), np.eye(3)), set()
    # A world that holds the robot alone is no part of it, nor is where the robot stands in it.
    while not len(links[top]) and len(below.get(top, [])) == 1:
        kind, child = below[top][0].get("type"), below[top][0].find("child")
        assert child is not None
        if kind != "floating" and (kind, top) != ("fixed", "world"):
            break
        reached.add(top)
        top = child.get("link", "")
    stack: list[tuple[str, int, Any, str, Any]] = [(top, -1, place, top, None)]
    while stack:
        name, parent, place, own, hinge = stack.pop()
        reached.add(name)
        number, place = robot._add(parent, place, own, hinge)
        link = robot.links[number]
        inertial = links[name].find("inertial")
        if inertial is not None:
            link.inertia += _inertial(inertial, place)
        solid = len(link.solid)
        for tag, shapes in (("collision", link.solid), ("visual", link.seen)):
            for element in links[name].findall(tag):
                shapes += _shape(element, name, place, path, colors, robot.missing)
        if links[name].find("visual") is None:
            link.both += link.solid[solid:]
        for joint in reversed(below.get(name, [])):
            child = joint.find("child")
            assert child is not None
            there = _then(place, _origin(joint))
            made = _urdf_hinge(joint, robot.missing)
            label = joint.get("name", "")
            stack.append((child.get("link", ""), number, there, label, made))
    if apart := [name for name in links if name not in reached]:
        raise InputError(f"expected one tree of links; found {apart[0]} in a loop")
    for tag in ("transmission", "gazebo", "sensor"):
        if count := len(root.findall(tag)):
            robot.missing.append(f"{count} × <{tag}>")
    return robot


def _inertial(element: Element, place: Place) -> np.ndarray:
    position, rotation = _then(place, _origin(element))
    mass = _numbers(element.find("mass"), "value", 1, None)[0]
    if mass < 0:
        raise InputError("<mass> value", "a number >= 0", f"{mass:g}")
    entries = element.find("inertia")
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    x, y, z, xy, xz, yz = (_numbers(entries, name, 1, "0")[0] for name in names)
    return _spread(mass, position, rotation, np.array([[x, xy, xz], [xy, y, yz], [xz, yz, z]]))


def _spread(
    mass: float, center: np.ndarray, rotation: np.ndarray, inertia: np.ndarray
) -> np.ndarray:
    """The pseudo-inertia of an inertia about its centre of mass, in turned axes."""
    if mass <= 0:
        return np.zeros((4, 4))
    turned = rotation @ inertia @ rotation.T
    return spread(mass, center, (np.trace(turned) / 2 * np.eye(3) - turned) / mass)


def _shape(
    element: Element,
    link: str,
    place: Place,
    path: Path,
    colors: dict[str, Any],
    missing: list[str],
) -> Iterator[Shape]:
    """The shape of a `<collision>` or a `<visual>`; none if it cannot be taken over."""
    geometry = element.find("geometry")
    kind = geometry[0] if geometry is not None and len(geometry) else None
    place = _then(place, _origin(element))
    material = element.find("material")
    color = None
    if material is not None:
        color = material.find("color")
        color = colors.get(material.get("name", "")) if color is None else color
    rgb = None if color is None else tuple(_numbers(color, "rgba", 4, None)[:3])
    if kind is not None and kind.tag == "mesh":
        mesh = _load_mesh(kind.get("filename", ""), path)
        if mesh is None:
            missing.append(f"{link}: the mesh {kind.get('filename')}, which cannot be read")
            return
        scale = _numbers(kind, "scale", 3, "1 1 1")
        triangles = mesh * scale
        if scale.prod() < 0:  # a mirror turns triangles inside out
            triangles = triangles[:, ::-1]
        yield _mesh(triangles, place, rgb, link, missing)
        return
    if kind is None or kind.tag not in ("box", "sphere", "cylinder", "capsule"):
        missing.append(f"{link}: a shape that is no box, sphere, cylinder, capsule or mesh")
        return
    if kind.tag == "box":
        size, halves = _numbers(kind, "size", 3, None), [2, 2, 2]
    else:
        size, halves = _numbers(kind, "radius", 1, None), [1]
        if kind.tag != "sphere":
            size, halves = np.append(size, _numbers(kind, "length", 1, None)), [1, 2]
    if (size <= 0).any():
        raise InputError(f"link {link}", f"sizes > 0 of a {kind.tag}", size.tolist())
    yield _box(kind.tag, size / halves, place, rgb)


def _box(kind: str, size: np.ndarray, place: Place, rgb: Color | None) -> Shape:
    edges, volume = box_around(kind, size)
    return Shape(edges, place[0], place[1], volume, place[0], rgb)


def _load_mesh(name: str, path: Path) -> np.ndarray | None:
    """`[n, 3, 3]` triangles of a mesh file; `package://` is sought in the folders above."""
    _, scheme, rest = name.rpartition("://")
    folders = [path.absolute().parent, *path.absolute().parents] if scheme else [path.parent]
    tails = [Path(rest), Path(*Path(rest).parts[1:])] if scheme else [Path(rest)]
    found = (folder / tail for folder in folders for tail in tails)
    file = next((one for one in found if one.is_file()), None)
    try:
        mesh = None if file is None else trimesh.load_mesh(file)
        triangles = np.zeros(0) if mesh is None else np.asarray(mesh.triangles)
        if name.lower().endswith(".dae") and mesh is not None and mesh.units:  # "0.001 * meters"
            triangles = triangles * trimesh.units.unit_conversion(mesh.units, "meters")
    except OSError:
        raise
    except Exception:  # its readers raise anything
        return None
    return triangles if triangles.size and np.isfinite(triangles).all() else None


def _urdf_hinge(joint: Element, missing: list[str]) -> _Hinge | None:
    """Axis, anchor and limits of a joint; None if it is rigid here."""
    name, kind = joint.get("name", ""), joint.get("type")
    if kind not in ("revolute", "continuous"):
        if kind != "fixed":
            missing.append(f"{name}: a {kind} joint, which is rigid here")
        return None
    if joint.find("mimic") is not None:
        missing.append(f"{name}: it mimics another joint; here it is free")
    dynamics = joint.find("dynamics")
    if any(_numbers(dynamics, given, 1, "0")[0] for given in ("damping", "friction")):
        missing.append(f"{name}: damping and friction; here those of our servos")
    limit = joint.find("limit")
    limits: dict[str, Any] = {}
    for ours, theirs in (("effort", "effort"), ("speed", "velocity")):
        value = _numbers(limit, theirs, 1, "0")[0]
        if value < 0:
            raise InputError(f"{name}: <limit> {theirs}", "a number >= 0", f"{value:g}")
        if value > 0:
            limits[ours] = value
    if kind == "revolute":
        limits["range"] = [_numbers(limit, end, 1, "0")[0] for end in ("lower", "upper")]
    return _numbers(joint.find("axis"), "xyz", 3, "1 0 0"), np.zeros(3), limits


# ------------------------------------------------------------------------------------------- MJCF

_GEOM, _JOINT = mujoco.mjtGeom, mujoco.mjtJoint
# Gain and bias of an actuator with a force of its command times the gain.
_MOTOR = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE
_MOVES_JOINTS = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_KINDS = {
    _GEOM.mjGEOM_BOX: "box", _GEOM.mjGEOM_SPHERE: "sphere", _GEOM.mjGEOM_ELLIPSOID: "ellipsoid",
    _GEOM.mjGEOM_CYLINDER: "cylinder", _GEOM.mjGEOM_CAPSULE: "capsule",
}  # fmt: skip
_GREY = 0.5, 0.5, 0.5, 1.0  # MuJoCo's default
_COLLIDES = 3
"""The first group of geoms that MuJoCo's viewer hides: those that carry mass and contact."""


def _read_mjcf(root: Element, path: Path) -> RigidRobot:
    """The largest robot of a model, by mass."""
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise InputError(f"expected MJCF that MuJoCo reads; found: {error}") from None
    tops = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    if not tops:
        raise InputError("expected a body; found none")
    moving = {int(model.body_rootid[body]) for body in np.flatnonzero(model.body_dofnum)}
    top = max(tops, key=lambda body: (body in moving, model.body_subtreemass[body]))
    robot = RigidRobot(root.get("model") or path.stem)
    missing = robot.missing
    missing += [f"the body {model.body(body).name}, another robot" for body in tops if body != top]
    numbers: dict[int, int] = {0: -1}
    places: dict[int, Place] = {0: (np.zeros(3), np.eye(3))}
    for body in range(top, model.nbody):
        parent = int(model.body_parentid[body])
        if model.body_rootid[body] != top:
            continue
        there = model.body_pos[body], quat_to_matrix(model.body_quat[body])
        hinge, joint = _mjcf_hinge(model, body, missing) if body != top else (None, "")
        if (
            body == top
            and model.body_jntnum[top]
            and model.jnt_type[model.body_jntadr[top]] != _JOINT.mjJNT_FREE
        ):
            first = model.joint(int(model.body_jntadr[top])).name or robot.name
            missing.append(f"{first}: the joint of the first body, which is free here")
        own = joint or model.body(body).name or robot.name
        numbers[body], places[body] = robot._add(
            numbers[parent], _then(places[parent], there), own, hinge
        )
        link, place = robot.links[numbers[body]], places[body]
        center, axes = _then(place, (model.body_ipos[body], quat_to_matrix(model.body_iquat[body])))
        moments = np.diag(model.body_inertia[body])
        link.inertia += _spread(float(model.body_mass[body]), center, axes, moments)
        for geom in np.flatnonzero(model.geom_bodyid == body):
            _mjcf_shape(model, int(geom), place, link, missing)
    turns = np.isin(model.actuator_trntype, list(_MOVES_JOINTS))
    for count, words in (
        ((model.geom_bodyid == 0).sum(), "geoms of the world"), (model.neq, "equality constraints"),
        (model.ntendon, "tendons"), (model.nsensor, "sensors"),
        (model.dof_frictionloss.any(), "friction of joints"),
        (model.dof_damping.any(), "damping of joints"), (model.dof_armature.any(), "armatures"),
        (model.jnt_stiffness.any(), "springs of joints"),
        ((~turns).sum(), "actuators that move no joint, such as thrusters"),
        (model.body_gravcomp.any(), "weights taken off bodies (gravcomp)"),
        (np.bool_(model.opt.density or model.opt.viscosity), "MuJoCo's fluid"),
    ):  # fmt: skip
        if count:
            missing.append(words if isinstance(count, np.bool_) else f"{count:g} × {words}")
    return robot


def _mjcf_hinge(model: mujoco.MjModel, body: int, missing: list[str]) -> tuple[_Hinge | None, str]:
    """Axis, anchor and limits of a body's first hinge and its name; None without one."""
    first = int(model.body_jntadr[body])
    joints = range(first, first + int(model.body_jntnum[body]))
    hinges = [j for j in joints if model.jnt_type[j] == _JOINT.mjJNT_HINGE]
    for j in joints:
        if j not in hinges[:1]:
            missing.append(f"{model.joint(j).name or model.body(body).name}: a joint that is rigid "
                           "here, as a link has one hinge")  # fmt: skip
    if not hinges:
        return None, ""
    j = hinges[0]
    limits: dict[str, Any] = {}
    if model.jnt_limited[j]:
        limits["range"] = (model.jnt_range[j] - model.qpos0[model.jnt_qposadr[j]]).tolist()
    efforts = []
    for k in np.flatnonzero(np.isin(model.actuator_trntype, list(_MOVES_JOINTS))):
        if model.actuator_trnid[k, 0] != j:
            continue
        gear, most = abs(model.actuator_gear[k, 0]), math.inf
        if model.actuator_forcelimited[k]:
            most = np.abs(model.actuator_forcerange[k]).max() * gear
        kind = model.actuator_gaintype[k], model.actuator_biastype[k]
        if model.actuator_ctrllimited[k] and kind == _MOTOR:
            gain = abs(model.actuator_gainprm[k, 0])
            most = min(most, np.abs(model.actuator_ctrlrange[k]).max() * gain * gear)
        efforts.append(most)
    # Actuators of one joint add up.
    effort = sum(efforts) if efforts else math.inf
    if model.jnt_actfrclimited[j]:
        effort = min(effort, np.abs(model.jnt_actfrcrange[j]).max())
    if 0 < effort < math.inf:
        limits["effort"] = float(effort)
    return (model.jnt_axis[j].copy(), model.jnt_pos[j].copy(), limits), model.joint(j).name


def _mjcf_shape(
    model: mujoco.MjModel, geom: int, place: Place, link: RigidLink, missing: list[str]
) -> None:
    """Adds a geom to its link."""
    kind = _GEOM(model.geom_type[geom])
    there = _then(place, (model.geom_pos[geom], quat_to_matrix(model.geom_quat[geom])))
    rgba, material = model.geom_rgba[geom], model.geom_matid[geom]
    if material >= 0 and np.allclose(rgba, _GREY):  # a geom without a colour of its own
        rgba = model.mat_rgba[material]
    rgb = tuple(rgba[:3].astype(float))
    collides = model.geom_contype[geom] or model.geom_conaffinity[geom]
    shapes = link.solid if collides or model.geom_group[geom] >= _COLLIDES else link.seen
    if kind == _GEOM.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        start, points = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        corners = model.mesh_vert[start : start + points].astype(np.float64)
        triangles = corners[model.mesh_face[first : first + count]]
        shape = _mesh(triangles, there, rgb, link.name, missing)
    elif kind in _KINDS:
        shape = _box(_KINDS[kind], model.geom_size[geom], there, rgb)
    else:
        missing.append(f"{link.name}: a geom that is no box, sphere, cylinder, capsule or mesh")
        return
    shapes.append(shape)
    if collides and model.geom_group[geom] < _COLLIDES:
        link.both.append(shape)
