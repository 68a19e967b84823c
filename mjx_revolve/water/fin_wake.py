"""Fins with lift that lags behind their angle, and drag that follows from their lift.

Of the flow in the plane across the span, u along the chord and w across it, w where thin-airfoil
theory takes the incidence, at three quarters of the chord. A foil that changes its incidence sheds
vortices, which delay its lift (Wagner 1925); two numbers z of each fin are w as it was, each half
chord travelled apart:

    z_i' = b_i (2 V / c) (w - z_i),    w_e = (1 - A_1 - A_2) w + A_1 z_1 + A_2 z_2

with Wagner's function as 1 - A_1 e^(-b_1 s) - A_2 e^(-b_2 s), so that in a motion that repeats
w_e / w is Theodorsen's function. Slope and stall are those of the fin's `LiftDrag`, at the angle
α_e = atan w_e / u. The angle at which the flow is met is α.

Drag follows from that lift: with a rounded nose, the force is across the flow as the lagging wake
leaves it, C_L sin(α - α_e), and what trails from the tips costs C_L² / (π A e); with a sharp edge,
there is no suction, and the force is normal to the plate, C_L tan α. On top come friction and, past
the stall, what the fin has across the flow. Lift is across the velocity of the point where it acts,
and drag never below 0, so the water never works, but for a pitching moment (`cma`, Gazebo's):
energy that a wake gives back is left out.

It is stepped exactly for a velocity that holds for the step, depends on velocities through the
water only, and decays out of the water. Against turning a fin has its faces' drag (`lift_drag`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_revolve.numerics.lazy import jax, jnp
from mjx_revolve.numerics.spatial import (
    Scalar,
    Vec,
    add,
    cast,
    cross,
    dot,
    is_present,
    mul,
    neg,
    safe_norm,
    sub,
    total,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.coefficients import TODAY
from mjx_revolve.water.cross_flow import friction_share
from mjx_revolve.water.laws import (
    Coefficient,
    Drag,
    PartDragLaw,
    PartFlow,
    PartShapes,
    law_numbers,
    part_field,
)
from mjx_revolve.water.lift_drag import LIFT_DRAG, PlateNumbers, coefficients, slopes, wrapped

if TYPE_CHECKING:
    from mjx_revolve.water.world import World

_LAGS = tuple(
    (TODAY[f"wagner_{name}"].value, TODAY[f"wagner_{name}_rate"].value) for name in ("slow", "fast")
)
_BEHIND = TODAY["fin_incidence"].value - 0.5  # of the middle, in chords
_EFFICIENCY = TODAY["fin_efficiency"].value
# tan α stands for a force normal to the plate up to here; fins that stall later are no plates.
_STEEPEST = np.pi / 4
_SHAPE = "the robot's shape, which is known"
_BY_AREA = "lift, drag and friction are varied together, by `area`"


@law_numbers
class FinWakeNumbers(PlateNumbers):
    """Fins side by side: the numbers of `lift_drag`, and more.

    Attributes:
        chord: [m].
        induced: 1 / (π e A), A span over chord [-].
        suction: share of the suction of a rounded nose [-].
        friction: 2 a, of both faces [-].
        camber: tan a0 [-].
        steepest: tangent up to which a force normal to the plate is taken [-].
        flat: what drag grows by past the stall, up to that of `lift_drag` at 90° [1/rad].
        gradient: how fast the force may fall with velocity, over ρ area |v| [-].
    """

    chord: Any = part_field("m", blank=1.0, fixed=_SHAPE)
    induced: Any = part_field("-", fixed=_SHAPE)
    suction: Any = part_field("-", fixed="a nose is round or sharp")
    friction: Any = part_field("-", fixed=_BY_AREA)
    camber: Any = part_field("-", fixed=_BY_AREA)
    steepest: Any = part_field("-", fixed=_BY_AREA)
    flat: Any = part_field("1/rad", fixed=_BY_AREA)
    gradient: Any = part_field("-", fixed=_BY_AREA)


def _numbers(parts: PartShapes, world: World) -> FinWakeNumbers:
    plate = LIFT_DRAG.numbers(parts, world)
    chord = (np.abs(plate.forward) * 2 * parts.half_size).sum(-1)
    stall = plate.alpha_stall
    left = np.pi / 2 - stall
    across = np.abs(plate.cda * stall + plate.cda_stall * left)
    flat = np.divide(across, left, out=np.zeros_like(left), where=left > 1e-6)
    induced = chord**2 / (np.pi * _EFFICIENCY * np.maximum(plate.area, 1e-30))
    steepest = np.maximum(np.abs(plate.cla), np.abs(plate.cla_stall))
    most = np.abs(plate.cla) * stall
    tangent = np.tan(np.minimum(stall, _STEEPEST))
    own = steepest * (1 + tangent + 2 * most * induced)
    return FinWakeNumbers(
        **vars(plate),
        chord=chord,
        induced=induced,
        suction=parts.coefficients["nose_suction"],
        friction=2 * parts.coefficients["friction"],
        camber=np.tan(plate.a0),
        steepest=tangent,
        flat=flat,
        gradient=own + np.maximum(flat, 2 * across),
    )


def _flow_at(flow: PartFlow, fin: FinWakeNumbers, at: Vec) -> tuple[Vec, Scalar, Scalar]:
    """Velocity of a point, and how fast it goes along the chord and down across it."""
    v = vadd(flow.velocity, cross(flow.angular_velocity, at))
    return v, dot(v, fin.forward), neg(dot(v, fin.upward))


def _incidence(flow: PartFlow, fin: FinWakeNumbers) -> tuple[Scalar, Scalar]:
    """Speed of the fin's middle across its span, and w at three quarters of its chord."""
    _, u, w = _flow_at(flow, fin, (0.0, 0.0, 0.0))
    speed = safe_norm((u, w, 0.0))
    back = mul(mul(-_BEHIND, fin.chord), u / jnp.where(speed > 0, speed, 1))
    down = cross(flow.angular_velocity, vscale(back, fin.forward))
    return speed, sub(w, dot(down, fin.upward))


