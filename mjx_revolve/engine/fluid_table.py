"""The per-part tables from which every law of the water takes its numbers.

A *part* is a rigid box: core, brick, sensor, thruster and fin are one part each, an active hinge is
two (the frame, fixed to the parent, and the servo holder, which moves). A part without a law of its
own has the world's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_revolve.body.exposure import exposure
from mjx_revolve.body.module_types import Part
from mjx_revolve.body.placement import RestPose
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.short_repr import short_repr
from mjx_revolve.water.added_mass import box_added_mass, entrained_water
from mjx_revolve.water.buoyancy import find_buoyancy_law
from mjx_revolve.water.cross_flow import CROSS_FLOW
from mjx_revolve.water.drag import DRAG_LAWS
from mjx_revolve.water.face_drag import beside, split_axes
from mjx_revolve.water.fin_wake import FIN_WAKE
from mjx_revolve.water.law_names import list_coefficients
from mjx_revolve.water.laws import Coefficient, PartShapes
from mjx_revolve.water.lift_drag import LIFT_DRAG
from mjx_revolve.water.mujoco_drag import ELLIPSOID, INERTIA_BOX
from mjx_revolve.water.plate_wake import PLATE_WAKE, thinness
from mjx_revolve.water.world import World

_ZERO_MATRIX = ((0.0,) * 6,) * 6


@dataclass(frozen=True, eq=False)
class FluidTable(PartShapes):
    """Tables of the parts of a robot, or of several one behind the other; NumPy, never traced.

    What laws take their numbers from is in `laws.PartShapes`.

    Attributes:
        body: MuJoCo body that carries the part.
        module: module of the morphology.
        position: centre of the part's box, body frame [m].
        rotation: body from part.
        center_of_volume: centre of the displaced volume, part frame [m].
        volume: displaced volume: tabulated mesh volume, electronics and ballast [m³].
        mass: [kg].
        buoyancy: names of the buoyancy laws.
        drag: names of the drag laws.
        added_mass: of the envelope's exposed faces, or as stated, per unit density, part frame
            [m³].
        added_inertia: the same about the axes [m⁵].
        carried_mass: what the step carries: added mass where it is switched on, and entrained
            water, per unit density [m³].
        carried_inertia: the same about the axes [m⁵].
        entrained: share of `carried_mass` that is entrained water [-].
        coupling: what a stated added mass has beside its diagonal: along the axes, then about them,
            per unit density, part frame [m³, m⁴, m⁵].
        stated: whether a part states its added mass.
    """

    __repr__ = short_repr

    body: Int[np.ndarray, " npart"]
    module: Int[np.ndarray, " npart"]
    position: Float[np.ndarray, "npart 3"]
    rotation: Float[np.ndarray, "npart 3 3"]
    center_of_volume: Float[np.ndarray, "npart 3"]
    volume: Float[np.ndarray, " npart"]
    mass: Float[np.ndarray, " npart"]
    buoyancy: tuple[str, ...]
    drag: tuple[str, ...]
    added_mass: Float[np.ndarray, "npart 3"]
    added_inertia: Float[np.ndarray, "npart 3"]
    carried_mass: Float[np.ndarray, "npart 3"]
    carried_inertia: Float[np.ndarray, "npart 3"]
    entrained: Float[np.ndarray, "npart 3"]
    coupling: Float[np.ndarray, "npart 6 6"]
    stated: Bool[np.ndarray, " npart"]

    @property
    def face_area(self) -> Float[np.ndarray, "npart 3"]:
        """What the water reaches of a face across each axis [m²]."""
        return self.exposed * self.silhouette

    @property
    def lifted(self) -> Float[np.ndarray, " npart"]:
        """Volume of what the water lifts of each part [m³]."""
        lifts = [find_buoyancy_law(name).lifts for name in self.buoyancy]
        return self.volume * np.array(lifts, float)

    @property
    def coupled(self) -> np.ndarray:
        """`[npart]` whether what a part carries is more than a diagonal in its axes."""
        return np.any(self.coupling, (1, 2))

    @property
    def carries(self) -> bool:
        """Whether any part carries water along."""
        return bool(np.any(self.carried_mass) or np.any(self.carried_inertia))


def drag_law(part: Part, world: World) -> str:
    """The name of a part's drag law: its own, that of its fin, or the world's.

    A world without drag has none for any part. MuJoCo's laws are for all parts, fins and parts with
    a damping of their own included; that of whole bodies for parts with another law, too. Under the
    drag law for flow across chains, thin parts and fins have laws with a memory of their wakes.
    """
    if world.drag in ("off", INERTIA_BOX.name):
        return world.drag
    if part.drag is not None or world.drag == ELLIPSOID.name:
        return _check_wake(part.drag or world.drag, part, world)
    if part.fossen is not None:
        return "fossen"
    crossed = world.drag == CROSS_FLOW.name
    if part.lift_drag is not None:
        lags = crossed and not part.lift_drag.radial_symmetry
        return FIN_WAKE.name if lags else LIFT_DRAG.name
    thin = crossed and thinness(part.boxes[0].size) > 0
    return PLATE_WAKE.name if thin else _check_wake(world.drag, part, world)


def _check_wake(name: str, part: Part, world: World) -> str:
    """The name of a drag law that the part's plate can have."""
    if name == FIN_WAKE.name and (part.lift_drag or world.lift_drag).radial_symmetry:
        raise InputError("lift_drag.radial_symmetry", f"false with drag: {name}", "true")
    return name


