"""The gait that a controller's genes encode: periods, phases and amplitudes."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from mjx_revolve.control.cpg import system_matrix
from mjx_revolve.control.kinds import find_controller
from mjx_revolve.engine.plant import Plant
from mjx_revolve.inputs.errors import InputError

# Angular frequencies nearer than this, as a share of the fastest, count as equal; a choice.
_SAME_RATE = 1e-5
# Amplitudes count as equal within this share for each rad/s between the frequencies; a choice.
_SAME_SIZE = 1e-4

UNITS: dict[str, str] = {
    f"{name}_{of}": unit
    for of, unit in (("period", "s"), ("phase_offset", "rad"), ("amplitude", "rad"))
    for name in ("mean", "spread")
}
"""The keys of `describe_gait` in order, with units."""


def describe_gait(plant: Plant, settings: Any, genes: ArrayLike) -> dict[str, float]:
    """Periods, phases and amplitudes of the hinges' targets, after Revolve's brain descriptors.

    Revolve (`measure_brain.py`) takes medians, over the parameters' ranges, and squashed standard
    deviations; here they are means and standard deviations in the parameters' own units, of phases
    the circular ones: √(-2 ln R), R the length of the mean of exp(i φ). Its recurrence, reach of
    sensors and synaptic reception belong to neural networks, which encode no gait.

    Each hinge's target is approximated by a sin(2π t / T + φ) about its middle. `sine`: its first
    harmonic; the period is common. `cpg`: its oscillators are coupled linearly, so that each x is a
    sum of sines at the eigenfrequencies of the system matrix; the greatest of them counts (of equal
    ones the fastest), with the amplitude that tanh leaves of it. `splines`: its curve's first
    harmonic. `sensory_cpg`: its oscillators at readings of 0, once their phases have settled.
    Hinges with a constant target do not count.

    Args:
        plant: of one robot, from `plant_of`.
        settings: a `config.ControllerConfig`, with the robot's own sensors if those are what the
            controller reads.
        genes: `[num_genes]` of one individual.

    Returns:
        mean_period, spread_period [s], mean_phase_offset (-π to π), spread_phase_offset,
        mean_amplitude, spread_amplitude [rad]: all 0 where nothing moves. Empty for other
        controllers.
    """
    if settings.type not in _WAVES:
        return {}
    still = dict.fromkeys(UNITS, 0.0)
    if not plant.num_hinges:
        return still
    controller = find_controller(plant, settings.model_copy(update={"rate": None}))
    if np.shape(genes) != (controller.num_genes,):
        own = f"[{controller.num_genes}] of a {settings.type} with the sensors of its settings"
        raise InputError("genes", own, list(np.shape(genes)))
    parameters = controller.decode(jnp.asarray(genes, float)[:, None], plant)
    rate, amplitude, phase = _WAVES[settings.type](parameters, plant.num_hinge_rows)
    moves = (amplitude > 1e-9) & (rate > 1e-9)
    if not moves.any():
        return still
    period, amplitude, phase = 2 * np.pi / rate[moves], amplitude[moves], phase[moves]
    mean = np.exp(1j * phase).mean()
    spread = np.sqrt(2 * np.log(1 / np.clip(abs(mean), 1e-3, 1.0)))
    found = (period.mean(), period.std(), np.angle(mean), spread, amplitude.mean(), amplitude.std())
    return dict(zip(UNITS, map(float, found), strict=True))


_Waves = tuple[np.ndarray, np.ndarray, np.ndarray]


def _sine_waves(parameters: Any, hinges: int) -> _Waves:
    """Angular frequency, amplitude and phase of each hinge's first harmonic, `[hinges]`."""
    (u, v), rate = parameters[0][0], np.asarray(parameters[2], float).item()
    wave = np.asarray(u, float)[:hinges, 0] + 1j * np.asarray(v, float)[:hinges, 0]
    return np.full(hinges, rate), np.abs(wave), np.angle(wave)


def _cpg_waves(parameters: Any, hinges: int) -> _Waves:
    """Angular frequency, amplitude and phase of the largest sine of each oscillator."""
    w, coupling, reach, *_ = parameters
    matrix = np.asarray(system_matrix(w, coupling), float)[..., 0]
    # The matrix M is antisymmetric, so i M is Hermitian and (x, y) = Σ V exp(-i λ t) V* (0, 1).
    turns, modes = np.linalg.eigh(1j * matrix)
    start = np.concatenate([np.zeros(hinges), np.ones(hinges)])
    parts = modes[:hinges] * (modes.conj().T @ start)
    # Terms of one frequency add up to one sine; of each pair ±λ, one is enough.
    near = _SAME_RATE * max(np.abs(turns).max(), 1e-9)
    same = np.abs(turns[:, None] - turns) < near
    parts = np.where(turns < -near, 2 * parts @ same, 0)
    # Coupled equal oscillators have pairs of sines of equal amplitude: the faster one counts.
    best = (np.abs(parts) * (1 - _SAME_SIZE * turns)).argmax(1)
    wave = parts[np.arange(hinges), best]
    # Re(z exp(i ω t)) = |z| sin(ω t + arg z + π/2).
    size = np.tanh(np.abs(wave)) * np.abs(np.asarray(reach, float)[:, 0])
    return -turns[best], size, np.angle(1j * wave)


def _splines_waves(parameters: Any, hinges: int) -> _Waves:
    """Angular frequency, amplitude and phase of each curve's first harmonic."""
    rows, rate = parameters[0], 2 * np.pi * np.asarray(parameters[1], float).item()
    points = len(rows)
    turn = np.exp(-2j * np.pi * np.arange(points) / points)
    bumps = turn @ np.stack([np.asarray(row, float)[:hinges, 0] for row in rows])
    # A cubic B-spline is a box convolved three times with itself.
    wave = 2 / points * bumps * np.sinc(1 / points) ** 4
    return np.full(hinges, rate), np.abs(wave), np.angle(1j * wave)


def _sensory_waves(parameters: Any, hinges: int) -> _Waves:
    """Frequency, amplitude and phase of oscillators at readings of 0, with settled phases."""
    (size, *_), _, rate, near, (reach, _), _ = parameters
    lag = np.zeros((hinges, hinges), complex)
    for j in near[0]:
        cosine, sine = (np.asarray(columns[j], float)[:, 0] for columns in near)
        lag[:, j] = cosine - 1j * sine
    # In steps that are stable with so many neighbours, for the square of a chain's length.
    phase, step = np.zeros(hinges), 0.5 / max(1, int((lag != 0).sum(0).max(initial=0)))
    for _ in range(max(2000, 20 * hinges**2)):
        phase += step * np.imag(np.exp(-1j * phase) * (lag @ np.exp(1j * phase)))
    sizes = np.asarray(size, float)[:, 0] * np.asarray(reach, float)[:hinges, 0]
    phase = phase + np.pi * (sizes < 0)
    return np.full(hinges, np.asarray(rate, float).item()), np.abs(sizes), phase


_WAVES = {
    "sine": _sine_waves,
    "cpg": _cpg_waves,
    "splines": _splines_waves,
    "sensory_cpg": _sensory_waves,
}
