"""How to build a robot: one page with parts, ballast, assembly in pictures, joints and STL files.

It lists the properties that the simulation has of the robot, and those that it lacks.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from mjx_revolve import __version__
from mjx_revolve.body.module_types import ModuleType, Part
from mjx_revolve.body.morphology import Morphology
from mjx_revolve.body.placement import Module
from mjx_revolve.engine.plant import read_actuators
from mjx_revolve.engine.robot import Robot
from mjx_revolve.formats.links import make_links, make_meshes
from mjx_revolve.inputs.templates import data_address, make_templates
from mjx_revolve.view.palette import ACCENT
from mjx_revolve.view.pieces import Scene, make_pieces, rest_scene
from mjx_revolve.view.raster import draw_scene, make_view, on_white

# Width and height of a picture [pixels], and what stays free at its edges.
_SIZE, _MARGIN = np.array([420, 315]), 10
# Viewers stand on the side of the new module: of the core's -y, or of its +y; degrees, choices.
_BACK, _FRONT, _ABOVE = -58.0, 122.0, 30.0
# Share of white in the colour of modules already in place, of orange in the new one's; choices.
_PALE, _NEW = 0.72, 0.75
# Masses or volumes that differ by less than this share are the same; a choice, a scale's error.
_SAME = 1e-3
# Stainless steel, of ballast [kg/m³].
_STEEL = 7900.0
# Below this distance centres of mass and volume are one [m]: a choice, what a builder can set.
_ONE_POINT = 5e-4
_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Balance:
    """Weight and lift of a robot in its world's water.

    Attributes:
        mass: [g].
        displaced: volume of what it displaces, sealed volume and floats included [cm³].
        sealed: the part of it that is not of the parts' material [cm³].
        density: of the water [kg/m³]; 0 where nothing lifts.
        missing: volume that it would have to displace more to be neutral [cm³].
        mass_center: at rest, core frame [mm].
        lift_center: of what is displaced [mm].
    """

    mass: float
    displaced: float
    sealed: float
    density: float
    missing: float
    mass_center: np.ndarray
    lift_center: np.ndarray


def make_build_page(robot: Robot, title: str = "") -> str:
    """Makes the page.

    Args:
        robot: from `build_robot`.
        title: words below the heading.

    Returns:
        A complete HTML document that needs no other file; the same robot, the same page.
    """
    body, balance = robot.morphology, weigh(robot)
    here = Path(__file__).parent
    templates = make_templates(here, here / "report")
    return templates.get_template("build_page.html").render(
        name=body.name,
        title=title,
        kinds=list_parts(body),
        describe=_describe,
        degrees=math.degrees,
        amount=_amount,
        balance=balance,
        words=ballast_words(balance),
        centers=[_numbers(x.round(1), 4) for x in (balance.mass_center, balance.lift_center)],
        size=[f"{1000 * x:.0f}" for x in body.extent],
        steps=_steps(body),
        joints=joint_rows(robot),
        thrusters=_thruster_rows(robot),
        files=_stl_files(body),
        version=__version__,
    )


def list_parts(body: Morphology) -> list[list[Module]]:
    """The modules by type; those with masses or volumes of their own count as types."""
    kinds: list[list[Module]] = []
    for module in body.modules:
        key = module.type, module.kind
        group = next((some for some in kinds if (some[0].type, some[0].kind) == key), None)
        if group is None:
            kinds.append(group := [])
        group.append(module)
    return kinds


def _describe(kind: ModuleType, part: Part) -> str:
    """A description of a part, and of its contents besides the printed shell."""
    words = []
    if part.thruster is not None:
        words.append("thruster, to buy")
    elif part.lift_drag is not None:
        words.append("fin")
    if kind.hinge is not None:
        servo = max(kind.parts[1:], key=lambda one: one.total_mass, default=None)
        moves = "moves; the servo, to buy, is in it" if part is servo else "moves"
        words.append("fixed to the parent" if part is kind.parts[0] else moves)
    # Of material and sealed volume the centre of both is given: the material's is taken to be the
    # box's, unless what is sealed would lie outside of it.
    sealed, joint = "sealed volume", np.asarray(part.center_of_volume)
    alone = joint * (part.volume + part.electronics_volume) / (part.electronics_volume or 1.0)
    if np.any(np.abs(alone) > np.asarray(part.boxes[0].size) / 2):
        sealed, alone = "sealed volume, its centre and the material's together", joint
    for volume, what, center in (
        (part.electronics_volume, sealed, alone),
        (part.ballast_volume, "ballast or float", np.asarray(part.ballast_position)),
    ):
        if volume:
            place = _numbers(1e3 * center, 4)
            words.append(f"{_amount(1e6 * volume)} cm³ of {what} at ({place}) mm")
    if part.ballast_mass:
        place = _numbers(1e3 * np.asarray(part.ballast_position), 4)
        words.append(f"{_amount(1e3 * part.ballast_mass)} g of ballast at ({place}) mm")
    return ", ".join(words)


def weigh(robot: Robot) -> Balance:
    """Mass, displaced volume and their centres, the robot at rest."""
    body, world = robot.morphology, robot.world
    density = 0.0 if world.buoyancy == "off" else world.density
    volume, sealed, lifted = 0.0, 0.0, np.zeros(3)
    for module in body.modules:
        for part in module.kind.parts:
            local = np.add(part.position, part.displaced_center)
            lifted += part.lifted_volume * (module.position + module.rotation @ local)
            volume += part.lifted_volume
            sealed += part.electronics_volume + part.ballast_volume
    return Balance(
        mass=1e3 * body.mass,
        displaced=1e6 * volume,
        sealed=1e6 * sealed,
        density=density,
        missing=1e6 * (body.mass / density - volume) if density else math.nan,
        mass_center=1e3 * body.center_of_mass,
        lift_center=1e3 * lifted / (volume or 1.0),
    )


def ballast_words(balance: Balance) -> list[str]:
    """How to make a robot neutral in its water: ballast or floats and their place, by sentence."""
    if not balance.density:
        return ["Its world has no water, or none that lifts: nothing is said about ballast."]
    water = f"water of {balance.density:.6g} kg/m³"
    found = []
    if balance.sealed:
        found.append(
            f"Provide {_amount(balance.sealed)} cm³ that is sealed or floats (electronics box, "
            "foam), where the list of parts has it, in the part's own axes from its middle. "
            "Hollows that fill with water do not count."
        )
    grams = balance.missing * balance.density / 1e3
    if abs(balance.missing) < _SAME * balance.displaced:
        found.append(f"With masses and volumes as in the list it is neutral in {water}.")
    elif grams > 0:
        found.append(
            f"It sinks in {water}: it needs {_amount(balance.missing)} cm³ of float or sealed "
            f"volume more (or {_amount(grams)} g less). Put it above the centre of mass."
        )
    else:
        steel = -grams / (1 - balance.density / _STEEL)
        found.append(
            f"It floats in {water}: it needs ballast of {_amount(-grams)} g as weighed under "
            f"water, such as {_amount(steel)} g of stainless steel. Put it straight below the "
            "centre of buoyancy."
        )
    apart = balance.lift_center - balance.mass_center
    if np.linalg.norm(apart) < 1e3 * _ONE_POINT:
        found.append(
            "Centres of mass and buoyancy are one point, so it has no attitude of its own: a shift "
            "of either by a millimetre turns it. To keep it level, shift weight down or floats up."
        )
    else:
        found.append(
            f"Left alone it hangs with the core's ({_numbers(apart / np.linalg.norm(apart), 2)}) "
            "up: from the centre of mass to that of buoyancy. Where that is not z, shift weight "
            "or floats until one is above the other, unless the brain was evolved with it."
        )
    found.append(
        "Weigh what you have built: each gram too much wants "
        f"{1e3 / balance.density:.4g} cm³ of float, each gram too little a gram of ballast, as "
        "weighed under water."
    )
    return found


def joint_rows(robot: Robot) -> list[dict[str, object]]:
    """The hinges in the order of the controller's commands, and how they turn."""
    body, rows = robot.morphology, []
    joints = {link.joint.ctrl: link.joint for link in make_links(robot) if link.joint is not None}
    for servo, index in zip(robot.servos, body.hinges, strict=True):
        module, hinge = body.modules[index], body.modules[index].kind.hinge
        assert hinge is not None
        axis = module.rotation @ np.asarray(hinge.axis)
        ends = [slot.position for slot in module.kind.slots.values()]
        ends.append(module.kind.parts[-1].position)
        ways = [np.cross(axis, module.rotation @ np.subtract(x, hinge.anchor)) for x in ends]
        motion = max(ways, key=lambda way: float(np.linalg.norm(way)) > 1e-9)  # the first of them
        toward = _axis_words(motion / max(float(np.linalg.norm(motion)), 1e-12))
        parent = body.modules[module.parent].name
        rows.append(
            {"joint": joints[servo], "parent": parent, "axis": _axis_words(axis), "toward": toward}
        )
    return rows


