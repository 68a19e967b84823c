"""What the water needs to know of each part: the per-module tables behind every law.

A *part* is what moves and floats as one box: core, brick, sensor, thruster and fin are one part
each, an active hinge is two (the frame, fixed to the parent, and the servo holder, which moves).
The tables come from the module types; where a part makes no choice of its own, the world's holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mjx_revolve.body.exposure import exposed_shares
from mjx_revolve.body.module_types import Part
from mjx_revolve.body.placement import Layout
from mjx_revolve.inputs.brief import brief
from mjx_revolve.water.added_mass import box_added_mass, entrained_water
from mjx_revolve.water.drag import face_drag_coefficients
from mjx_revolve.water.lift_drag import LiftDrag
from mjx_revolve.water.world import World


@dataclass(frozen=True)
class FluidTable:
    """Tables of the parts of a robot, or of several one behind the other; NumPy, never traced.

    Attributes:
        body: `[npart]` MuJoCo body that carries the part.
        module: `[npart]` module of the morphology.
        position: `[npart, 3]` centre of the part's box, body frame [m].
        rotation: `[npart, 3, 3]` body from part.
        half_size: `[npart, 3]` half edges of the box [m].
        center_of_volume: `[npart, 3]` centre of the displaced volume, part frame [m].
        volume: `[npart]` displaced volume: tabulated mesh volume, electronics and ballast [m³].
        mass: `[npart]` [kg].
        exposed: `[npart, 3]` share of each pair of faces that the water reaches [-].
        face_area: `[npart, 3]` that the water reaches of a face across each axis [m²].
        buoyancy: `[npart]` names of the buoyancy laws.
        drag: `[npart]` names of the drag laws.
        drag_linear: `[npart, 3]` ½ C_d A of each pair of faces [m²].
        drag_angular: `[npart, 3]` the same for rotation about each axis [m⁵].
        added_mass: `[npart, 3]` of the envelope, per unit density, part frame [m³].
        added_inertia: `[npart, 3]` of the envelope, per unit density, part frame [m⁵].
        carried_mass: `[npart, 3]` what the step carries: added mass where it is switched on, and
            entrained water, per unit density [m³].
        carried_inertia: `[npart, 3]` likewise [m⁵].
        plate: `[npart]` parameters of `lift_drag`.
        plate_area: `[npart]` area for `lift_drag`, by default of the largest face [m²].
        plate_forward: `[npart, 3]` unit vector of zero angle of attack, part frame.
        plate_upward: `[npart, 3]` unit vector of the plate's upper surface, part frame.
        plate_center: `[npart, 3]` centre of pressure, part frame [m].
    """

    __repr__ = brief

    body: np.ndarray
    module: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    half_size: np.ndarray
    center_of_volume: np.ndarray
    volume: np.ndarray
    mass: np.ndarray
    exposed: np.ndarray
    face_area: np.ndarray
    buoyancy: tuple[str, ...]
    drag: tuple[str, ...]
    drag_linear: np.ndarray
    drag_angular: np.ndarray
    added_mass: np.ndarray
    added_inertia: np.ndarray
    carried_mass: np.ndarray
    carried_inertia: np.ndarray
    plate: tuple[LiftDrag, ...]
    plate_area: np.ndarray
    plate_forward: np.ndarray
    plate_upward: np.ndarray
    plate_center: np.ndarray


def drag_law(part: Part, world: World) -> str:
    """The drag law of a part: its own, that of its fin, or the world's.

    A world that switches drag off switches it off for every part, and MuJoCo's laws, which know no
    fins, hold for fins too.

    Args:
        part: the part.
        world: the world.

    Returns:
        The law's name.
    """
    if world.drag == "off":
        return "off"
    fin = part.lift_drag is not None and world.drag == "faces"
    return part.drag or ("lift_drag" if fin else world.drag)


def make_fluid_table(
    layout: Layout, body: np.ndarray, position: np.ndarray, rotation: np.ndarray, world: World
) -> FluidTable:
    """The rows of all parts; drag and added mass act on exposed faces only.

    Args:
        layout: of the parts at rest.
        body: `[npart]` which moving body carries each.
        position: `[npart, 3]` of each part's frame, body frame [m].
        rotation: `[npart, 3, 3]` of each part, body from part.
        world: whose laws hold where a part has none of its own.

    Returns:
        The table.
    """
    parts, kind, exposed = layout.parts, layout.kind, exposed_shares(layout)
    # Once for each part that differs from the others.
    half = np.array([p.boxes[0].size for p in parts]) / 2
    areas = np.array([p.face_areas for p in parts])
    mass, inertia = box_added_mass(half)
    scale = np.array([p.added_mass_coefficient for p in parts])[:, None]
    free = np.array([p.free_volume for p in parts])
    inside = entrained_water(half, free, np.array([p.entrained_water for p in parts]))
    on = np.array([[world.added_mass and p.added_mass is not False] for p in parts])
    upward = areas.argmax(-1)
    # The chord runs along the longer of the two edges that lie in the plate.
    forward = np.where(np.arange(3) == upward[:, None], -np.inf, half).argmax(-1)
    plates = [p.lift_drag or world.lift_drag for p in parts]
    buoyancy = ["off" if world.buoyancy == "off" else p.buoyancy or world.buoyancy for p in parts]
    drag = [drag_law(p, world) for p in parts]

    def given(name: str, usual: np.ndarray) -> np.ndarray:
        found = zip((getattr(plate, name) for plate in plates), usual, strict=True)
        return np.array([np.asarray(y if x is None else x, float) for x, y in found])[kind]

    def each(values: list[Any]) -> tuple[Any, ...]:
        return tuple(values[k] for k in kind.tolist())

    # Water that turns about an axis is pushed by the four faces beside it.
    beside = (exposed[:, [1, 2, 0]] + exposed[:, [2, 0, 1]]) / 2
    added_mass = exposed * (scale * mass)[kind]
    added_inertia = beside * (scale * inertia)[kind]
    coefficient = np.array([p.drag_coefficient for p in parts])[kind]
    drag_linear, drag_angular = face_drag_coefficients(
        2 * half[kind], areas[kind], coefficient, exposed
    )
    return FluidTable(
        body=body,
        module=layout.module,
        position=position,
        rotation=rotation,
        half_size=half[kind],
        center_of_volume=np.array([p.displaced_center for p in parts], float)[kind],
        volume=np.array([p.total_volume for p in parts])[kind],
        mass=np.array([p.total_mass for p in parts])[kind],
        exposed=exposed,
        face_area=exposed * areas[kind],
        buoyancy=each(buoyancy),
        drag=each(drag),
        drag_linear=drag_linear,
        drag_angular=drag_angular,
        added_mass=added_mass,
        added_inertia=added_inertia,
        carried_mass=on[kind] * added_mass + (world.added_mass * inside[0])[kind],
        carried_inertia=on[kind] * added_inertia + (world.added_mass * inside[1])[kind],
        plate=each(plates),
        plate_area=given("area", areas.max(-1)),
        plate_forward=given("forward", np.eye(3)[forward]),
        plate_upward=given("upward", np.eye(3)[upward]),
        plate_center=given("cp", np.zeros((len(parts), 3))),
    )
