"""Revolve's differential CPG: coupled oscillators, one for each hinge."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from mjx_revolve.control.controller import (
    Controller,
    GeneBlocks,
    StepOutput,
    as_plant,
    fade_in,
    make_controller,
)
from mjx_revolve.control.neighbours import NeighbourMatrix, apply_matrix, pair_matrix
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.robot import Robot


def make_cpg(body: Plant | Robot, max_frequency: float = 2.0, amplitude: float = 1.0) -> Controller:
    """Revolve's differential CPG: one oscillator pair per hinge, neighbours coupled.

    ẋ_i = w_i y_i + Σ_j c_ij x_j,  ẏ_i = -w_i x_i,  c_ij = -c_ji for hinges that share a rigid link
    (Lan et al. 2021, Learning locomotion skills in evolvable robots, Neurocomputing 452). The
    system matrix is antisymmetric, so Σ x² + y² is constant. Target of hinge i: amplitude × half
    range × tanh(x_i), from the middle of its range. It starts at x = 0, y = 1: with all weights
    zero nothing moves but to there. From command to command it is exact, by the matrix exponential,
    so that its frequencies depend neither on the rate nor on the world's step. Thrusters have no
    neighbours: each has a constant command, half range × sin(gene).

    Genes: one w per hinge, then one c per pair of neighbours, then one command per thruster;
    w = 2π f_max sin(gene), c = π f_max sin(gene).

    Args:
        body: a plant or a robot.
        max_frequency: of an uncoupled oscillator [Hz].
        amplitude: share of the hinges' range used [-].
    """
    made_for = as_plant(body)
    dt = made_for.timestep
    # Bound of the system matrix's row sums, with all hinges of the body as neighbours.
    fastest = np.pi * max_frequency * (1 + made_for.num_hinges)
    blocks = GeneBlocks(made_for, ("w", "hinge"), ("c", "pair"), ("thrust", "thruster"))

    def decode(genes: jax.Array, plant: Plant) -> PyTree:
        values, rows = blocks.split(jnp.sin(genes), plant), plant.num_hinge_rows
        weights = np.pi * max_frequency * values["c"]
        coupling = pair_matrix(weights, -weights, plant)
        middle, reach = plant.middle(genes), plant.reach(genes)
        w = 2 * np.pi * max_frequency * values["w"]
        constant = middle[rows:] + reach[rows:] * values["thrust"]
        turn = _propagator(w, coupling, dt, fastest)
        return w, coupling, amplitude * reach[:rows], middle[:rows], constant, turn

    def init(parameters: PyTree) -> PyTree:
        w = parameters[0]
        return jnp.zeros_like(w), jnp.ones_like(w)

    def step(
        parameters: PyTree, before: PyTree, time: jax.Array, sense: SensorReadings
    ) -> StepOutput:
        _, _, reach, center, constant, turn = parameters
        state = jnp.concatenate(before)
        after = tuple(jnp.split(apply_matrix(turn, state) if turn else state, 2))
        # Without a rate, as in older versions, a command is that of the next step.
        wave = jnp.tanh((after if made_for.rate is None else before)[0])
        targets = fade_in(time) * center + reach * wave
        if not constant.shape[0]:
            return after, targets
        return after, jnp.concatenate([targets, constant])

    return make_controller(made_for, blocks.genes, decode, init, step)


def system_matrix(w: jax.Array, coupling: NeighbourMatrix) -> jax.Array:
    """`[2 n, 2 n, lanes]` rates of change of n oscillators, all x and then all y [rad/s]."""
    rows = w.shape[0]
    each = np.arange(rows)
    matrix = jnp.zeros((2 * rows, 2 * rows, *w.shape[1:]), w.dtype)
    for j, column in coupling.items():
        matrix = matrix.at[:rows, j].set(column)
    return matrix.at[each, rows + each].set(w).at[rows + each, each].set(-w)


def _propagator(
    w: jax.Array, coupling: NeighbourMatrix, dt: float, fastest: float
) -> NeighbourMatrix:
    """The state-transition matrix of the oscillators (all x, then all y) over a time.

    Taylor's series of the matrix exponential, scaled and squared (Moler and Van Loan 2003, SIAM
    Review 45, method 3); then a step of Newton's iteration for the nearest orthogonal matrix, so
    that no rounding adds up in Σ x² + y² (Higham 1986, SIAM J. Sci. Stat. Comput. 7).

    Args:
        w: `[hinge rows, lanes]` of the oscillators [rad/s].
        coupling: between them [rad/s].
        dt: the time [s].
        fastest: bound of the system matrix's norm [rad/s].

    Returns:
        Its columns, `[2 × hinge rows, lanes]` each.
    """
    rows = w.shape[0]
    if not rows:
        return {}
    halvings = max(0, math.ceil(math.log2(2 * dt * fastest)))
    matrix = dt / 2**halvings * system_matrix(w, coupling)

    def times(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.einsum("ij...,jk...->ik...", a, b, precision="highest")

    # From a norm of 1/2, the tenth power leaves an error of 1e-11.
    eye = jnp.eye(2 * rows, dtype=w.dtype).reshape(2 * rows, 2 * rows, *(1,) * (w.ndim - 1))
    found = eye + matrix / 10
    for k in range(9, 0, -1):
        found = eye + times(matrix, found) / k
    for _ in range(halvings):
        found = times(found, found)
    found = times(found, 3 * eye - times(jnp.swapaxes(found, 0, 1), found)) / 2
    return {j: found[:, j] for j in range(2 * rows)}
