"""Servos and end stops of the hinges: torques, and what an implicit step adds to the inertia."""

from __future__ import annotations

import jax.numpy as jnp

from mjx_revolve.engine.level import Hinges
from mjx_revolve.numerics.spatial import Scalar, add, cast, mul, sub
from mjx_revolve.water.drag import is_extrapolated
from mjx_revolve.water.world import World

# Ratio of the end stops' damper to their spring [s]. A choice: a leg arrives over-damped.
STOP_TIME = 0.005
# A hinge counts as near its top speed where eight times the gain in speed that is foreseen for the
# step would bring it there: servos that push each other on make more of it than each by itself. A
# choice: where all servos of random bodies reverse at once, 2 leaves spikes of 3.5 times the top
# speed, 4 of 2.2; 8 and 16 give the same, what the others' pushes make of it in small steps, too.
# It costs accuracy where a gait jerks, as hinges then lag behind their commands for a step or two.
_MARGIN = 8.0
# Numerical damping γ of springs that are too stiff for an explicit step (Newmark 1959): they act on
# q + γ dt q̇ + (1 + γ)²/4 dt² q̈. 0 is the trapezoidal rule, which lets them ring, 1 the angle at the
# end of the step, by which joints lag. A choice: what it has no time for falls to two thirds in a
# step. Drag that is extrapolated explicitly feeds what rings: there it dies at once.
_SPRING_DAMPING, _EXTRAPOLATED = 0.2, 1.0
_TINY = 1e-12  # [N·m]


def spring_damping(world: World) -> float:
    """Numerical damping γ in a world of springs that are too stiff for an explicit step [-]."""
    return _EXTRAPOLATED if is_extrapolated(world.drag) else _SPRING_DAMPING


def servo(
    hinges: Hinges,
    angle: Scalar,
    speed: Scalar,
    target: Scalar,
    dt: float,
    inertia: Scalar,
    load: Scalar,
    damped: float = _SPRING_DAMPING,
) -> tuple[Scalar, Scalar]:
    """Torque of the position servos, and what an implicit step adds to the joints' inertia.

    MuJoCo's position actuator, clip(k_p (target - q), ± effort), on a motor with limited current:
    full effort up to three quarters of its top speed w, from there a line that equals the joint's
    friction d q̇ at the top speed,

        τ ≤ d w + k (w - q̇),   k = (effort - d w) / (w / 4),

    and the same backwards. Below the knee it is stock MuJoCo. A light limb goes from rest to its
    top speed within one step, so the curve is taken at the speed at the end of the step: on the
    line, the line itself; below it, where the step may lead onto it, the chord from here to the
    top speed, which lies below the curve, so that no push, however the hinges are coupled, drives
    a hinge past its top speed; elsewhere the push is constant. Of a spring that is too stiff for an
    explicit step, a part acts in the middle of the steps before and after instead,
    linearly implicit (`spring_damping`).

    Args:
        hinges: their numbers.
        angle: q `[nbody, lanes]` [rad].
        speed: q̇ `[nbody, lanes]` [rad/s].
        target: `[nbody, lanes]` [rad].
        dt: for which the line is implicit [s]; 0 for none.
        inertia: that the hinge moves, its parent held still, with all that is implicit [kg·m²].
        load: torque of all but the motor and the end stops [N·m].
        damped: `spring_damping` of the world [-].

    Returns:
        Torque [N·m] and inertia [kg·m²], `[nbody, lanes]`.
    """
    target = jnp.clip(target, cast(hinges.target[0], target), cast(hinges.target[1], target))
    torque = sub(mul(hinges.gain, target), mul(hinges.stiffness, angle))
    damping = add(hinges.servo_damping, mul(damped * dt, hinges.implicit_stiffness))
    torque = sub(torque, mul(damping, speed))
    low, high = (cast(x, torque) for x in hinges.effort)
    # At its limit, torque does not depend on the angle, but the step may lead back below: the
    # secant of the limited spring. With none of it, light limbs swing from limit to limit for ever.
    square = jnp.asarray((1 + damped) ** 2 / 4 * dt * dt, torque.dtype)
    limit = jnp.maximum(jnp.where(torque > 0, high, -low), 0)
    share = jnp.minimum(limit / jnp.maximum(jnp.abs(torque), _TINY), 1)
    yielding = mul(square * share, hinges.implicit_stiffness)
    torque = jnp.clip(torque, low, high)
    friction, gradient, top = (cast(x, torque) for x in hinges.motor)
    forward = jnp.sign(torque)
    rate, push = forward * speed, jnp.abs(torque)

    def line(x: Scalar) -> Scalar:
        return friction + gradient * (top - x)

    # The motor turns its base, too, the other way.
    per_base = dt / cast(hinges.base_inertia, torque)
    foreseen = (push + jnp.maximum(forward * load, 0)) / add(inertia, yielding)
    gain = dt * foreseen + per_base * push
    beyond = line(rate) < push
    # A push that friction outweighs needs no limit, and has no chord at the top speed itself.
    near = (line(rate + _MARGIN * gain) < push) & ~beyond & (push > friction)
    chord = (push - friction) / jnp.where(near, top - rate, 1)
    torque = jnp.where(beyond, forward * line(rate), torque)
    # Of curve and spring, the one that falls faster with the speed at the end of the step.
    implicit = dt * jnp.where(beyond, gradient, jnp.where(near, chord, 0))
    return torque, jnp.maximum(implicit, yielding)


