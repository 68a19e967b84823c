"""Drag on boxes: the default law on a part's faces, and MuJoCo's two laws.

Every function works on many parts and many individuals at once: vectors are tuples of three arrays
(see `spatial`), tables are constants that broadcast against them. `v` and `w` are relative to the
water (Fossen's nu_r), in the part's own frame, at its box's centre.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from mjx_revolve.numerics.spatial import (
    Scalar,
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

# Coefficients that MuJoCo gives a geom with fluidshape="ellipsoid" (MuJoCo documentation,
# "Fluid forces"): blunt drag, slender drag, angular drag, Kutta lift, Magnus lift.
ELLIPSOID_COEFFICIENTS = (0.5, 0.25, 1.5, 1.0, 1.0)


def face_drag_coefficients(
    size: np.ndarray,
    face_areas: np.ndarray,
    drag_coefficient: Any,
    exposed: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic drag of boxes from their faces, per unit density.

    Along axis i the pressure acts on the face A_i: F = ½ ρ C_d A_i |v| v. Turning about axis i,
    each strip of the two pairs of faces beside it meets the water at ω r; integrating ½ ρ C_d (ω
    r)² r over them gives T = ρ C_d b_i (b_j⁴ + b_k⁴) / 64 |ω| ω (the form of MuJoCo's inertia-box
    law).

    Args:
        size: `[..., 3]` edges of the box [m].
        face_areas: `[..., 3]` area that faces each axis [m²].
        drag_coefficient: `[...]` C_d of a face that meets the flow [-].
        exposed: `[..., 3]` share of each pair of faces that the water reaches [-]; by default all.

    Returns:
        `[..., 3]` ½ C_d A [m²] and `[..., 3]` the angular one [m⁵].
    """
    b = np.asarray(size, np.float64)
    e = np.ones(3) if exposed is None else np.asarray(exposed, np.float64)
    drag = np.asarray(drag_coefficient, np.float64)[..., None]
    linear = 0.5 * drag * e * np.asarray(face_areas, np.float64)
    j, k = [1, 2, 0], [2, 0, 1]
    # The faces across k are strips along j, and the other way round.
    strips = e[..., k] * b[..., j] ** 4 + e[..., j] * b[..., k] ** 4
    return linear, drag * b * strips / 64


def quadratic_drag(rate: Scalar, coefficient: Scalar, share: Scalar) -> tuple[Scalar, Scalar]:
    """-c |x| x for one component, and the damping c |x| for its implicit treatment.

    A step takes the speed |x| at its beginning and the velocity at its end: dt c |x| joins the
    inertia that meets the force. For a single part that is exact, v / (1 + c v dt / m), at any time
    step: drag can stop a motion but never reverse it, and terminal speeds are those of the law.

    Args:
        rate: velocity [m/s] or angular velocity [rad/s] relative to the water.
        coefficient: ρ ½ C_d A [kg/m], or the angular one [kg·m²].
        share: submerged share [-].

    Returns:
        Force [N] or torque [N·m], and damping [N·s/m] or [N·m·s].
    """
    damping = mul(mul(coefficient, jnp.abs(rate)), share)
    return -damping * rate, damping


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


