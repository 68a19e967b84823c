"""What the water needs to know of each part: the per-module tables behind every law.

A *part* is what moves and floats as one box: core, brick, sensor, thruster and fin are one part
each, an active hinge is two (the frame, fixed to the parent, and the servo holder, which moves).
The tables come from the module types; where a part makes no choice of its own, the world's holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjx_revolve.body.module_types import Part
from mjx_revolve.water.added_mass import box_added_mass, entrained_water
from mjx_revolve.water.drag import face_drag_coefficients
from mjx_revolve.water.lift_drag import LiftDrag
from mjx_revolve.water.world import World


@dataclass(frozen=True)
class FluidTable:
    """Tables of a robot's parts; NumPy arrays, never traced.

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
    parts: list[Part],
    body: list[int],
    module: list[int],
    position: list[np.ndarray],
    rotation: list[np.ndarray],
    exposed: np.ndarray,
    world: World,
) -> FluidTable:
    """Stacks the rows of all parts; drag and added mass act on exposed faces only.

    Args:
        parts: the parts, in the order of the modules.
        body: of each part.
        module: of each part.
        position: of each part's frame, body frame [m].
        rotation: of each part, body from part.
        exposed: `[npart, 3]` from `exposure.exposed_shares`.
        world: whose laws hold where a part has none of its own.

    Returns:
        The table.
    """
    half = np.array([p.boxes[0].size for p in parts]) / 2
    scale = np.array([p.added_mass_coefficient for p in parts])[:, None]
    # Water that turns about an axis is pushed by the four faces beside it.
    beside = (exposed[:, [1, 2, 0]] + exposed[:, [2, 0, 1]]) / 2
    mass, inertia = box_added_mass(half)
    added_mass, added_inertia = scale * exposed * mass, scale * beside * inertia
    free = np.array([p.free_volume for p in parts])
    inside = entrained_water(half, free, np.array([p.entrained_water for p in parts]))
    on = [world.added_mass and p.added_mass is not False for p in parts]
    flooded = np.array([[world.added_mass]])
    drag = [
        face_drag_coefficients(np.array(p.boxes[0].size), p.face_areas, p.drag_coefficient, e)
        for p, e in zip(parts, exposed, strict=True)
    ]
    areas = np.array([p.face_areas for p in parts])
    upward = areas.argmax(-1)
    # The chord runs along the longer of the two edges that lie in the plate.
    forward = np.where(np.arange(3) == upward[:, None], -np.inf, half).argmax(-1)
    plates = tuple(p.lift_drag or world.lift_drag for p in parts)
    given = lambda name, usual: np.array(  # noqa: E731
        [
            np.asarray(getattr(plate, name) if getattr(plate, name) is not None else x, float)
            for plate, x in zip(plates, usual, strict=True)
        ]
    )
    return FluidTable(
        body=np.array(body, int),
        module=np.array(module, int),
        position=np.array(position),
        rotation=np.array(rotation),
        half_size=half,
        center_of_volume=np.array([p.displaced_center for p in parts], float),
        volume=np.array([p.total_volume for p in parts]),
        mass=np.array([p.total_mass for p in parts]),
        exposed=exposed,
        face_area=exposed * areas,
        buoyancy=tuple(
            "off" if world.buoyancy == "off" else p.buoyancy or world.buoyancy for p in parts
        ),
        drag=tuple(drag_law(p, world) for p in parts),
        drag_linear=np.array([d[0] for d in drag]),
        drag_angular=np.array([d[1] for d in drag]),
        added_mass=added_mass,
        added_inertia=added_inertia,
        carried_mass=np.array(on)[:, None] * added_mass + flooded * inside[0],
        carried_inertia=np.array(on)[:, None] * added_inertia + flooded * inside[1],
        plate=plates,
        plate_area=given("area", areas.max(-1)),
        plate_forward=given("forward", np.eye(3)[forward]),
        plate_upward=given("upward", np.eye(3)[upward]),
        plate_center=given("cp", np.zeros((len(parts), 3))),
    )
