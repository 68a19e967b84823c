"""Linear feedback of depth and attitude."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mjx_revolve.control.controller import (
    Controller,
    Gene,
    GeneBlocks,
    StepOutput,
    as_plant,
    make_controller,
)
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.robot import Robot

# The features: names, and the size that counts as 1. Choices: an
# error of 0.2 m or of 0.2 rad, and the speeds at which it matters.
_FEEDBACK = (
    ("depth error", 0.2),
    ("climb", 0.1),
    ("roll", 0.2),
    ("pitch", 0.2),
    ("spin x", 0.5),
    ("spin y", 0.5),
    ("spin z", 0.5),
)

# Bias, gains by feature, middle and half range.
_Gains = tuple[jax.Array, tuple[jax.Array, ...], jax.Array, jax.Array]


def make_feedback(body: Plant | Robot, depth: float = 1.0, gain: float = 2.0) -> Controller:
    """Commands that are linear in depth and attitude, enough for an AUV to hold its depth.

    command_i = middle + half range × clip(sin(b_i) + gain Σ_k sin(W_ik) feature_k, -1, 1), with
    features depth error (core above `depth` counts positive) [0.2 m], vertical velocity [0.1 m/s],
    roll and pitch (the vertical's y and x in the core's frame) [0.2], and angular velocity about
    the core's three axes [0.5 rad/s], each divided by the size in brackets. Zero genes: all in
    the middle of its range.

    Args:
        body: a plant or a robot.
        depth: to hold, of the core's centre below the still surface [m].
        gain: share of half the range that a feature of size 1 may command at most [-].

    Returns:
        The controller; genes: a bias per actuator, then the gains, actuator by actuator.
    """
    made_for = as_plant(body)
    n, count = made_for.num_actuators, len(_FEEDBACK)
    biases = GeneBlocks(made_for, ("bias", "actuator")).genes
    genes = [*biases, *(Gene(f, *b[1:]) for b in biases for f, _ in _FEEDBACK)]

    def decode(genes: jax.Array, plant: Plant) -> _Gains:
        folded = jnp.sin(genes)
        weights = gain * folded[n:].reshape(n, count, *genes.shape[1:])
        rows = tuple(plant.arrange(weights[:, k]) for k in range(count))
        return plant.arrange(folded[:n]), rows, plant.middle(genes), plant.reach(genes)

    def step(
        parameters: _Gains, state: tuple[()], time: jax.Array, sense: SensorReadings
    ) -> StepOutput:
        bias, weights, center, reach = parameters
        level = sense.height + depth, sense.climb, sense.up[1], sense.up[0]
        found = (*level, *sense.angular_velocity)
        command = bias
        for weight, feature, (_, size) in zip(weights, found, _FEEDBACK, strict=True):
            command = command + weight * (feature / size)
        return state, center + reach * jnp.clip(command, -1, 1)

    return make_controller(made_for, genes, decode, lambda parameters: (), step)
