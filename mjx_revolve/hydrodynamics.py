"""The water's forces on a robot's parts: buoyancy, drag, lift and added mass, as pure functions.

Every function works on many parts and many individuals at once: vectors are tuples of three arrays
(see `spatial`), tables are constants that broadcast against them. All of it runs under `jax.jit`,
`vmap` and `grad`. Frames: `v`, `w` and forces are in the part's own frame, at its box's centre;
`up` is the world's vertical seen from there. `v` and `w` are relative to the water (Fossen's nu_r).

A *part* is what moves and floats as one box: core, brick and sensor are one part each, an active
hinge is two (the frame, fixed to the parent, and the servo holder, which moves).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import elliprd

from mjx_revolve.spatial import (
    Scalar,
    Vec,
    add,
    cross,
    dot,
    mul,
    neg,
    safe_norm,
    sub,
    total,
    vadd,
    vscale,
)
from mjx_revolve.world import LiftDrag, World

# Smallest tilt, as a share of the box, that the clipping polynomial sees; see `submersion`.
_TILT_FLOOR = 0.05

# Coefficients that MuJoCo gives a geom with fluidshape="ellipsoid" (MuJoCo documentation,
# "Fluid forces"): blunt drag, slender drag, angular drag, Kutta lift, Magnus lift.
ELLIPSOID_COEFFICIENTS = (0.5, 0.25, 1.5, 1.0, 1.0)


class Water(NamedTuple):
    """What may differ between individuals or episodes of one compiled program.

    Attributes:
        surface_height: z of the surface, world frame [m], scalar or `[lanes]`.
        current: velocity of the water, world frame [m/s], three of scalar or `[lanes]`.
    """

    surface_height: Scalar
    current: Vec


def water_of(world: World) -> Water:
    """The world's own still surface and uniform current."""
    return Water(world.surface_height, tuple(world.current))


@dataclass(frozen=True)
class FluidTable:
    """What the water needs to know of each part; NumPy arrays, never traced.

    Attributes:
        body: `[npart]` MuJoCo body that carries the part.
        module: `[npart]` module of the morphology.
        position: `[npart, 3]` centre of the part's box, body frame [m].
        rotation: `[npart, 3, 3]` body from part.
        half_size: `[npart, 3]` half edges of the box [m].
        center_of_volume: `[npart, 3]` centre of the displaced volume, part frame [m].
        volume: `[npart]` displaced volume: tabulated mesh volume plus electronics [m³].
        mass: `[npart]` [kg].
        exposed: `[npart, 3]` share of each pair of faces that the water reaches [-].
        drag_linear: `[npart, 3]` ½ C_d A of each pair of faces [m²].
        drag_angular: `[npart, 3]` the same for rotation about each axis [m⁵].
        added_mass: `[npart, 3]` per unit density, part frame [m³].
        added_inertia: `[npart, 3]` per unit density, part frame [m⁵].
        plate_area: `[npart]` area of the largest face, for `lift_drag` [m²].
        plate_axes: `[npart, 2]` which part axes look forward and upward, for `lift_drag`.
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
    drag_linear: np.ndarray
    drag_angular: np.ndarray
    added_mass: np.ndarray
    added_inertia: np.ndarray
    plate_area: np.ndarray
    plate_axes: np.ndarray


# ---------------------------------------------------------------------------- tables


def lamb_coefficients(semi_axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Added mass and added inertia of an ellipsoid in unbounded water, per unit density.

    Lamb, Hydrodynamics (1932), §§ 114-115; the integrals are Carlson's R_D (Carlson 1979).

    Args:
        semi_axes: `[..., 3]` semi-axes a, b, c [m].

    Returns:
        `[..., 3]` added mass along each axis [m³] and `[..., 3]` added inertia about each [m⁵].
    """
    a, b, c = (np.asarray(semi_axes, np.float64)[..., i] for i in range(3))
    abc = a * b * c
    volume = 4 / 3 * np.pi * abc
    alpha = 2 / 3 * abc * elliprd(b * b, c * c, a * a)
    beta = 2 / 3 * abc * elliprd(c * c, a * a, b * b)
    gamma = 2 / 3 * abc * elliprd(a * a, b * b, c * c)
    mass = [volume * x / (2 - x) for x in (alpha, beta, gamma)]

    def inertia(b: np.ndarray, c: np.ndarray, beta: np.ndarray, gamma: np.ndarray) -> np.ndarray:
        difference, square = b * b - c * c, b * b + c * c
        below = 2 * difference + square * (beta - gamma)
        # A body of revolution about this axis carries no water round with it.
        round_ = np.abs(difference) < 1e-9 * square
        safe = np.where(round_, 1.0, below)
        return np.where(round_, 0.0, volume / 5 * difference**2 * (gamma - beta) / safe)

    added_inertia = [
        inertia(b, c, beta, gamma),
        inertia(c, a, gamma, alpha),
        inertia(a, b, alpha, beta),
    ]
    return np.stack(mass, -1), np.stack(added_inertia, -1)


