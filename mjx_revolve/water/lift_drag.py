"""Lift and drag of a plate: Gazebo's LiftDrag, for fins and wings.

Sources: Gazebo classic, `plugins/LiftDragPlugin.cc` (its later versions), and gz-sim,
`src/systems/lift_drag/LiftDrag.cc` (as of 2025). Where the two differ, or neither is physical:

- the flow in the lift-drag plane is v - (v·n) n, as in gz-sim; classic subtracts along v/|v|
  instead of n, which scales the flow by 1 - sin(sweep): more from one side than from the other;
- inflow from behind acts, as in classic; gz-sim has no force there unless `reversible`;
- at rest and in purely spanwise flow, 0/0 in both, there is no force; both also have none below
  0.01 m/s, where ours is small and continuous;
- the pitching moment acts, as in gz-sim; classic computes it and then sets it to zero ("needs
  testing"). Past the stall it stops at zero; gz-sim's limit keeps a positive slope from changing
  sign but drops the moment of a negative one, the stable kind, all at once;
- a body of revolution that swims exactly along its axis has α = a0; in both originals the zero
  vector makes α = a0 + 90°, with the drag of a body that swims sideways;
- the water's density is the world's unless one is given; the originals' default is that of air;
- the joint that deflects a control surface (`control_joint_rad_to_cl`, `cm_delta`) is left out: a
  fin on a hinge is a fin on a hinge here, and its angle of attack is its own.

Kept as it is, though no water does it: drag is zero with α (no skin friction), and lift changes
sign in a jump where α wraps at ±90°, unless `cla_stall` brings it to zero there, as
-cla alpha_stall / (π/2 - alpha_stall) does. With the defaults it does not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mjx_revolve.numerics.lazy import jax, jnp
from mjx_revolve.numerics.spatial import (
    Scalar,
    Vec,
    cross,
    dot,
    is_present,
    mul,
    neg,
    safe_norm,
    sub,
    vadd,
    vscale,
)
from mjx_revolve.water.face_drag import FACES
from mjx_revolve.water.laws import (
    Drag,
    Export,
    PartDragLaw,
    PartFlow,
    PartShapes,
    law_numbers,
    part_field,
)
from mjx_revolve.water.plates import LiftDrag

if TYPE_CHECKING:
    from mjx_revolve.water.world import World

# What `slopes` casts: the coefficients of a plate.
_NAMES = ("a0", "cla", "cda", "alpha_stall", "cla_stall", "cda_stall", "cma", "cma_stall")
_BY_AREA = "lift, drag and moment are varied together, by `area`"
_SHAPE = "a direction or a place"


def _of_world(name: str) -> Callable[[World], float]:
    """The world's own plate stands in padding, so that what is the same in all parts folds."""
    return lambda world: float(getattr(world.lift_drag, name))


@law_numbers
class PlateNumbers:
    """Plates side by side: the fields of `LiftDrag`, and their drag against turning.

    Attributes:
        area: of the plate [m²].
        forward: unit vector of zero angle of attack.
        upward: unit vector of the upper surface.
        center: centre of pressure, from the box's centre [m].
        angular: of the faces' drag against turning about each axis [kg·m²]: no plate has one, and
            without it a free plate would spin up for ever.
    """

    a0: Any = part_field("rad", blank=_of_world("a0"), fixed=_BY_AREA)
    cla: Any = part_field("1/rad", blank=_of_world("cla"), fixed=_BY_AREA)
    cda: Any = part_field("1/rad", blank=_of_world("cda"), fixed=_BY_AREA)
    alpha_stall: Any = part_field("rad", blank=_of_world("alpha_stall"), fixed=_BY_AREA)
    cla_stall: Any = part_field("1/rad", blank=_of_world("cla_stall"), fixed=_BY_AREA)
    cda_stall: Any = part_field("1/rad", blank=_of_world("cda_stall"), fixed=_BY_AREA)
    cma: Any = part_field("m/rad", blank=_of_world("cma"), fixed=_BY_AREA)
    cma_stall: Any = part_field("m/rad", blank=_of_world("cma_stall"), fixed=_BY_AREA)
    radial_symmetry: Any = part_field("-", blank=_of_world("radial_symmetry"), fixed=_BY_AREA)
    density: Any = part_field("kg/m3", blank=lambda world: world.density, fixed=_BY_AREA)
    area: Any = part_field("m2", varied=("drag", "density"))
    forward: Any = part_field("-", axes="vector", blank=np.eye(3)[0], fixed=_SHAPE)
    upward: Any = part_field("-", axes="vector", blank=np.eye(3)[2], fixed=_SHAPE)
    center: Any = part_field("m", axes="vector", fixed=_SHAPE)
    angular: Any = part_field("kg m2", axes="size", varied=("drag", "density"))


