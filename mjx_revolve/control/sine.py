"""Sums of sines: one for each hinge or thruster, at a frequency shared by all."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.control.controller import (
    Controller,
    Gene,
    as_plant,
    fade_in,
    make_controller,
    of_actuators,
)
from mjx_revolve.control.sense import Sense
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.robot import Robot
from mjx_revolve.numerics.spatial import safe_norm, sincos


def make_sine(
    body: Plant | Robot, max_frequency: float = 2.0, amplitude: float = 1.0, harmonics: int = 1
) -> Controller:
    """One sine per hinge or thruster: amplitude, phase and offset, and a frequency shared by all.

    target_i = offset_i + Σ_k a_ik sin(2π k f t + φ_ik), k = 1 … harmonics. One harmonic is the
    plain sine; with more, a stroke and its return may differ in speed, which is what rowing needs.
    Amplitude and phase are evolved as a point in the plane, (u, v): a = amplitude × half range ×
    sin|(u, v)| / k, φ its angle; so there is no seam at φ = ±π where optimisers get lost, and no
    amplitude without a sign. Offset = half of half range × sin(gene), f = f_max (1 + sin(gene)) /
    2. The servo's range clips the sum. Amplitudes and offsets fade in over the first half second,
    so that no joint jumps at the start.

    Args:
        body: whose hinges and thrusters are driven: a plant or a robot.
        max_frequency: upper end of f [Hz].
        amplitude: share of the hinges' range used [-].
        harmonics: how many sines are added up [-].

    Returns:
        The controller; genes: u and v of the first harmonic (one per hinge each), of the second and
        so on, offsets, then the frequency.
    """
    made_for = as_plant(body)
    n = made_for.num_actuators
    waves = [f"{x}{k + 1 if k else ''}" for k in range(harmonics) for x in "uv"]
    genes = (*of_actuators(made_for, *waves, "offset"), Gene("frequency", "robot"))

    def decode(genes: jax.Array, plant: Plant) -> Any:
        rows = [plant.arrange(genes[k * n : (k + 1) * n]) for k in range(2 * harmonics + 1)]
        reach, center = amplitude * plant.reach(genes), plant.middle(genes)
        return _decode(rows, genes[-1:], reach, center, max_frequency)

    return make_controller(made_for, genes, decode, lambda parameters: (), _step)


def _decode(
    rows: list[jax.Array],
    frequency: jax.Array,
    reach: jax.Array,
    center: jax.Array,
    max_frequency: float,
) -> Any:
    """Parameters of the sines from rows of u, v of each harmonic, then offsets, `[n, lanes]`."""
    rate = 2 * np.pi * max_frequency * (1 + jnp.sin(frequency)) / 2
    sizes = []
    for k in range(len(rows) // 2):
        u, v = rows[2 * k], rows[2 * k + 1]
        size = safe_norm((u, v))
        # sin(r) / r, and its limit where r = 0.
        fold = jnp.where(size > 1e-6, jnp.sin(size) / jnp.maximum(size, 1e-6), 1.0)
        scale = reach * fold / (k + 1)
        sizes.append((scale * u, scale * v))
    return tuple(sizes), 0.5 * reach * jnp.sin(rows[-1]), rate, center


def _step(parameters: Any, state: Any, time: jax.Array, sense: Sense) -> tuple[Any, jax.Array]:
    """The step of a `Controller` made of sines."""
    sizes, offset, rate, center = parameters
    fade, wave = fade_in(time), offset
    for k, (u, v) in enumerate(sizes):
        sine, cosine = sincos((k + 1) * rate * time)
        wave = wave + u * sine + v * cosine
    return state, center + fade * wave