def _scaled(parameters: Any, part: Part) -> Any:
    """Parameters of a law times a part's factors on them, which are called LAW.FIELD."""
    law = next(name for name, law in DRAG_LAWS.items() if law.parameters is type(parameters))
    own = {k.partition(".")[2]: f for k, f in part.factors if k.startswith(f"{law}.")}
    if not own:
        return parameters
    changed = {name: getattr(parameters, name) * f for name, f in own.items()}
    if "alpha_stall" in changed:  # beyond a right angle nothing stalls
        changed["alpha_stall"] = min(changed["alpha_stall"], math.pi / 2)
    return replace(parameters, **changed)


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
        world: its laws are those of parts without one of their own.
    """
    parts, kind = layout.parts, layout.kind
    exposed, joined, ends, rows = exposure(layout)

    def each(values: list[Any]) -> tuple[Any, ...]:
        """By part, from what is read once for parts that are the same."""
        return tuple(values[k] for k in kind.tolist())

    def given(part: Part, c: Coefficient) -> Any:
        factor = dict(part.factors).get(c.name, 1.0)
        if c.own_field:
            value = getattr(part, c.name)
        else:
            usual = dict(world.coefficients).get(c.name, c.default)
            value = dict(part.coefficients).get(c.name, usual)
        value = np.minimum(np.multiply(value, factor), c.high)
        return np.broadcast_to(value, 3) if c.per_axis else value

    def column(look: Callable[[Part], Any]) -> np.ndarray:
        """`[npart, ...]` a number of each part, read once for parts that are the same."""
        return np.array([look(p) for p in parts])[kind]

    half = np.array([p.boxes[0].size for p in parts]) / 2
    mass, inertia = box_added_mass(half)
    coefficients = {c.name: np.array([given(p, c) for p in parts]) for _, c in list_coefficients()}
    scale, share = split_axes(coefficients["added_mass_coefficient"])
    free = np.array([p.free_volume for p in parts])
    inside = entrained_water(half, free, coefficients["entrained_water"])
    on = np.array([[world.added_mass and p.added_mass is not False] for p in parts])
    reached = exposed * share[kind]
    added_mass = reached * (scale * mass)[kind]
    # Water that turns about an axis is pushed by the four faces beside it.
    added_inertia = beside(reached) / 2 * (scale * inertia)[kind]
    stated = column(lambda p: p.fossen is not None)
    known = column(lambda p: _ZERO_MATRIX if p.fossen is None else p.fossen.added_mass)
    known = known / (world.density or np.inf)
    factors = {
        name: np.array([dict(p.factors).get(name, 1.0) for p in parts])[kind]
        for name in ("drag", "added_mass")
        if any(name in dict(p.factors) for p in parts)
    }
    more = factors.get("added_mass", np.ones(len(kind)))[:, None]
    known = known * more[..., None]
    # Where the core states the water of all of its robot, other parts have none.
    whole = column(lambda p: p.fossen is not None and p.fossen.whole)
    replaced = np.isin(layout.body, layout.body[whole]) & ~whole
    known[replaced] = 0.0
    diagonal = np.einsum("pii->pi", known)
    added_mass = np.where(stated[:, None], diagonal[:, :3], more * added_mass)
    added_inertia = np.where(stated[:, None], diagonal[:, 3:], more * added_inertia)
    added_mass[replaced] = added_inertia[replaced] = 0.0
    drag = each([drag_law(p, world) for p in parts])
    if replaced.any() and world.drag != ELLIPSOID.name:  # MuJoCo's laws are for all parts
        drag = tuple("off" if r else name for r, name in zip(replaced, drag, strict=True))
    own = (world.added_mass & ~(stated | replaced))[:, None]  # what fills the room is ours
    off = world.buoyancy == "off"
    flooded = own * more * inside[0][kind]
    carried_mass = on[kind] * added_mass + flooded
    return FluidTable(
        body=body,
        module=layout.module,
        position=position,
        rotation=rotation,
        half_size=half[kind],
        center_of_volume=np.array([p.displaced_center for p in parts], float)[kind],
        volume=column(lambda p: p.total_volume),
        mass=column(lambda p: p.total_mass),
        silhouette=column(lambda p: p.face_areas),
        exposed=exposed,
        joined=joined,
        ends=ends,
        rows=rows,
        buoyancy=each(["off" if off else p.buoyancy or world.buoyancy for p in parts]),
        drag=drag,
        coefficients={name: x[kind] for name, x in coefficients.items()},
        parameters={
            name: each(
                [
                    _scaled(getattr(p, name) or getattr(world, name, None) or law.parameters(), p)
                    for p in parts
                ]
            )
            for name, law in DRAG_LAWS.items()
            if law.parameters is not None
        },
        factors=factors,
        added_mass=added_mass,
        added_inertia=added_inertia,
        carried_mass=carried_mass,
        carried_inertia=on[kind] * added_inertia + own * more * inside[1][kind],
        entrained=flooded / np.where(carried_mass > 0, carried_mass, 1),
        coupling=on[kind][:, None] * (known - diagonal[:, None] * np.eye(6)),
        stated=stated,
    )