def motor_torque(
    hinges: Hinges,
    angle: Scalar,
    speed: Scalar,
    target: Scalar,
    dt: float = 0.0,
    damped: float = _SPRING_DAMPING,
) -> Scalar:
    """Torque of the motors now, not what an implicit step makes of it, without joints' friction.

    Args:
        hinges: their numbers.
        angle: `[nbody, lanes]` [rad].
        speed: of the joints [rad/s].
        target: of the servos [rad].
        dt: since the angle was so, for what is taken at the end of a step [s].
        damped: `spring_damping` of the world [-].

    Returns:
        The torque [N·m].
    """
    return own_torque(hinges, servo(hinges, angle, speed, target, dt, 1.0, 0.0, damped)[0])


def own_torque(hinges: Hinges, torque: Scalar) -> Scalar:
    """That of the motors: `servo`'s brakes beyond the top speed, with more than their effort."""
    return jnp.clip(torque, *(cast(x, torque) for x in hinges.effort))


def end_stop(
    hinges: Hinges, angle: Scalar, speed: Scalar, dt: float, gain: Scalar = 0.0
) -> tuple[Scalar, Scalar]:
    """Torque of the joint's end stops, and what an implicit step adds to the joint's inertia.

    A spring with a damper, both of which act on angle and speed at the end of the step: linearly
    implicit, so stable at any stiffness (cf. MuJoCo's soft limit constraint, which it stands in
    for). The damper lets go within `STOP_TIME`: hinges arrive and stay, they do not bounce.
    Whether a hinge is at its end is decided with the speed that it gains within the step: without,
    what is pressed there loses the stop, and trembles.

    Args:
        hinges: their numbers.
        angle: q `[nbody, lanes]` [rad].
        speed: q̇ `[nbody, lanes]` [rad/s].
        dt: for which it is implicit [s]; 0 for none.
        gain: of speed within the step without stops [rad/s].

    Returns:
        Torque [N·m] and inertia [kg·m²], `[nbody, lanes]`.
    """
    low, high = (cast(x, angle) for x in hinges.range)
    ahead = angle + dt * speed
    over = jnp.maximum(ahead - high, 0) - jnp.maximum(low - ahead, 0)
    soon = ahead + dt * gain
    at_end = (soon > high) | (soon < low)
    stop = cast(hinges.stop, angle)
    # The damper never holds a hinge that swings back.
    outward = jnp.where(over * speed > 0, speed, 0)
    torque = jnp.where(at_end, -stop * (over + STOP_TIME * outward), 0)
    stiff = jnp.where(over * speed > 0, dt + STOP_TIME, dt)
    return torque, jnp.where(at_end, dt * stop * stiff, jnp.zeros_like(angle))
