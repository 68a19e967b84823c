"""Oscillators that listen: phases, amplitudes and offsets that answer to sensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.body.sensors import Sensor
from mjx_revolve.control.controller import (
    Controller,
    Gene,
    as_plant,
    make_controller,
    of_actuators,
)
from mjx_revolve.control.neighbours import act, join_pairs
from mjx_revolve.control.sense import Sense
from mjx_revolve.control.sensors import make_observer
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.robot import Robot
from mjx_revolve.numerics.spatial import sincos

# How fast amplitudes and offsets follow [1/s], and how strongly neighbours pull [rad/s]: choices,
# a fifth of a second, and a phase lag that is found within a stroke.
_FOLLOW, _PULL = 5.0, 10.0


def make_sensory_cpg(
    body: Plant | Robot,
    sensors: Sequence[Sensor] | None = None,
    max_frequency: float = 2.0,
    amplitude: float = 1.0,
    gain: float = 1.0,
) -> Controller:
    """One phase oscillator per hinge, neighbours coupled, with feedback from sensors.

    After Ijspeert, Crespi, Ryczko & Cabelguen 2007 (Science 315), amplitudes of first order:

        θ̇_i = 2π f + Σ_j w sin(θ_j - θ_i - φ_ij) + 2π f_max gain Σ_k P_ik s_k,
        ṙ_i = a (A_i + gain Σ_k R_ik s_k - r_i),   ȯ_i = a (B_i + gain Σ_k O_ik s_k - o_i),

    with s the observation, φ_ij = -φ_ji, and both sums clipped to ±1. Target of hinge i: middle +
    amplitude × half range × clip(o_i + r_i sin θ_i, ±1). Everything starts at 0, so no joint jumps,
    and zero genes keep all still. Thrusters have o only, and of the senses only the robot's.

    Args:
        body: whose hinges and thrusters are driven: a plant or a robot.
        sensors: that it listens to; by default `sensors.USUAL`.
        max_frequency: upper end of f [Hz].
        amplitude: share of the ranges used [-].
        gain: largest answer to a sensor at the end of its range, as a share of the range [-].

    Returns:
        The controller; genes: A, B, then P, R and O of each sense, per hinge; φ per pair; f; B and
        O per thruster. All are sin(gene), but φ = π sin(gene), f = f_max (1 + sin(gene)) / 2.
    """
    made_for = as_plant(body)
    observer = make_observer(sensors, made_for.timestep, made_for)
    own = [*observer.robot_names, *(f"joint {x}" for x in observer.joint_names)]
    of_hinges = ["amplitude", *(f"{what} {x}" for what in ("phase", "amplitude") for x in own)]
    of_hinges += [f"offset joint {x}" for x in observer.joint_names]
    of_all = ["offset", *(f"offset {x}" for x in observer.robot_names)]
    n, m = made_for.num_hinges, made_for.num_actuators
    genes = [Gene(what, "hinge", k) for what in of_hinges for k in range(n)]
    genes += [Gene("lag", "pair", k) for k in range(made_for.num_pairs)]
    genes += [Gene("frequency", "robot"), *of_actuators(made_for, *of_all)]
    dt, few = made_for.timestep, len(observer.robot_names)

    def decode(genes: jax.Array, plant: Plant) -> Any:
        folded, rows = jnp.sin(genes), plant.num_hinge_rows
        none = jnp.zeros((plant.num_thrusters, *genes.shape[1:]), genes.dtype)
        hinge = [
            plant.arrange(jnp.concatenate([folded[k * n : (k + 1) * n], none]))[:rows]
            for k in range(len(of_hinges))
        ]
        start = len(of_hinges) * n
        lag = np.pi * folded[start : start + made_for.num_pairs]
        start += made_for.num_pairs
        rate = np.pi * max_frequency * (1 + folded[start : start + 1])
        start += 1
        every = [
            plant.arrange(folded[start + k * m : start + (k + 1) * m]) for k in range(len(of_all))
        ]
        sine, cosine = sincos(lag)
        count = len(own)
        return (
            (hinge[0], hinge[1 : 1 + count], hinge[1 + count : 1 + 2 * count]),
            (every[0], every[1:], hinge[1 + 2 * count :]),
            rate,
            (join_pairs(cosine, cosine, plant), join_pairs(sine, -sine, plant)),
            (amplitude * plant.reach(genes), plant.middle(genes)),
            plant.source[:rows],
        )

    def init(parameters: Any) -> Any:
        still, bias = jnp.zeros_like(parameters[0][0]), jnp.zeros_like(parameters[1][0])
        # XLA takes nothing of no size into its loops.
        return observer.init(still), (still, still) if still.shape[0] else (), bias

    def step(parameters: Any, state: Any, time: jax.Array, sense: Sense) -> tuple[Any, jax.Array]:
        (size, quicken, swell), (bias, turn, bend), rate, near, (reach, middle), number = parameters
        seen, swinging, offset = state
        seen, observation = observer.observe(seen, time, sense, number)
        felt = [*observation.robot, *observation.joint]

        def answer(weights: Any, felt: Any) -> Any:
            return gain * sum(w * x for w, x in zip(weights, felt, strict=True)) if felt else 0.0

        follow = min(_FOLLOW * dt, 1.0)
        aim = bias + answer(turn, felt[:few])
        if not swinging:
            offset = offset + follow * (jnp.clip(aim, -1, 1) - offset)
            return (seen, (), offset), middle + reach * jnp.clip(offset, -1, 1)
        phase, wide = swinging
        rows = phase.shape[0]
        speed = rate + 2 * np.pi * max_frequency * answer(quicken, felt)
        sine, cosine = sincos(phase)
        # sin(θ_j - φ - θ_i), the difference taken apart, so that each phase has one sine.
        along, across = near
        up = act(along, sine) - act(across, cosine)
        level = act(along, cosine) + act(across, sine)
        speed = speed + _PULL * (cosine * up - sine * level)
        if bend:
            more = aim[:rows] + answer(bend, felt[few:])
            aim = more if rows == aim.shape[0] else jnp.concatenate([more, aim[rows:]])
        wide_aim = jnp.clip(size + answer(swell, felt), -1, 1)
        wide = wide + follow * (wide_aim - wide)
        offset = offset + follow * (jnp.clip(aim, -1, 1) - offset)
        wave = offset[:rows] + wide * sine
        command = wave if rows == offset.shape[0] else jnp.concatenate([wave, offset[rows:]])
        target = middle + reach * jnp.clip(command, -1, 1)
        return (seen, (phase + dt * speed, wide), offset), target

    found = make_controller(made_for, genes, decode, init, step)
    return found._replace(feels=observer.feels, observer=observer)