def plate_numbers(
    plates: Sequence[LiftDrag],
    half_size: Float[np.ndarray, "n 3"],
    silhouette: Float[np.ndarray, "n 3"],
    angular: Float[np.ndarray, "n 3"],
    density: float,
) -> PlateNumbers:
    """Numbers of parts as plates, `[n]` or `[n, 3]` each.

    Args:
        plates: what each part's parameters say.
        half_size: half edges of the boxes [m].
        silhouette: area seen along each axis [m²]: where a plate gives none, it lies along the
            largest, with its chord along the longer of that face's edges.
        angular: see `PlateNumbers` [kg·m²].
        density: of the water, for plates that give none [kg/m³].
    """
    upward = silhouette.argmax(-1)
    forward = np.where(np.arange(3) == upward[:, None], -np.inf, half_size).argmax(-1)

    def given(name: str, usual: np.ndarray) -> np.ndarray:
        pairs = zip((getattr(plate, name) for plate in plates), usual, strict=True)
        return np.array([np.asarray(y if x is None else x, float) for x, y in pairs])

    return PlateNumbers(
        **{name: np.array([float(getattr(p, name)) for p in plates]) for name in _NAMES},
        radial_symmetry=np.array([p.radial_symmetry for p in plates], bool),
        density=given("density", np.full(len(plates), density)),
        area=given("area", silhouette.max(-1)),
        forward=given("forward", np.eye(3)[forward]),
        upward=given("upward", np.eye(3)[upward]),
        center=given("cp", np.zeros((len(plates), 3))),
        angular=angular,
    )


def slopes(p: LiftDrag | PlateNumbers, dtype: Any) -> Any:
    """The coefficients in the dtype of what they meet."""
    found = ((name, getattr(p, name)) for name in _NAMES)
    return {name: x if isinstance(x, jax.Array) else np.asarray(x, dtype) for name, x in found}


def wrapped(angle: Scalar) -> Scalar:
    """An angle of attack within ±90°: a plate works backwards, too."""
    return angle - np.pi * jnp.round(angle / np.pi)