def ellipsoid_constants(
    half_size: np.ndarray, coefficients: np.ndarray, density: float, viscosity: float
) -> dict[str, Any]:
    """The numbers of MuJoCo's ellipsoid law that depend on the shape and the water alone.

    Args:
        half_size: `[..., 3]` semi-axes [m].
        coefficients: `[..., 12]` MuJoCo's `geom_fluid`: interaction, blunt, slender, angular,
            Kutta, Magnus, virtual mass (3), virtual inertia (3).
        density: of the water [kg/m³].
        viscosity: of the water [Pa·s].

    Returns:
        Constants for `ellipsoid`, each `[...]` or a tuple of three.
    """
    s = np.asarray(half_size, np.float64)
    g = np.asarray(coefficients, np.float64)
    interaction, blunt, slender, angular, kutta, magnus = (g[..., i] for i in range(6))
    _, middle, large = np.moveaxis(np.sort(s, -1), -1, 0)
    volume = 4 / 3 * np.pi * s.prod(-1)
    areas = np.stack([s[..., 1] * s[..., 2], s[..., 2] * s[..., 0], s[..., 0] * s[..., 1]], -1) ** 2
    largest = areas.max(-1)
    inertia_max = 8 / 15 * np.pi * middle * large**4
    own = (
        8
        / 15
        * np.pi
        * s
        * np.stack(
            [np.maximum(s[..., (i + 1) % 3], s[..., (i + 2) % 3]) ** 4 for i in range(3)], -1
        )
    )
    diameter = 2 / 3 * s.sum(-1)
    turning = angular[..., None] * own + slender[..., None] * (inertia_max[..., None] - own)
    facing = np.pi * np.sqrt(largest)  # the largest area that may face the flow
    scale, dense = interaction, density * interaction
    columns = lambda x: tuple(x[..., i] for i in range(3))  # noqa: E731
    return {
        "areas": columns(areas / largest[..., None]),
        "kutta": dense * kutta * facing,
        "magnus": dense * magnus * volume,
        "blunt": dense * (blunt - slender) * facing,
        "slender": dense * slender * np.pi * large * middle,
        "turning": columns(dense[..., None] * turning),
        "viscous": viscosity * scale * 3 * np.pi * diameter,
        "viscous_turning": viscosity * scale * np.pi * diameter**3,
        "mass": columns(dense[..., None] * g[..., 6:9]),
        "inertia": columns(dense[..., None] * g[..., 9:12]),
    }


def ellipsoid(v: Vec, w: Vec, k: dict[str, Any], carried: bool) -> tuple[Vec, Vec]:
    """MuJoCo's ellipsoid law for one geom, in its own frame.

    Source: MuJoCo documentation, Computation, "Ellipsoid model"; `mj_ellipsoidFluidModel`: blunt
    and slender drag, angular drag, Kutta and Magnus lift, and the velocity terms of its virtual
    mass.

    Args:
        v: velocity of the centre relative to the water [m/s].
        w: angular velocity [rad/s].
        k: constants from `ellipsoid_constants`.
        carried: whether MuJoCo's virtual-mass terms are included (not when our own added mass is).

    Returns:
        Force [N] and torque [N·m], geom frame, at the centre.
    """
    tiny = 1e-30
    squares = [x * x for x in v]
    num = total(*[mul(a, x) for a, x in zip(k["areas"], squares, strict=True)])
    den = total(*[mul(a * a, x) for a, x in zip(k["areas"], squares, strict=True)])
    speed = safe_norm(v)
    moving = speed > 0
    # The area that faces the flow, over the largest.
    facing = jnp.sqrt(jnp.where(moving, den / jnp.maximum(num, tiny), 1.0))
    # As MuJoCo has it: the denominator is the normal's length squared, which scales `normal` below.
    normal = tuple(mul(a, x) for a, x in zip(k["areas"], v, strict=True))
    cosine = jnp.where(moving, num / jnp.maximum(speed * den, tiny), 0.0)
    # (n × v) × v = (n · v) v - (v · v) n
    square = total(*squares)
    across = tuple(num * x - square * n for x, n in zip(v, normal, strict=True))
    lift = vscale(mul(k["kutta"], cosine * facing), across)
    spin = vscale(k["magnus"], cross(w, v))
    drag = add(k["viscous"], speed * add(mul(k["blunt"], facing), k["slender"]))
    moment = tuple(mul(t, x) for t, x in zip(k["turning"], w, strict=True))
    turning = add(k["viscous_turning"], safe_norm(moment))
    force = tuple(total(a, b, neg(mul(drag, x))) for a, b, x in zip(lift, spin, v, strict=True))
    torque = tuple(neg(mul(turning, x)) for x in w)
    if carried:
        momentum = tuple(mul(m, x) for m, x in zip(k["mass"], v, strict=True))
        spin_momentum = tuple(mul(m, x) for m, x in zip(k["inertia"], w, strict=True))
        force = vadd(force, cross(momentum, w))
        torque = vadd(torque, vadd(cross(momentum, v), cross(spin_momentum, w)))
    return force, torque
