"""MuJoCo's two drag laws: the inertia box of a body, and the ellipsoid of a part.

`v` and `w` are relative to the water (Fossen's ν_r). Both are explicit, as in MuJoCo's Euler step:
the inertia box with the velocity at its beginning, too, the ellipsoid with that in its middle, for
bodies heavy enough.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mjx_revolve.numerics.lazy import jnp, mujoco
from mjx_revolve.numerics.spatial import (
    Vec,
    add,
    cross,
    mul,
    neg,
    safe_norm,
    total,
    vadd,
    vscale,
)
from mjx_revolve.water.face_drag import FACES
from mjx_revolve.water.laws import (
    BodyDragLaw,
    Drag,
    Export,
    PartDragLaw,
    PartFlow,
    PartShapes,
    law_numbers,
    part_field,
)

if TYPE_CHECKING:
    from mjx_revolve.water.world import World

# Why no factor varies the numbers of a law of MuJoCo.
_AS_IT_IS = "MuJoCo's law stays as MuJoCo has it"
# Coefficients that MuJoCo gives a geom with fluidshape="ellipsoid" (MuJoCo documentation,
# "Fluid forces"): blunt drag, slender drag, angular drag, Kutta lift, Magnus lift.
ELLIPSOID_COEFFICIENTS = (0.5, 0.25, 1.5, 1.0, 1.0)


def inertia_box(v: Vec, w: Vec, size: Vec, density: float, viscosity: float) -> tuple[Vec, Vec]:
    """MuJoCo's inertia-box law for one body, in its inertial frame.

    Source: MuJoCo documentation, Computation, "Inertia model"; `mj_inertiaBoxFluidModel`.

    Args:
        v: velocity of the centre of mass relative to the water [m/s].
        w: angular velocity [rad/s].
        size: edges of the box of equal inertia [m].
        density: [kg/m³].
        viscosity: [Pa·s].

    Returns:
        Force [N] and torque [N·m], inertial frame, at the centre of mass.
    """
    diameter = total(*size) / 3
    force, torque = [], []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        area = mul(size[j], size[k])
        quartic = mul(size[i], add(size[j] ** 4, size[k] ** 4))
        viscous = 3 * np.pi * viscosity * diameter
        force.append(neg(mul(add(viscous, mul(0.5 * density * area, jnp.abs(v[i]))), v[i])))
        viscous = np.pi * viscosity * diameter**3
        torque.append(neg(mul(add(viscous, mul(density * quartic / 64, jnp.abs(w[i]))), w[i])))
    return tuple(force), tuple(torque)


@law_numbers
class EllipsoidNumbers:
    """What MuJoCo's ellipsoid law takes of the shape of parts and of the water.

    Attributes:
        areas: squared areas across the axes over the largest [-].
        kutta: of the Kutta lift [kg/m].
        magnus: of the Magnus lift [kg].
        blunt: of blunt less slender drag [kg/m].
        slender: of slender drag [kg/m].
        turning: of drag against turning about each axis [kg·m²].
        viscous: of Stokes's drag [N·s/m].
        viscous_turning: the same against turning [N·m·s].
        mass: virtual mass [kg].
        inertia: virtual inertia [kg·m²].
        gradient: bound of the force's derivative by the speed, over density and speed [m²].
    """

    areas: Any = part_field("-", axes="size", blank=1.0, fixed=_AS_IT_IS)
    kutta: Any = part_field("kg/m", fixed=_AS_IT_IS)
    magnus: Any = part_field("kg", fixed=_AS_IT_IS)
    blunt: Any = part_field("kg/m", fixed=_AS_IT_IS)
    slender: Any = part_field("kg/m", fixed=_AS_IT_IS)
    turning: Any = part_field("kg m2", axes="size", fixed=_AS_IT_IS)
    viscous: Any = part_field("N s/m", fixed=_AS_IT_IS)
    viscous_turning: Any = part_field("N m s", fixed=_AS_IT_IS)
    mass: Any = part_field("kg", axes="size", fixed=_AS_IT_IS)
    inertia: Any = part_field("kg m2", axes="size", fixed=_AS_IT_IS)
    gradient: Any = part_field("m2", fixed=_AS_IT_IS)


def ellipsoid_numbers(
    half_size: Float[np.ndarray, "*n 3"],
    geom_fluid: Float[np.ndarray, "*n 12"],
    density: float,
    viscosity: float,
) -> EllipsoidNumbers:
    """The numbers of MuJoCo's ellipsoid law.

    Args:
        half_size: semi-axes [m].
        geom_fluid: MuJoCo's `geom_fluid`: interaction, blunt, slender, angular, Kutta, Magnus,
            virtual mass (3), virtual inertia (3).
        density: of the water [kg/m³].
        viscosity: of the water [Pa·s].
    """
    s = np.asarray(half_size, np.float64)
    g = np.asarray(geom_fluid, np.float64)
    interaction, blunt, slender, angular, kutta, magnus = (g[..., i] for i in range(6))
    _, middle, large = np.moveaxis(np.sort(s, -1), -1, 0)
    areas = np.stack([s[..., 1] * s[..., 2], s[..., 2] * s[..., 0], s[..., 0] * s[..., 1]], -1) ** 2
    largest = areas.max(-1)
    facing = np.pi * np.sqrt(largest)  # the largest area that may face the flow
    beside = np.maximum(s[..., [1, 2, 0]], s[..., [2, 0, 1]])
    own = 8 / 15 * np.pi * s * beside**4
    inertia_max = (8 / 15 * np.pi * middle * large**4)[..., None]
    turning = angular[..., None] * own + slender[..., None] * (inertia_max - own)
    diameter = 2 / 3 * s.sum(-1)
    dense = density * interaction
    # Drag is of second order in the speed. Lift grows the fastest where the flow is along the part:
    # by (1 - a) / √a of the Kutta coefficient, with the smallest squared area a over the largest.
    least = areas.min(-1) / largest
    steepest = 2 * np.maximum(blunt, slender) + kutta * (1 - least) / np.sqrt(least)
    return EllipsoidNumbers(
        areas=areas / largest[..., None],
        kutta=dense * kutta * facing,
        magnus=dense * magnus * (4 / 3 * np.pi * s.prod(-1)),
        blunt=dense * (blunt - slender) * facing,
        slender=dense * slender * np.pi * large * middle,
        turning=dense[..., None] * turning,
        viscous=viscosity * interaction * 3 * np.pi * diameter,
        viscous_turning=viscosity * interaction * np.pi * diameter**3,
        mass=dense[..., None] * g[..., 6:9],
        inertia=dense[..., None] * g[..., 9:12],
        gradient=interaction * facing * steepest,
    )


@lru_cache(maxsize=4096)
def _geom_fluid(half_size: tuple[float, float, float]) -> np.ndarray:
    """`[12]` MuJoCo's `geom_fluid` of a box."""
    spec = mujoco.MjSpec()
    geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half_size)
    geom.fluid_ellipsoid, geom.fluid_coefs = 1, ELLIPSOID_COEFFICIENTS
    return spec.compile().geom_fluid[0].copy()