def _cast(fin: FinWakeNumbers, like: Any) -> FinWakeNumbers:
    """Constants in the dtype of what they meet."""
    return jax.tree.map(lambda x: cast(x, like), fin)


def _force(flow: PartFlow, fin: FinWakeNumbers, world: World) -> Drag:
    v, u, w = _flow_at(flow, fin, fin.center)
    speed, fin = safe_norm((u, w, 0.0)), _cast(fin, u)
    moving = speed > 1e-9
    safe = jnp.where(moving, speed, 1.0)
    ahead, down = jnp.where(moving, u, 1.0), jnp.where(moving, w, 0.0)
    felt = jnp.where(moving, _incidence(flow, fin)[1], 0.0)
    felt = felt + total(
        0.0, *[a * (z - felt) for (a, _), z in zip(_LAGS, flow.memory, strict=False)]
    )
    alpha = wrapped(fin.a0 + jnp.arctan2(felt, ahead))
    cos2_sweep = jnp.where(moving, (safe / jnp.where(moving, safe_norm(v), 1.0)) ** 2, 0.0)
    lift, _, moment = coefficients(alpha, slopes(fin, speed.dtype), cos2_sweep)
    # The tangent of the angle at which the flow is met has the period of `wrapped`.
    level = sub(ahead, mul(fin.camber, down))
    steep = add(down, mul(fin.camber, ahead)) / jnp.where(jnp.abs(level) > 1e-9, level, 1e-9)
    sharp = drag = lift * jnp.clip(steep, -fin.steepest, fin.steepest)
    if is_present(fin.suction):
        met = wrapped(fin.a0 + jnp.arctan2(down, ahead))
        rounded = lift * jnp.sin(met - alpha) + mul(fin.induced, lift * lift)
        drag = sharp + mul(fin.suction, rounded - sharp)
    drag = jnp.maximum(drag, 0)
    drag = drag + mul(fin.flat, cos2_sweep * jnp.maximum(jnp.abs(alpha) - fin.alpha_stall, 0))
    drag = drag + mul(fin.friction, friction_share(speed, fin.chord, world))
    pressure = mul(mul(mul(0.5, mul(fin.density, fin.area)), flow.submerged), speed)
    n = cross(fin.forward, fin.upward)
    plane = vsub(vscale(u, fin.forward), vscale(w, fin.upward))
    force = vsub(vscale(mul(pressure, lift), cross(n, plane)), vscale(mul(pressure, drag), plane))
    torque = vadd(cross(fin.center, force), vscale(mul(mul(pressure, speed), moment), n))
    # As in `lift_drag`: half of an upper estimate of the gradient.
    half = mul(pressure, fin.gradient)
    return Drag(force, torque, (half, half, half))


def _remember(flow: PartFlow, fin: FinWakeNumbers, world: World, dt: float) -> tuple[Scalar, ...]:
    fin = _cast(fin, flow.memory[0])
    speed, w = _incidence(flow, fin)
    w, half_chords = jnp.where(flow.submerged > 0, w, 0), mul(2 * dt / fin.chord, speed)
    pairs = zip(_LAGS, flow.memory, strict=True)
    return tuple(w + (z - w) * jnp.exp(-rate * half_chords) for (_, rate), z in pairs)


FIN_WAKE = PartDragLaw(
    name="fin_wake",
    summary="lift_drag with a lag of the lift, and drag that follows from it",
    steepest=lambda fin: fin.gradient * fin.area,
    coefficients=(
        Coefficient(
            "nose_suction",
            "-",
            "suction at a fin's leading edge: 1 of a rounded nose, 0 of a sharp edge",
            0.0,
            high=1.0,
        ),
    ),
    numbers=_numbers,
    force=_force,
    angular=LIFT_DRAG.angular,
    memory=len(_LAGS),
    remember=_remember,
    mjcf=LIFT_DRAG.mjcf,
    sdf=LIFT_DRAG.sdf._replace(missing=f"{LIFT_DRAG.sdf.missing}; that lift lags"),
)
