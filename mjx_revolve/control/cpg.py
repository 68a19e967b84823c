"""Revolve's differential CPG: coupled oscillators, one for each hinge."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.control.controller import (
    Controller,
    GeneBlocks,
    StepOutput,
    as_plant,
    make_controller,
)
from mjx_revolve.control.neighbours import NeighbourMatrix, pair_matrix
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.robot import Robot


def make_cpg(body: Plant | Robot, max_frequency: float = 2.0, amplitude: float = 1.0) -> Controller:
    """Revolve's differential CPG: one oscillator pair per hinge, neighbours coupled.

    ẋ_i = w_i y_i + Σ_j c_ij x_j,  ẏ_i = -w_i x_i,  c_ij = -c_ji for hinges that share a rigid link
    (Lan et al. 2021, Learning locomotion skills in evolvable robots, Neurocomputing 452). The
    system matrix is antisymmetric, so Σ x² + y² is constant. Target of hinge i: amplitude × half
    range × tanh(x_i), from the middle of its range. It starts at x = 0, y = 1: with all weights
    zero nothing ever moves. Integrated by the classical Runge-Kutta method at the physics' step.
    Thrusters have no neighbours: each runs at a constant command, half range × sin(gene).

    Genes: one w per hinge, then one c per pair of neighbours, then one command per thruster;
    w = 2π f_max sin(gene), c = π f_max sin(gene).

    Args:
        body: a plant or a robot.
        max_frequency: of an uncoupled oscillator [Hz].
        amplitude: share of the hinges' range used [-].
    """
    made_for = as_plant(body)
    dt = made_for.timestep
    blocks = GeneBlocks(made_for, ("w", "hinge"), ("c", "pair"), ("thrust", "thruster"))

    def decode(genes: jax.Array, plant: Plant) -> Any:
        values, rows = blocks.split(jnp.sin(genes), plant), plant.num_hinge_rows
        weights = np.pi * max_frequency * values["c"]
        coupling = pair_matrix(weights, -weights, plant)
        middle, reach = plant.middle(genes), plant.reach(genes)
        w = 2 * np.pi * max_frequency * values["w"]
        constant = middle[rows:] + reach[rows:] * values["thrust"]
        return w, coupling, amplitude * reach[:rows], middle[:rows], constant

    def derivative(
        w: jax.Array, c: NeighbourMatrix, x: jax.Array, y: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        coupled = w * y
        for j, column in c.items():  # written out: no reductions inside the compiled loop
            coupled = coupled + column * x[j : j + 1]
        return coupled, -w * x

    def init(parameters: Any) -> Any:
        w = parameters[0]
        return jnp.zeros_like(w), jnp.ones_like(w)

    def step(parameters: Any, state: Any, time: jax.Array, sense: SensorReadings) -> StepOutput:
        w, c, reach, center, constant = parameters
        x, y = state
        a1, b1 = derivative(w, c, x, y)
        a2, b2 = derivative(w, c, x + dt / 2 * a1, y + dt / 2 * b1)
        a3, b3 = derivative(w, c, x + dt / 2 * a2, y + dt / 2 * b2)
        a4, b4 = derivative(w, c, x + dt * a3, y + dt * b3)
        x = x + dt / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        y = y + dt / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
        targets = center + reach * jnp.tanh(x)
        if not constant.shape[0]:
            return (x, y), targets
        return (x, y), jnp.concatenate([targets, constant])

    return make_controller(made_for, blocks.genes, decode, init, step)