def box_added_mass(half_size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Added mass of a box: that of the ellipsoid of equal volume and equal proportions.

    A choice: for a cube it gives 0.50 of the displaced water where experiment gives 0.64 to 0.68
    (DNV-RP-H103, table A-2); the inscribed ellipsoid would give 0.26.

    Args:
        half_size: `[..., 3]` half edges [m].

    Returns:
        As `lamb_coefficients`.
    """
    return lamb_coefficients((6 / np.pi) ** (1 / 3) * np.asarray(half_size, np.float64))


def face_drag_coefficients(
    size: np.ndarray,
    face_areas: np.ndarray,
    drag_coefficient: float,
    exposed: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic drag of a box from its faces, per unit density.

    Along axis i the pressure acts on the face A_i: F = ½ ρ C_d A_i |v| v. Turning about axis i,
    each strip of the two pairs of faces beside it meets the water at ω r; integrating ½ ρ C_d (ω
    r)² r over them gives T = ρ C_d b_i (b_j⁴ + b_k⁴) / 64 |ω| ω (the form of MuJoCo's inertia-box
    law).

    Args:
        size: `[3]` edges of the box [m].
        face_areas: `[3]` area that faces each axis [m²].
        drag_coefficient: C_d of a face that meets the flow [-].
        exposed: `[3]` share of each pair of faces that the water reaches [-]; by default all.

    Returns:
        `[3]` ½ C_d A [m²] and `[3]` the angular one [m⁵].
    """
    b = np.asarray(size, np.float64)
    e = np.ones(3) if exposed is None else np.asarray(exposed, np.float64)
    linear = 0.5 * drag_coefficient * e * np.asarray(face_areas, np.float64)
    angular = []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        # The faces across k are strips along j, and the other way round.
        strips = e[k] * b[j] ** 4 + e[j] * b[k] ** 4
        angular.append(drag_coefficient * b[i] * strips / 64)
    return linear, np.array(angular)


# ------------------------------------------------------------------------- buoyancy


def submersion(up: Vec, depth: Scalar, half_size: Vec, mode: str) -> tuple[Scalar, Vec]:
    """How much of a tilted box is below the surface, and where that share's centre is.

    "partial" is the closed form of the box cut by the plane. With a_i = h_i |n_i| (h half edges, n
    the vertical in the box's frame) and d the centre's depth, the mean submerged depth is

        W = Σ_σ σ₁σ₂σ₃ max(0, d + σ·a)⁴ / (192 a₁a₂a₃),    σ ∈ {-1, +1}³

    (repeated integration of max(0, ·) along the three edges, as for a box spline). The submerged
    share is ∂W/∂d and its first moment is -∂W/∂n, so force and moment come from one potential: they
    are continuous through the surface and conserve energy. Where an edge is level, a_i = 0 and the
    form is 0/0; |n_i| is therefore replaced by √(n_i² + ε²(1 - n_i⁴)) with ε = 0.05. That keeps the
    draft and the righting moment of a level box exact; elsewhere the share errs by less than 0.004
    and its moment by less than 0.004 of the box's half diagonal (tests/physics/test_buoyancy.py).

    "mask" is the thesis's rule: all of the part once its centre is below the surface. "off": none.

    Args:
        up: the world's vertical, part frame.
        depth: depth of the box's centre below the surface [m], positive under water.
        half_size: half edges [m].
        mode: "partial", "mask" or "off".

    Returns:
        The submerged share [-], and share times centre of the submerged piece relative to the box's
        centre, part frame [m].
    """
    zero = jnp.zeros_like(depth)
    if mode == "off":
        return zero, (zero, zero, zero)
    if mode == "mask":
        return (depth > 0).astype(depth.dtype), (zero, zero, zero)
    floor = _TILT_FLOOR**2
    squares = [n * n for n in up]
    smooth = [s + floor * (1 - s * s) for s in squares]
    # One reciprocal root per edge serves |n_i|, 1/a_i and the slope: divisions are dear.
    root = [jax.lax.rsqrt(q) for q in smooth]
    a = [mul(h, q * r) for h, q, r in zip(half_size, smooth, root, strict=True)]
    inverse = [mul(1 / np.asarray(h, np.float64), r) for h, r in zip(half_size, root, strict=True)]
    reach = total(*a)
    d = jnp.clip(depth, -reach, reach)
    # Corners in pairs along the first edge: Σ over the pair, and its difference, of t³.
    share, fourth, slopes = zero, zero, [zero, zero, zero]
    for s1 in (1, -1):
        for s2 in (1, -1):
            middle = d + s1 * a[1] + s2 * a[2]
            high, low = jnp.maximum(middle + a[0], 0), jnp.maximum(middle - a[0], 0)
            high2, low2 = high * high, low * low
            high3, low3 = high2 * high, low2 * low
            difference = high3 - low3
            share = share + s1 * s2 * difference
            slopes[0] = slopes[0] + s1 * s2 * (high3 + low3)
            slopes[1] = slopes[1] + s2 * difference
            slopes[2] = slopes[2] + s1 * difference
            fourth = fourth + s1 * s2 * (high2 * high2 - low2 * low2)
    inverse3 = inverse[0] * inverse[1] * inverse[2]
    inside = jnp.abs(depth) < reach
    share = jnp.where(inside, share * inverse3 * (1 / 48), (depth > 0).astype(depth.dtype))
    moment = []
    for i in range(3):
        slope = (slopes[i] * (1 / 48) - fourth * inverse[i] * (1 / 192)) * inverse3  # ∂W/∂a_i
        tilted = (1 - 2 * floor * squares[i]) * up[i] * root[i]  # ∂|n_i|/∂n_i
        moment.append(jnp.where(inside, -mul(half_size[i], slope * tilted), 0))
    return share, tuple(moment)


def buoyancy(
    up: Vec, share: Scalar, moment: Vec, volume: Scalar, center: Vec, weight_density: Scalar
) -> tuple[Vec, Vec]:
    """Archimedes' force on a part, and its torque about the box's centre.

    Args:
        up: the world's vertical, part frame.
        share: submerged share of the volume [-].
        moment: share times centre of the submerged piece, from the centre of volume [m].
        volume: displaced when wholly submerged [m³].
        center: centre of volume, from the box's centre, part frame [m].
        weight_density: ρ g of the water [N/m³].

    Returns:
        Force [N] and torque [N·m], part frame, at the box's centre.
    """
    lift = mul(mul(weight_density, volume), 1.0)
    force = vscale(mul(lift, share), up)
    torque = vscale(lift, cross(moment, up))
    return force, vadd(torque, cross(center, force))


# --------------------------------------------------------------------- drag and lift


def quadratic_drag(rate: Scalar, coefficient: Scalar, share: Scalar, limit: Scalar) -> Scalar:
    """-c |x| x for one component, never so strong that one step would reverse the motion.

    An explicit step is stable while c |x| dt is below the inertia that meets it. The coefficient is
    capped at `limit` = inertia of the part / dt: because the parts' inertias add up to no more than
    the body's, the damping of one step is then at most the body's inertia, so it can stop a motion
    but never reverse it. Below the cap (several m/s for the catalogue's modules) nothing is
    changed.

    Args:
        rate: velocity [m/s] or angular velocity [rad/s] relative to the water.
        coefficient: ρ ½ C_d A [kg/m], or the angular one [kg·m²].
        share: submerged share [-].
        limit: inertia / timestep [kg/s], or [kg·m²/s].

    Returns:
        Force [N] or torque [N·m].
    """
    # The share comes last: a part that is half out of the water carries less of it with it, too.
    strength = jnp.minimum(mul(coefficient, jnp.abs(rate)), limit) * share
    return -strength * rate


def lift_drag(v: Vec, forward: Vec, upward: Vec, area: Scalar, density: float, p: LiftDrag) -> Vec:
    """Gazebo's LiftDragPlugin for one plate, its 0/0 cases taken out.

    Source: Gazebo 9 `LiftDragPlugin.cc`, with v in the lift-drag plane taken as v - (v·n)n (the
    original subtracts along v/|v| instead of n).

    Args:
        v: velocity of the centre of pressure relative to the water [m/s].
        forward: unit vector of zero angle of attack.
        upward: unit vector of the upper surface.
        area: of the plate [m²].
        density: of the water [kg/m³].
        p: coefficients.

    Returns:
        Force [N], same frame as v.
    """
    n = cross(forward, upward)
    spanwise = dot(v, n)
    plane = tuple(sub(x, mul(spanwise, y)) for x, y in zip(v, n, strict=True))
    speed = safe_norm(v)
    speed_in_plane = safe_norm(plane)
    moving = speed_in_plane > 1e-9
    safe_speed = jnp.where(moving, speed_in_plane, 1.0)
    cos2_sweep = 1 - jnp.where(moving, spanwise / jnp.where(speed > 0, speed, 1.0), 0.0) ** 2
    x = jnp.where(moving, dot(plane, forward), 1.0)
    y = jnp.where(moving, neg(dot(plane, upward)), 0.0)
    alpha = p.a0 + jnp.arctan2(y, x)
    alpha = alpha - np.pi * jnp.round(alpha / np.pi)
    beyond = jnp.maximum(jnp.abs(alpha) - p.alpha_stall, 0)
    before = jnp.minimum(jnp.abs(alpha), p.alpha_stall)
    stalled = jnp.maximum(p.cla * before + p.cla_stall * beyond, 0)
    lifting = jnp.where(beyond > 0, stalled, p.cla * before)
    c_lift = jnp.sign(alpha) * lifting * cos2_sweep
    c_drag = jnp.abs((p.cda * before + p.cda_stall * beyond) * cos2_sweep)
    pressure = 0.5 * density * area * speed_in_plane / safe_speed
    lift_direction = cross(n, plane)  # |n × plane| = |plane|
    return tuple(
        pressure * speed_in_plane * (c_lift * up - c_drag * along)
        for up, along in zip(lift_direction, plane, strict=True)
    )


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


def ellipsoid_constants(half_size: np.ndarray, coefficients: np.ndarray) -> dict[str, Any]:
    """The numbers of MuJoCo's ellipsoid law that depend on the shape alone.

    Args:
        half_size: `[..., 3]` semi-axes [m].
        coefficients: `[..., 12]` MuJoCo's `geom_fluid`: interaction, blunt, slender, angular,
            Kutta, Magnus, virtual mass (3), virtual inertia (3).

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
    scale = interaction
    columns = lambda x: tuple(x[..., i] for i in range(3))  # noqa: E731
    return {
        "areas": columns(areas / largest[..., None]),
        "project": np.pi * np.sqrt(largest),
        "kutta": scale * kutta,
        "magnus": scale * magnus * volume,
        "blunt": scale * (blunt - slender),
        "slender": scale * slender * np.pi * large * middle,
        "turning": columns(scale[..., None] * turning),
        "viscous": scale * 3 * np.pi * diameter,
        "viscous_turning": scale * np.pi * diameter**3,
        "mass": columns(scale[..., None] * g[..., 6:9]),
        "inertia": columns(scale[..., None] * g[..., 9:12]),
    }


def ellipsoid(
    v: Vec, w: Vec, k: dict[str, Any], density: float, viscosity: float, carried: bool
) -> tuple[Vec, Vec]:
    """MuJoCo's ellipsoid law for one geom, in its own frame.

    Source: MuJoCo documentation, Computation, "Ellipsoid model"; `mj_ellipsoidFluidModel`: blunt
    and slender drag, angular drag, Kutta and Magnus lift, and the velocity terms of its virtual
    mass.

    Args:
        v: velocity of the centre relative to the water [m/s].
        w: angular velocity [rad/s].
        k: constants from `ellipsoid_constants`.
        density: [kg/m³].
        viscosity: [Pa·s].
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
    ratio = jnp.where(moving, den / jnp.maximum(num, tiny), 1.0)
    projected = mul(k["project"], jnp.sqrt(ratio))
    # As MuJoCo has it: the denominator is the normal's length squared, which scales `normal` below.
    normal = tuple(mul(a, x) for a, x in zip(k["areas"], v, strict=True))
    cosine = jnp.where(moving, num / jnp.maximum(speed * den, tiny), 0.0)
    lift = vscale(mul(density * k["kutta"], cosine * projected), cross(cross(normal, v), v))
    spin = vscale(density * k["magnus"], cross(w, v))
    drag = add(
        viscosity * k["viscous"],
        density * speed * add(mul(k["blunt"], projected), k["slender"]),
    )
    moment = [mul(density * t, x) for t, x in zip(k["turning"], w, strict=True)]
    turning = add(viscosity * k["viscous_turning"], safe_norm(tuple(moment)))
    force = tuple(total(a, b, neg(mul(drag, x))) for a, b, x in zip(lift, spin, v, strict=True))
    torque = tuple(neg(mul(turning, x)) for x in w)
    if carried:
        momentum = tuple(mul(density * m, x) for m, x in zip(k["mass"], v, strict=True))
        spin_momentum = tuple(mul(density * m, x) for m, x in zip(k["inertia"], w, strict=True))
        force = vadd(force, cross(momentum, w))
        torque = vadd(torque, vadd(cross(momentum, v), cross(spin_momentum, w)))
    return force, torque