def _thruster_rows(robot: Robot) -> list[dict[str, object]]:
    """The thrusters, behind the hinges in the order of the controller's commands."""
    low, high, place, axis = (x[robot.num_hinges :] for x in read_actuators([robot.morphology]))
    return [
        {"name": robot.mj_model.actuator(jet).name, "axis": _axis_words(axis[k]), "low": low[k],
         "high": high[k], "place": _numbers(1e3 * place[k], 4)}
        for k, jet in enumerate(robot.thrusters)
    ]  # fmt: skip


def _steps(body: Morphology) -> list[dict[str, str]]:
    """The assembly, module by module, each after its parent."""
    pieces, whole, steps = make_pieces(body), rest_scene(body), []
    owner = np.array([piece.module for piece in pieces])[whole.part]
    marks = np.array([piece.mark for piece in pieces])[whole.part]
    for k, module in enumerate(body.modules):
        there = owner <= k
        new = ((owner == k) & ~marks)[there, None]
        own, old = whole.color[there], (owner < k)[there, None]
        color = np.where(old, own * (1 - _PALE) + _PALE, own)
        color = np.where(new, own * (1 - _NEW) + _NEW * np.array(ACCENT), color)
        scene = Scene(whole.corners[there], color, whole.part[there])
        # What hides a module is most often its parent.
        away = module.position - body.modules[max(module.parent, 0)].position
        front = float(away @ make_view(_FRONT, 0.0)[2]) > 1e-6
        picture = _draw(scene, whole, make_view(_FRONT if front else _BACK, _ABOVE))
        steps.append(
            {"heading": f"{module.type} {module.name}", "words": _step_words(body, module),
             "seen": f"from the core's {'+' if front else '−'}y side", "picture": picture}
        )  # fmt: skip
    return steps


