"""The water's own motion: current, shear, a field on a grid, gusts and waves, added up.

Velocities are in the world frame. What a world does not have costs nothing: plain numbers stay
Python floats and fold away while a step is traced.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.numerics.spatial import (
    Scalar,
    Vec,
    add,
    mul,
    sincos,
    sub,
    symvec,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.currents import CurrentField, Gust, Shear, Wave
from mjx_revolve.water.world import World


class Water(NamedTuple):
    """What may differ between individuals, episodes or moments of one compiled program.

    Attributes:
        surface_height: z of the still surface, world frame [m], scalar or `[lanes]`.
        current: uniform part of the water's velocity, gusts included, world frame [m/s], three of
            the same.
        acceleration: of that part [m/s²], three of the same.
        time: for the waves [s].
    """

    surface_height: Scalar
    current: Vec
    acceleration: Vec = (0.0, 0.0, 0.0)
    time: Scalar = 0.0


def water_of(world: World) -> Water:
    """The world's own still surface and uniform current."""
    return Water(world.surface_height, tuple(world.current))


def is_uniform(world: World) -> bool:
    """Whether the water's velocity is the same everywhere."""
    return world.shear is None and world.current_field is None and not world.waves


def drift_speed(world: World) -> float:
    """A speed that the water carries things with at most, anywhere [m/s].

    Gusts count with four standard deviations. Waves do not: their water goes round.
    """
    steady = [np.linalg.norm(world.current)]
    if world.shear is not None:
        steady.append(np.linalg.norm(world.shear.velocity))
    if world.current_field is not None:
        steady.append(np.linalg.norm(world.current_field.velocity, axis=-1).max())
    if world.gust is not None:
        steady.append(4 * np.linalg.norm(world.gust.std))
    return float(sum(steady))


def needs_horizontal_position(world: World) -> bool:
    """Whether a step must know where its bodies are, horizontally."""
    return not is_uniform(world)


def _running(world: World) -> tuple[Wave, ...]:
    """The waves that have a height."""
    return tuple(wave for wave in world.waves if wave.amplitude > 0)


def _towards(wave: Wave) -> tuple[float, float]:
    """Its direction's x and y; along an axis, the other one is 0 and folds away."""
    c, s = math.cos(wave.direction), math.sin(wave.direction)
    return (c if abs(c) > 1e-15 else 0.0, s if abs(s) > 1e-15 else 0.0)


def _phase(world: World, wave: Wave, water: Water, x: Scalar, y: Scalar) -> tuple[Any, Any]:
    """Sine and cosine of k·x - ωt + φ."""
    k, (c, s) = wave.wavenumber(world.gravity, world.water_depth), _towards(wave)
    # The world's current carries the waves along.
    along = k * (c * world.current[0] + s * world.current[1])
    turning = wave.frequency(world.gravity, world.water_depth) + along
    angle = add(add(mul(k * c, x), mul(k * s, y)), sub(wave.phase, mul(turning, water.time)))
    return sincos(jnp.asarray(angle))


def surface(world: World, water: Water, x: Scalar, y: Scalar) -> tuple[Scalar, Any]:
    """Height of the surface, and its gradient.

    Args:
        world: with its waves.
        water: still surface and time.
        x: world x [m], any shape.
        y: world y [m], same shape.

    Returns:
        Height [m], and (∂η/∂x, ∂η/∂y) [-], or None where the surface is flat.
    """
    waves = _running(world)
    if not waves:
        return water.surface_height, None
    height, gradient = water.surface_height, (0.0, 0.0)
    for wave in waves:
        k = wave.wavenumber(world.gravity, world.water_depth)
        sine, cosine = _phase(world, wave, water, x, y)
        height = add(height, mul(wave.amplitude, cosine))
        gradient = vadd(gradient, [mul(-wave.amplitude * k * c, sine) for c in _towards(wave)])
    return height, gradient


def flow(world: World, water: Water, x: Scalar, y: Scalar, z: Scalar) -> tuple[Vec, Vec]:
    """Velocity and acceleration of the water at places: all that moves it, added up.

    Acceleration is that of the uniform current, and of the waves as `wave_flow` has it: ∂u/∂t. The
    step adds the waves' own u·∇u (`wave_convection`); what a steady shear or field does to water
    that passes through it is of second order in velocities that are small, and left out.

    Args:
        world: what moves its water.
        water: surface, uniform current, time.
        x: world x [m], any shape.
        y: world y [m], same shape.
        z: world z [m], same shape.

    Returns:
        Velocity [m/s] and acceleration [m/s²], world frame; components that are 0 everywhere are
        plain zeros.
    """
    velocity, acceleration = tuple(water.current), tuple(water.acceleration)
    if world.shear is not None:
        velocity = vadd(velocity, shear_flow(world.shear, sub(water.surface_height, z)))
    if world.current_field is not None:
        velocity = vadd(velocity, field_flow(world.current_field, x, y, z))
    for wave in _running(world):
        u, a = wave_flow(world, wave, water, x, y, z)
        velocity, acceleration = vadd(velocity, u), vadd(acceleration, a)
    return velocity, acceleration


