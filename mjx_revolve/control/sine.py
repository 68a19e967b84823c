"""Sums of sines: one for each hinge or thruster, at a frequency shared by all."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.control.controller import (
    Controller,
    GeneBlocks,
    StepOutput,
    as_plant,
    fade_in,
    make_controller,
)
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.robot import Robot
from mjx_revolve.numerics.spatial import safe_norm, sincos

_Sizes = tuple[tuple[jax.Array, jax.Array], ...]  # sine and cosine of each harmonic
_Waves = tuple[_Sizes, jax.Array, jax.Array, jax.Array]  # and offset, frequency, middle


def make_sine(
    body: Plant | Robot, max_frequency: float = 2.0, amplitude: float = 1.0, harmonics: int = 1
) -> Controller:
    """One sine per hinge or thruster: amplitude, phase and offset, and a frequency shared by all.

    target_i = middle_i + offset_i + Σ_k a_ik sin(2π k f t + φ_ik), k = 1 … harmonics. One harmonic
    is the plain sine; with more, the power stroke and the recovery stroke may differ in speed, as
    in rowing. Amplitude and phase are evolved as a point in the plane, (u, v): a = amplitude × half
    range × sin|(u, v)| / k, φ its angle; so the map has no discontinuity at φ = ±π. Offset =
    amplitude × half of half range × sin(gene), f = f_max (1 + sin(gene)) / 2. The servo's range
    clips the sum. Amplitudes and offsets fade in over the first half second, so that no joint jumps
    at the start.

    Args:
        body: a plant or a robot.
        max_frequency: upper end of f [Hz].
        amplitude: share of the hinges' range used [-].
        harmonics: number of sines that are added up [-].

    Returns:
        The controller; genes: u and v of the first harmonic (one per hinge each), of the second and
        so on, offsets, then the frequency.
    """
    made_for = as_plant(body)
    names = [(f"u{k or ''}", f"v{k or ''}") for k in (0, *range(2, harmonics + 1))]
    waves = [(name, "actuator") for pair in names for name in pair]
    blocks = GeneBlocks(made_for, *waves, ("offset", "actuator"), ("frequency", "robot"))

    def decode(genes: jax.Array, plant: Plant) -> _Waves:
        values = blocks.split(genes, plant)
        reach, center = amplitude * plant.reach(genes), plant.middle(genes)
        rate = 2 * np.pi * max_frequency * (1 + jnp.sin(values["frequency"])) / 2
        sizes = []
        for k, (u, v) in enumerate((values[a], values[b]) for a, b in names):
            size = safe_norm((u, v))
            # sin(r) / r, and its limit where r = 0.
            fold = jnp.where(size > 1e-6, jnp.sin(size) / jnp.maximum(size, 1e-6), 1.0)
            scale = reach * fold / (k + 1)
            sizes.append((scale * u, scale * v))
        return tuple(sizes), 0.5 * reach * jnp.sin(values["offset"]), rate, center

    return make_controller(made_for, blocks.genes, decode, lambda parameters: (), _step)


def _step(
    parameters: _Waves, state: tuple[()], time: jax.Array, sense: SensorReadings
) -> StepOutput:
    """The step of a `Controller` made of sines."""
    sizes, offset, rate, center = parameters
    fade, wave = fade_in(time), center + offset
    for k, (u, v) in enumerate(sizes):
        sine, cosine = sincos((k + 1) * rate * time)
        wave = wave + u * sine + v * cosine
    return state, fade * wave