def _numbers_of_ellipsoids(parts: PartShapes, world: World) -> EllipsoidNumbers:
    fluid = np.array([_geom_fluid(tuple(half)) for half in parts.half_size.tolist()])
    return ellipsoid_numbers(parts.half_size, fluid, world.density, world.viscosity)


def _ellipsoid_drag(flow: PartFlow, numbers: EllipsoidNumbers, world: World) -> Drag:
    v, w, submerged, _ = flow
    # Where our own added mass acts, MuJoCo's virtual mass would be a second one.
    force, torque = ellipsoid(v, w, numbers, not world.added_mass)
    return Drag(vscale(submerged, force), vscale(submerged, torque), None)


def ellipsoid(v: Vec, w: Vec, k: EllipsoidNumbers, carried: bool) -> tuple[Vec, Vec]:
    """MuJoCo's ellipsoid law for one geom, in its own frame.

    Source: MuJoCo documentation, Computation, "Ellipsoid model"; `mj_ellipsoidFluidModel`: blunt
    and slender drag, angular drag, Kutta and Magnus lift, and the velocity terms of its virtual
    mass.

    Args:
        v: velocity of the centre relative to the water [m/s].
        w: angular velocity [rad/s].
        k: numbers, vectors as tuples of three.
        carried: whether MuJoCo's virtual-mass terms are included (not when our own added mass is).

    Returns:
        Force [N] and torque [N·m], geom frame, at the centre.
    """
    squares = [x * x for x in v]
    num = total(*[mul(a, x) for a, x in zip(k.areas, squares, strict=True)])
    den = total(*[mul(a * a, x) for a, x in zip(k.areas, squares, strict=True)])
    speed = safe_norm(v)
    # So fast that the quotients below have finite gradients: some nm/s in float32.
    moving = den > np.finfo(speed.dtype).tiny ** 0.45
    # The area that faces the flow, over the largest.
    above, below = jnp.where(moving, den, 1.0), jnp.where(moving, num, 1.0)
    facing = jnp.sqrt(above / below)
    # As MuJoCo has it: the denominator is the normal's length squared, which scales `normal` below.
    normal = tuple(mul(a, x) for a, x in zip(k.areas, v, strict=True))
    cosine = jnp.where(moving, num / (jnp.where(moving, speed, 1.0) * above), 0.0)
    # (n × v) × v = (n · v) v - (v · v) n
    square = total(*squares)
    across = tuple(num * x - square * n for x, n in zip(v, normal, strict=True))
    lift = vscale(mul(k.kutta, cosine * facing), across)
    spin = vscale(k.magnus, cross(w, v))
    drag = add(k.viscous, speed * add(mul(k.blunt, facing), k.slender))
    moment = tuple(mul(t, x) for t, x in zip(k.turning, w, strict=True))
    turning = add(k.viscous_turning, safe_norm(moment))
    force = tuple(total(a, b, neg(mul(drag, x))) for a, b, x in zip(lift, spin, v, strict=True))
    torque = tuple(neg(mul(turning, x)) for x in w)
    if carried:
        momentum = tuple(mul(m, x) for m, x in zip(k.mass, v, strict=True))
        spin_momentum = tuple(mul(m, x) for m, x in zip(k.inertia, w, strict=True))
        force = vadd(force, cross(momentum, w))
        torque = vadd(torque, vadd(cross(momentum, v), cross(spin_momentum, w)))
    return force, torque


_INSTEAD = "replaced by the drag of the modules' faces"

INERTIA_BOX = BodyDragLaw(
    name="inertia_box",
    summary="MuJoCo's law for a body as one box of equal inertia",
    explicit=True,
    varied=False,
    body_force=inertia_box,
    mjcf=Export("inertia_box", note="drag is MuJoCo's inertia-box law, as it evolved with"),
    sdf=Export("faces", FACES.sdf.note, missing=f"drag: inertia_box, {_INSTEAD}"),
)
ELLIPSOID = PartDragLaw(
    name="ellipsoid",
    summary="MuJoCo's law for an ellipsoid, with lift",
    explicit=True,
    varied=False,
    steepest=lambda ellipsoid: ellipsoid.gradient,
    numbers=_numbers_of_ellipsoids,
    force=_ellipsoid_drag,
    mj_fluidcoef=ELLIPSOID_COEFFICIENTS,
    mjcf=Export("ellipsoid", note="drag and lift are MuJoCo's ellipsoid law, as it evolved with"),
    sdf=Export("faces", FACES.sdf.note, missing=f"drag: ellipsoid, {_INSTEAD}"),
)