def coefficients(
    alpha: Scalar, k: Mapping[str, Any], cos2_sweep: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """c_l, c_d and c_m at an angle of attack, as `lift_drag_wrench` has them."""
    before = jnp.minimum(jnp.abs(alpha), k["alpha_stall"])
    beyond = jnp.abs(alpha) - before
    stalled = jnp.maximum(k["cla"] * before + k["cla_stall"] * beyond, 0)
    lifting = jnp.where(beyond > 0, stalled, k["cla"] * before)
    side = jnp.sign(alpha)
    c_lift = side * lifting * cos2_sweep
    c_drag = jnp.abs((k["cda"] * before + k["cda_stall"] * beyond) * cos2_sweep)
    # Past the stall neither lift nor moment changes sign.
    turning = k["cma"] * before + k["cma_stall"] * beyond
    turning = jnp.where(k["cma"] > 0, jnp.maximum(turning, 0), turning)
    turning = jnp.where(k["cma"] < 0, jnp.minimum(turning, 0), turning)
    return c_lift, c_drag, side * turning * cos2_sweep


def lift_drag_wrench(
    v: Vec, forward: Vec, upward: Vec, area: Scalar, density: Scalar, p: LiftDrag | PlateNumbers
) -> tuple[Vec, Vec]:
    """Force and pitching moment of plates.

    With the flow's angle of attack α, a0 more than the angle from `forward` to a velocity below
    it, and the cosine c of the sweep angle: c_l = cla α c², c_d = |cda α c²|, c_m = cma α c² up to
    the stall; beyond it the slopes change to cla_stall and so on, and lift and moment stop at zero.
    α wraps to ±90°, so that the plate works backwards too. Lift is along n × v, drag against v,
    both seen in the plane across the span n = forward × upward; the moment is about n, nose up.
    Each is its coefficient times area times q = ½ ρ |v in that plane|².

    Args:
        v: velocity of the centre of pressure relative to the water [m/s].
        forward: unit vector of zero angle of attack.
        upward: unit vector of the upper surface.
        area: of the plate [m²].
        density: of the water [kg/m³], where p gives none.
        p: coefficients; each may be an array that broadcasts.

    Returns:
        Force [N] and moment [N·m] about the centre of pressure, in the frame of v.
    """
    density = density if p.density is None else p.density
    if is_present(p.radial_symmetry):
        radial = jnp.asarray(p.radial_symmetry, bool)
        # Upward is against the flow across the forward direction.
        along = dot(v, forward)
        across = tuple(sub(x, mul(along, f)) for x, f in zip(v, forward, strict=True))
        size = safe_norm(across)
        usual = radial & (size > 0)
        safe = jnp.where(usual, size, 1.0)
        upward = tuple(
            jnp.where(usual, -x / safe, mul(u, jnp.ones_like(safe)))
            for x, u in zip(across, upward, strict=True)
        )
    n = cross(forward, upward)
    spanwise = dot(v, n)
    plane = tuple(sub(x, mul(spanwise, y)) for x, y in zip(v, n, strict=True))
    speed = safe_norm(v)
    speed_in_plane = safe_norm(plane)
    k = slopes(p, speed.dtype)
    moving = speed_in_plane > 1e-9
    safe_speed = jnp.where(moving, speed_in_plane, 1.0)
    cos2_sweep = 1 - jnp.where(moving, spanwise / jnp.where(speed > 0, speed, 1.0), 0.0) ** 2
    x = jnp.where(moving, dot(plane, forward), 1.0)
    y = jnp.where(moving, neg(dot(plane, upward)), 0.0)
    alpha = wrapped(k["a0"] + jnp.arctan2(y, x))
    c_lift, c_drag, c_moment = coefficients(alpha, k, cos2_sweep)
    pressure = mul(0.5 * density, mul(area, speed_in_plane)) / safe_speed
    lift_direction = cross(n, plane)  # |n × plane| = |plane|
    force = tuple(
        pressure * speed_in_plane * (c_lift * up - c_drag * along)
        for up, along in zip(lift_direction, plane, strict=True)
    )
    if not (is_present(k["cma"]) or is_present(k["cma_stall"])):
        return force, (0.0, 0.0, 0.0)
    return force, vscale(pressure * speed_in_plane * speed_in_plane * c_moment, n)


def lift_drag(
    v: Vec, forward: Vec, upward: Vec, area: Scalar, density: Scalar, p: LiftDrag | PlateNumbers
) -> Vec:
    """The force of `lift_drag_wrench` alone [N]."""
    return lift_drag_wrench(v, forward, upward, area, density, p)[0]


def lift_drag_damping(
    v: Vec, forward: Vec, upward: Vec, area: Scalar, density: Scalar, p: LiftDrag | PlateNumbers
) -> Scalar:
    """How fast the force may fall with velocity, at most: what makes a step implicit.

    An upper estimate of the force's gradient, ρ A |v| (largest lift slope + largest drag slope). A
    step that adds dt times half of it to the inertia stays first order whatever the estimate (a
    W-method: Hairer & Wanner 1996, § IV.7), and is stable because the estimate is not too small.

    Args:
        v: velocity of the centre of pressure relative to the water [m/s].
        forward, upward: unused, so that both functions take the same.
        area: of the plate [m²].
        density: of the water [kg/m³], where p gives none.
        p: coefficients.

    Returns:
        Damping [N·s/m].
    """
    density = density if p.density is None else p.density
    speed = safe_norm(v)
    return mul(mul(density, area), _gradient(p, speed.dtype).astype(speed.dtype) * speed)


def _gradient(p: LiftDrag | PlateNumbers, dtype: Any) -> Any:
    """Largest lift slope and largest drag slope together, of forces over ρ A |v| [-]."""
    xp = jnp if isinstance(p.cla, jax.Array) else np
    k = {name: xp.abs(x) for name, x in slopes(p, dtype).items()}
    steepest = xp.maximum(k["cla"], k["cla_stall"])
    most = k["cda"] * k["alpha_stall"] + k["cda_stall"] * (np.pi / 2 - k["alpha_stall"])
    return steepest + xp.maximum(xp.maximum(k["cda"], k["cda_stall"]), 2 * most)


def _plates_of(parts: PartShapes, world: World) -> PlateNumbers:
    angular = FACES.numbers(parts, world).angular
    plates = parts.parameters["lift_drag"]
    return plate_numbers(plates, parts.half_size, parts.silhouette, angular, world.density)


def _plate_drag(flow: PartFlow, plate: PlateNumbers, world: World) -> Drag:
    v, w, submerged, _ = flow
    at = vadd(v, cross(w, plate.center))
    given = (plate.forward, plate.upward, plate.area, world.density, plate)
    force, torque = lift_drag_wrench(at, *given)
    torque = vadd(torque, cross(plate.center, force))
    # Half of the gradient: the step then takes the force in the middle of its velocities.
    half = mul(0.5, mul(lift_drag_damping(at, *given), submerged))
    return Drag(vscale(submerged, force), vscale(submerged, torque), (half, half, half))


LIFT_DRAG = PartDragLaw(
    name="lift_drag",
    summary="Gazebo's lift and drag of a plate",
    # 10: lift of 2π, and drag.
    steepest=lambda plate: np.maximum(10.0, _gradient(plate, float)) * plate.area,
    parameters=LiftDrag,
    numbers=_plates_of,
    force=_plate_drag,
    angular=lambda plate: plate.angular,
    mjcf=Export("inertia_box", FACES.mjcf.note, missing="fins: their lift and stall are left out"),
    sdf=Export(
        "lift_drag",
        note="LiftDrag lifts and drags the fins, Hydrodynamics brakes their turning",
        missing="the current at the fins: Gazebo's LiftDrag has the wind only",
    ),
)
