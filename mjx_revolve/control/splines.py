"""RLPower's policies: a closed curve for each joint, through a few points."""

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
    fade_in,
    make_controller,
)
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.robot import Robot
from mjx_revolve.numerics.spatial import Scalar

_Curves = tuple[tuple[Scalar, ...], jax.Array, jax.Array]  # coefficients, frequency, middle


def make_splines(
    body: Plant | Robot, points: int = 8, max_frequency: float = 2.0, amplitude: float = 1.0
) -> Controller:
    """A periodic cubic spline per hinge or thruster, and a frequency shared by all.

    The policies of RLPower (Kober & Peters 2009; for modular robots D'Angelo, Weel & Eiben 2013):
    target_i(t) = middle + amplitude × half range × s_i(f t mod 1), s_i the periodic cubic spline
    through sin(gene) at equal distances. RLPower begins with 3 points and adds points during
    learning, up to 100 (`refine_splines`). f = f_max (1 + sin(gene)) / 2. Targets fade in over the
    first half second. Between its points a spline may overshoot them; the servo's range clips it.

    Args:
        body: a plant or a robot.
        points: of each curve, 3 or more [-].
        max_frequency: upper end of f [Hz].
        amplitude: share of the ranges used [-].

    Returns:
        The controller; genes: the first point of all actuators, the second and so on, then the
        frequency.
    """
    made_for = as_plant(body)
    names = [f"point{k + 1}" for k in range(points)]
    blocks = GeneBlocks(made_for, *((name, "actuator") for name in names), ("frequency", "robot"))
    solve = np.linalg.inv(_weights_of(np.arange(points), points))

    def decode(genes: jax.Array, plant: Plant) -> _Curves:
        values, reach = blocks.split(jnp.sin(genes), plant), amplitude * plant.reach(genes)
        through = [reach * values[name] for name in names]
        # The B-spline's coefficients, so that the curve goes through the points.
        rows = [sum(float(w) * x for w, x in zip(row, through, strict=True)) for row in solve]
        return tuple(rows), max_frequency * (1 + values["frequency"]) / 2, plant.middle(genes)

    def step(
        parameters: _Curves, state: tuple[()], time: jax.Array, sense: SensorReadings
    ) -> StepOutput:
        rows, rate, middle = parameters
        turns = rate * time
        at = points * (turns - jnp.floor(turns))
        wave: Scalar = 0.0
        for k, row in enumerate(rows):
            wave = wave + _weight(at - k, points, jnp) * row
        return state, fade_in(time) * (middle + wave)

    return make_controller(made_for, blocks.genes, decode, lambda parameters: (), step)


def _weight(way: Scalar, points: int, xp: Any) -> Scalar:
    """The cubic B-spline at a distance (-points to points, in knots) from its centre."""
    found: Scalar = 0.0
    # A B-spline is four knots wide: on a ring of fewer than that it overlaps itself.
    for turn in (-2, -1, 0, 1, 2) if points < 4 else (-1, 0, 1):
        far = xp.abs(way + turn * points)
        outer, inner = xp.maximum(2 - far, 0), xp.maximum(1 - far, 0)
        found = found + (outer * outer * outer - 4 * inner * inner * inner) / 6
    return found


def _weights_of(places: np.ndarray, points: int) -> np.ndarray:
    """`[places, points]` weights of the coefficients at positions along the closed curve."""
    away: np.ndarray = np.subtract.outer(places, np.arange(points))
    return _weight(away, points, np)


def refine_splines(genes: np.ndarray, points: int, more: int) -> np.ndarray:
    """Genes for more points, with curves that follow the old ones as closely as possible.

    Args:
        genes: `[points * n + 1]` of `make_splines`.
        points: number of points of each curve.
        more: the new number.

    Returns:
        `[more * n + 1]` genes.
    """
    values = np.sin(np.asarray(genes, float)[:-1]).reshape(points, -1)
    places = np.arange(more) * points / more
    curve = _weights_of(places, points) @ np.linalg.inv(_weights_of(np.arange(points), points))
    # Overshoots are clipped at the ends of the range.
    found = np.arcsin(np.clip(curve @ values, -1, 1))
    return np.concatenate([found.ravel(), np.asarray(genes, float)[-1:]])