def _step_words(body: Morphology, module: Module) -> str:
    """Where a module goes."""
    if module.parent < 0:
        return "Begin with it. Its x, y, z are those of the robot; pictures show them."
    parent = body.modules[module.parent]
    slot, mount = parent.kind.slots[module.slot], module.kind.mount
    assert mount is not None
    turn = module.orientation % 360
    out = _axis_words(module.rotation @ np.asarray(mount.outward))
    words = (
        f"Attach it to {parent.name}, slot {module.slot}: the face of {parent.name} that looks "
        f"along its own {_axis_words(np.asarray(slot.direction))}. It then looks along the core's "
        f"{out}, and its top (its own +z) along the core's {_axis_words(module.rotation[:, 2])}"
    )
    if turn:
        way = f"{turn:g}°" if turn <= 180 else f"{turn - 360:g}°".replace("-", "−")
        words += f", turned by {way} about the way it looks (right-handed)"
    if module.kind.hinge is not None:
        words += ". Set its servo to 0 before you fix what it carries"
    return words + "."


def _axis_words(vector: np.ndarray) -> str:
    """A direction: the name of an axis, or three numbers."""
    k = int(np.abs(vector).argmax())
    if abs(abs(vector[k]) - 1) < 1e-6:
        return ("+" if vector[k] > 0 else "−") + _AXES[k]
    return f"({_numbers(vector, 3)})"


def _amount(x: float) -> str:
    """Four digits, of a large number all before the point: a scale shows them."""
    return f"{x:.4g}" if abs(x) < 999.95 else f"{x:.0f}"


def _numbers(values: Sequence[float] | np.ndarray, digits: int) -> str:
    # + 0 makes 0 of −0.
    return ", ".join(f"{round(float(x), 4) + 0:.{digits}g}" for x in values).replace("-", "−")


def _draw(scene: Scene, whole: Scene, view: np.ndarray) -> str:
    """A picture as the source of an image: what is there of a robot, in the whole's frame."""
    low, high = whole.bounds(view)
    pixel = float(((high - low) / (_SIZE - 2 * _MARGIN)).max())
    low = (low + high - pixel * (_SIZE - 2)) / 2
    image = draw_scene(scene, view, low, low + pixel * (_SIZE - 2), pixel)[0][::-1]
    picture = Image.fromarray(np.round(255 * on_white(image)).astype(np.uint8))
    draw = ImageDraw.Draw(picture)
    # The core's axes in the emptiest corner.
    length, room = 24.0, 34
    corners = [(x, y) for x in (room, picture.width - room) for y in (picture.height - room, room)]
    covered = [image[y - room : y + room, x - room : x + room, 3].sum() for x, y in corners]
    corner = np.array(corners[int(np.argmin(covered))], float)
    for k, name in enumerate(_AXES):
        way = view[:2, k] * (1, -1)
        tip = corner + length * way
        draw.line([*corner, *tip], fill=(60, 70, 80), width=2)
        draw.text(tuple(corner + (length + 8) * way), name, fill=(60, 70, 80), anchor="mm")
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", optimize=True)
    return data_address(buffer.getvalue(), "image/png")


def _stl_files(body: Morphology) -> list[dict[str, object]]:
    """The parts' shapes in millimetres, as downloads."""
    found = []
    for name, mesh in make_meshes(body).items():
        scaled = mesh.copy()
        scaled.apply_scale(1e3)
        stl: Any = scaled.export(file_type="stl")
        found.append(
            {"name": f"{name}.stl", "source": data_address(stl, "model/stl"),
             "size": " × ".join(f"{x:.4g}" for x in scaled.extents),
             "volume": float(scaled.volume) / 1e3}
        )  # fmt: skip
    return found
