"""What the water needs to know of each part: the per-part tables behind every law.

A *part* is what moves and floats as one box: core, brick, sensor, thruster and fin are one part
each, an active hinge is two (the frame, fixed to the parent, and the servo holder, which moves).
Where a part makes no choice of its own, the world's holds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mjx_revolve.body.exposure import exposed_shares
from mjx_revolve.body.module_types import Part
from mjx_revolve.body.placement import RestPose
from mjx_revolve.inputs.short_repr import short_repr
from mjx_revolve.water.added_mass import box_added_mass, entrained_water
from mjx_revolve.water.drag import DRAG_LAWS
from mjx_revolve.water.law_names import list_coefficients
from mjx_revolve.water.laws import Coefficient
from mjx_revolve.water.world import World


@dataclass(frozen=True, eq=False)
class FluidTable:
    """Tables of the parts of a robot, or of several one behind the other; NumPy, never traced.

    It is what laws take their numbers from: `laws.PartShapes`.

    Attributes:
        body: MuJoCo body that carries the part.
        module: module of the morphology.
        position: centre of the part's box, body frame [m].
        rotation: body from part.
        half_size: half edges of the box [m].
        center_of_volume: centre of the displaced volume, part frame [m].
        volume: displaced volume: tabulated mesh volume, electronics and ballast [m³].
        mass: [kg].
        silhouette: area of the part's boxes together, seen along each axis [m²].
        exposed: share of each pair of faces that the water reaches [-].
        buoyancy: names of the buoyancy laws.
        drag: names of the drag laws.
        coefficients: `[npart]` each: every coefficient of the laws, by name.
        parameters: `[npart]` each: the parameters of laws that have a class of them.
        added_mass: of the envelope's exposed faces, per unit density, part frame [m³].
        added_inertia: the same about the axes [m⁵].
        carried_mass: what the step carries: added mass where it is switched on, and entrained
            water, per unit density [m³].
        carried_inertia: the same about the axes [m⁵].
    """

    __repr__ = short_repr

    body: Int[np.ndarray, " npart"]
    module: Int[np.ndarray, " npart"]
    position: Float[np.ndarray, "npart 3"]
    rotation: Float[np.ndarray, "npart 3 3"]
    half_size: Float[np.ndarray, "npart 3"]
    center_of_volume: Float[np.ndarray, "npart 3"]
    volume: Float[np.ndarray, " npart"]
    mass: Float[np.ndarray, " npart"]
    silhouette: Float[np.ndarray, "npart 3"]
    exposed: Float[np.ndarray, "npart 3"]
    buoyancy: tuple[str, ...]
    drag: tuple[str, ...]
    coefficients: Mapping[str, Float[np.ndarray, " npart"]]
    parameters: Mapping[str, tuple[Any, ...]]
    added_mass: Float[np.ndarray, "npart 3"]
    added_inertia: Float[np.ndarray, "npart 3"]
    carried_mass: Float[np.ndarray, "npart 3"]
    carried_inertia: Float[np.ndarray, "npart 3"]

    @property
    def face_area(self) -> Float[np.ndarray, "npart 3"]:
        """What the water reaches of a face across each axis [m²]."""
        area: np.ndarray = self.exposed * self.silhouette
        return area

    @property
    def carries(self) -> bool:
        """Whether any part carries water along."""
        return bool(np.any(self.carried_mass) or np.any(self.carried_inertia))


def drag_law(part: Part, world: World) -> str:
    """The name of a part's drag law: its own, that of its fin, or the world's.

    A world that switches drag off switches it off for every part, and MuJoCo's laws, which know no
    fins, hold for fins too.
    """
    if world.drag == "off":
        return "off"
    fin = part.lift_drag is not None and world.drag == "faces"
    return part.drag or ("lift_drag" if fin else world.drag)


def make_fluid_table(
    layout: RestPose,
    body: Int[np.ndarray, " npart"],
    position: Float[np.ndarray, "npart 3"],
    rotation: Float[np.ndarray, "npart 3 3"],
    world: World,
) -> FluidTable:
    """The rows of all parts; drag and added mass act on exposed faces only.

    Args:
        layout: the parts at rest.
        body: which moving body carries each.
        position: of each part's frame, body frame [m].
        rotation: of each part, body from part.
        world: whose laws hold where a part has none of its own.
    """
    parts, kind, exposed = layout.parts, layout.kind, exposed_shares(layout)

    def each(values: list[Any]) -> tuple[Any, ...]:
        """By part, from what is read once for parts that are the same."""
        return tuple(values[k] for k in kind.tolist())

    def given(part: Part, c: Coefficient) -> Any:
        if c.own_field:
            return getattr(part, c.name)
        return dict(part.coefficients).get(c.name, dict(world.coefficients).get(c.name, c.default))

    half = np.array([p.boxes[0].size for p in parts]) / 2
    mass, inertia = box_added_mass(half)
    coefficients = {c.name: np.array([given(p, c) for p in parts]) for _, c in list_coefficients()}
    scale = coefficients["added_mass_coefficient"][:, None]
    free = np.array([p.free_volume for p in parts])
    inside = entrained_water(half, free, coefficients["entrained_water"])
    on = np.array([[world.added_mass and p.added_mass is not False] for p in parts])
    # Water that turns about an axis is pushed by the four faces beside it.
    beside = (exposed[:, [1, 2, 0]] + exposed[:, [2, 0, 1]]) / 2
    added_mass = exposed * (scale * mass)[kind]
    added_inertia = beside * (scale * inertia)[kind]
    off = world.buoyancy == "off"
    return FluidTable(
        body=body,
        module=layout.module,
        position=position,
        rotation=rotation,
        half_size=half[kind],
        center_of_volume=np.array([p.displaced_center for p in parts], float)[kind],
        volume=np.array([p.total_volume for p in parts])[kind],
        mass=np.array([p.total_mass for p in parts])[kind],
        silhouette=np.array([p.face_areas for p in parts])[kind],
        exposed=exposed,
        buoyancy=each(["off" if off else p.buoyancy or world.buoyancy for p in parts]),
        drag=each([drag_law(p, world) for p in parts]),
        coefficients={name: x[kind] for name, x in coefficients.items()},
        parameters={
            name: each([getattr(p, name) or getattr(world, name) for p in parts])
            for name, law in DRAG_LAWS.items()
            if law.parameters is not None
        },
        added_mass=added_mass,
        added_inertia=added_inertia,
        carried_mass=on[kind] * added_mass + (world.added_mass * inside[0])[kind],
        carried_inertia=on[kind] * added_inertia + (world.added_mass * inside[1])[kind],
    )