def shear_flow(shear: Shear, depth: Scalar) -> Vec:
    """A current that fades with depth, u(d) = u₀ f(d / D), on top of the uniform one.

    - "linear": f = 1 - d/D down to D, 0 below.
    - "power": f = (1 - d/D)ⁿ down to D; n = 1/7 is the common law of tidal streams above a bed at D
      (Soulsby 1997, Dynamics of Marine Sands, § 3.3).
    - "exponential": f = e^(-d/D), as drift under wind fades.

    Above the still surface f is 1: there is water only in crests.

    Args:
        shear: u₀, D, n and the profile.
        depth: d below the still surface [m].

    Returns:
        Velocity [m/s].
    """
    share = jnp.maximum(depth, 0) / shear.depth
    if shear.profile == "exponential":
        profile = jnp.exp(-share)
    elif shear.profile == "linear":
        profile = jnp.maximum(1 - share, 0)
    else:
        # The inner `where` keeps the power's infinite gradient at D out of the backward pass.
        inside = share < 1
        left = jnp.where(inside, 1 - share, 1)
        profile = jnp.where(inside, left**shear.exponent, 0)
    return vscale(profile, shear.velocity)


def _cell(axis: np.ndarray, at: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Between which planes of a grid places lie: the first one's number, and the share beyond."""
    last = len(axis) - 2
    knots = axis.astype(at.dtype)
    step = (axis[-1] - axis[0]) / (last + 1)
    even = np.linspace(axis[0], axis[-1], last + 2)
    if np.abs(axis - even).max() < 1e-6 * step:
        planes = (at - knots[0]) * (1 / step).astype(at.dtype)
        cell = jnp.clip(jnp.floor(planes), 0, last)
        return cell.astype(jnp.int32), jnp.clip(planes - cell, 0, 1)
    # By halves: a search that XLA can put inside the step's loop.
    cell = jnp.zeros(at.shape, jnp.int32)
    for bit in reversed(range(last.bit_length())):
        next_cell = cell + 2**bit
        far = _pick(knots, jnp.minimum(next_cell, last))
        cell = jnp.where((next_cell <= last) & (at >= far), next_cell, cell)
    widths = (1 / np.diff(axis)).astype(at.dtype)
    return cell, jnp.clip((at - _pick(knots, cell)) * _pick(widths, cell), 0, 1)


def _pick(table: np.ndarray, index: jax.Array) -> jax.Array:
    """Entries of a constant; the index lies inside, so nothing need be checked."""
    return jnp.asarray(table).at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def field_flow(field: CurrentField, x: Scalar, y: Scalar, z: Scalar) -> Vec:
    """Velocity on a grid, interpolated linearly along each axis and held constant beyond its edges.

    Continuous, and exact for velocities that are linear in each coordinate; its gradient jumps at
    the grid's planes. An axis with a single plane does not matter.

    Args:
        field: axes, world frame, and velocities.
        x: world x [m], any shape.
        y: world y [m], same shape.
        z: world z [m], same shape.

    Returns:
        Velocity [m/s]; a component that is 0 everywhere is a plain 0.
    """
    places = jnp.broadcast_arrays(*(jnp.asarray(p, jnp.result_type(float, p)) for p in (x, y, z)))
    dtype = jnp.result_type(*places)
    shape = field.velocity.shape[:3]
    strides = (shape[1] * shape[2], shape[2], 1)
    start: Any = 0
    # Of the axes that matter: how far to the next plane in the table, and the share.
    spans: list[tuple[int, Any]] = []
    for axis, at, stride in zip((field.x, field.y, field.z), places, strides, strict=True):
        if len(axis) > 1:
            cell, share = _cell(axis, at.astype(dtype))
            start, spans = start + cell * stride, [*spans, (stride, share)]
    index = jnp.broadcast_to(jnp.asarray(start, jnp.int32), places[0].shape)

    def between(table: np.ndarray, index: jax.Array, spans: Sequence[tuple[int, Any]]) -> jax.Array:
        if not spans:
            return _pick(table, index)
        (stride, share), *rest = spans
        here, there = between(table, index, rest), between(table, index + stride, rest)
        return here + share * (there - here)

    tables = [field.velocity[..., i].reshape(-1).astype(dtype) for i in range(3)]
    return tuple(between(table, index, spans) if table.any() else 0.0 for table in tables)


def wave_flow(
    world: World, wave: Wave, water: Water, x: Scalar, y: Scalar, z: Scalar
) -> tuple[Vec, Vec]:
    """Orbital velocity of one wave, and its acceleration.

    Linear (Airy) theory, Dean & Dalrymple 1991, Water Wave Mechanics for Engineers and Scientists,
    § 4.2: with θ = k·x - ωt + φ, ω² = g k tanh(k h) and s the height above the bed,

        u = a ω cosh(k s) / sinh(k h) cos θ along the wave, w = a ω sinh(k s) / sinh(k h) sin θ,

    in deep water both with e^(kz) for the ratio. Below the still surface the velocity has a
    potential and no divergence; above it the values at it hold, below the bed those at the bed.
    Valid while waves are low (k a ≪ 1; for long ones also a/h ≪ (k h)²): no drift of the mean, no
    sharper crests, no breaking, no change by the body (nothing is diffracted), and a bed that is
    level, whatever the world's is.

    The world's uniform current U carries the waves, so θ runs at ω + k·U at a fixed place; the
    acceleration is that of the water itself, (∂/∂t + U·∇) u. Shear, field and gusts carry no waves.

    Args:
        world: gravity, water depth and current.
        wave: the wave.
        water: still surface and time.
        x: world x [m], any shape.
        y: world y [m], same shape.
        z: world z [m], same shape.

    Returns:
        Velocity [m/s] and acceleration [m/s²], world frame.
    """
    (c, s), omega = _towards(wave), wave.frequency(world.gravity, world.water_depth)
    sine, cosine = _phase(world, wave, water, x, y)
    along, upright = _fading(world, wave, water, z)
    speed = wave.amplitude * omega
    u, w = speed * along * cosine, speed * upright * sine
    du, dw = speed * omega * along * sine, -speed * omega * upright * cosine
    return (mul(c, u), mul(s, u), w), (mul(c, du), mul(s, du), dw)


def _fading(world: World, wave: Wave, water: Water, z: Scalar) -> tuple[Scalar, Scalar]:
    """How orbital velocity along the wave and upright has faded at a height [-]."""
    h = world.water_depth
    k = wave.wavenumber(world.gravity, h)
    below = jnp.minimum(sub(z, water.surface_height), 0)
    if h is None:
        fade = jnp.exp(k * below)
        return fade, fade
    # cosh(k(z + h)) / sinh(kh) and the same with sinh, without large numbers.
    below = jnp.maximum(below, -h)
    whole = -1 / math.expm1(-2 * k * h)
    fade, mirrored = jnp.exp(k * below), jnp.exp(-k * (below + 2 * h))
    return whole * (fade + mirrored), whole * (fade - mirrored)


def wave_convection(world: World, water: Water, x: Scalar, y: Scalar, z: Scalar) -> Vec:
    """u·∇ of the waves' orbital velocity: what water accelerates by because it moves on.

    u is all that moves the water but the level part of the world's current, which carries the
    waves: `wave_flow` has what follows from that. Waves fade with depth, so rising water meets
    others.

    Above the still surface it is the value at the still surface.
    Of second order in the waves' steepness, like the drift that it keeps away: without it a neutral
    body would sink while it goes round.

    Args:
        world: with its waves.
        water: still surface and time.
        x: world x [m], any shape.
        y: world y [m], same shape.
        z: world z [m], same shape.

    Returns:
        Acceleration [m/s²], world frame.
    """
    rest = water._replace(current=vsub(water.current, (*world.current[:2], 0.0)))
    velocity, _ = flow(world, rest, x, y, z)
    gradient: list[Scalar] = [0.0] * 6  # ∇u is symmetric, as u has a potential: xx xy xz yy yz zz
    for wave in _running(world):
        (c, s), omega = _towards(wave), wave.frequency(world.gravity, world.water_depth)
        sine, cosine = _phase(world, wave, water, x, y)
        along, upright = _fading(world, wave, water, z)
        rate = wave.wavenumber(world.gravity, world.water_depth) * wave.amplitude * omega
        level, tilt = rate * along * sine, rate * upright * cosine
        terms = (-c * c * level, -c * s * level, c * tilt, -s * s * level, s * tilt, level)
        gradient = [add(a, b) for a, b in zip(gradient, terms, strict=True)]
    return symvec(tuple(gradient), velocity)


def gust_path(gust: Gust, key: jax.Array, steps: int, dt: float, trials: int) -> jax.Array:
    """Paths of a current that wanders and returns: an Ornstein-Uhlenbeck process, stepped exactly.

    u ← u e^(-dt/T) + σ √(1 - e^(-2dt/T)) N(0, 1), begun from its stationary distribution: mean 0,
    standard deviation σ and correlation e^(-t/T), whatever the time step (Gillespie 1996, Physical
    Review E 54, 2084). Such a path is continuous but not differentiable: its steps divided by dt
    grow as 1/√dt, though the momentum that they give does not.

    Args:
        gust: σ and T.
        key: draws the path. The same key and steps of the same dt give the same path, and a longer
            one begins with it.
        steps: how many.
        dt: of a step [s].
        trials: how many paths.

    Returns:
        `[steps + 1, 3, trials]` velocity around the mean current [m/s].
    """
    kept = math.exp(-dt / gust.time)
    fresh = math.sqrt(-math.expm1(-2 * dt / gust.time))
    noise = jax.random.normal(key, (steps + 1, 3, trials))

    def step(u: jax.Array, n: jax.Array) -> tuple[jax.Array, jax.Array]:
        u = kept * u + fresh * n
        return u, u

    _, path = jax.lax.scan(step, noise[0], noise[1:])
    std = jnp.asarray(gust.std, noise.dtype)[:, None]
    return std * jnp.concatenate([noise[:1], path])
