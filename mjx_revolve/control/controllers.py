"""Controllers: genes to parameters to commands. Zero genes keep every joint and thruster still.

A controller is four plain functions over a population on the last axis. The genes are unbounded
real numbers, folded into physical ranges by sin(gene), so that any optimiser can move them freely.
Folded, not squashed: with tanh, an optimum at the end of a range lies at infinity, and strategies
that adapt their step size run after it until their numbers overflow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.step import Sense
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.own_code import call_own, load_own, parse_own, short_name
from mjx_revolve.numerics.spatial import safe_norm, sincos


class Controller(NamedTuple):
    """What turns genes into joint targets.

    Attributes:
        num_genes: length of an individual's genes.
        gene_names: `[num_genes]` what each gene is, for tables and plots.
        decode: (genes `[num_genes, lanes]`, order `[nu]`) → parameters; rows follow `order`.
        init: parameters → controller state.
        step: (parameters, state, time [s], sense) → (state, `[nu, lanes]` joint targets [rad] and
            commands of thrusters [-]); `sense` is a `dynamics.Sense`, what the robot may feel.
    """

    num_genes: int
    gene_names: tuple[str, ...]
    decode: Callable[[jax.Array, np.ndarray], Any]
    init: Callable[[Any], Any]
    step: Callable[[Any, Any, jax.Array, Sense], tuple[Any, jax.Array]]


@dataclass(frozen=True)
class BoundController:
    """A controller with one individual's genes, as `simulate` takes it."""

    controller: Controller
    genes: Any


def bind_genes(controller: Controller, genes: Any) -> BoundController:
    """Joins a controller and one individual's genes.

    Args:
        controller: from `make_cpg` or `make_sine`.
        genes: `[num_genes]`.

    Returns:
        What `simulate` takes as `ctrl`.
    """
    return BoundController(controller, genes)


def _range(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """`[nu, 1]` middle and half width of each actuator's range ([rad], or [-] of thrusters)."""
    low, high = robot.mj_model.actuator_ctrlrange.reshape(-1, 2).T
    return (low + high)[:, None] / 2, (high - low)[:, None] / 2


def make_cpg(robot: Robot, max_frequency: float = 2.0, amplitude: float = 1.0) -> Controller:
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
        robot: whose hinges are driven.
        max_frequency: of an uncoupled oscillator [Hz].
        amplitude: share of the hinges' range used [-].

    Returns:
        The controller.
    """
    n, thrusters, dt = robot.num_hinges, robot.num_thrusters, robot.world.timestep
    pairs = robot.morphology.hinge_neighbours()
    middle, half = _range(robot)
    hinges, pushers = list(robot.servos), list(robot.thrusters)
    names = [robot.mj_model.actuator(i).name for i in hinges]
    gene_names = tuple(
        [f"w {name}" for name in names]
        + [f"c {names[i]}~{names[j]}" for i, j in pairs]
        + [f"thrust {robot.mj_model.actuator(i).name}" for i in pushers]
    )
    # 32 bits and, below, the genes' dtype: JAX keeps one typed copy of a NumPy array that it meets
    # in a trace, of whichever mode, 32 or 64 bits, it met it in first.
    source = np.zeros((n, n), np.int32)
    sign = np.zeros((n, n, 1))
    for k, (i, j) in enumerate(pairs):
        source[i, j] = source[j, i] = n + k
        sign[i, j], sign[j, i] = 1.0, -1.0

    def decode(genes: jax.Array, order: np.ndarray) -> Any:
        # The engine wants its hinges first: where each stands among the hinges.
        turn = np.array([hinges.index(i) for i in order[:n]], int)
        blow = np.array([pushers.index(i) for i in order[n:]], int)
        folded = jnp.sin(genes)
        w = 2 * np.pi * max_frequency * folded[:n][turn]
        c = np.pi * max_frequency * folded[source] * np.asarray(sign, genes.dtype)
        c = c[turn][:, turn]

        def wide(x: Any, rows: np.ndarray) -> jax.Array:
            shape = (len(rows), *genes.shape[1:])
            return jnp.broadcast_to(jnp.asarray(x, genes.dtype)[rows], shape)

        reach, center = wide(amplitude * half, order[:n]), wide(middle, order[:n])
        constant = folded[len(folded) - thrusters :][blow]
        constant = wide(middle, order[n:]) + wide(half, order[n:]) * constant
        return w, c, reach, center, constant

    def slope(w: jax.Array, c: jax.Array, x: jax.Array, y: jax.Array) -> tuple[Any, Any]:
        coupled = w * y
        for j in range(n):  # written out: no reductions inside the compiled loop
            if np.any(sign[:, j]) or np.any(sign[j]):
                coupled = coupled + c[:, j] * x[j : j + 1]
        return coupled, -w * x

    def init(parameters: Any) -> Any:
        w = parameters[0]
        return jnp.zeros_like(w), jnp.ones_like(w)

    def step(parameters: Any, state: Any, time: jax.Array, sense: Sense) -> tuple[Any, jax.Array]:
        w, c, reach, center, constant = parameters
        x, y = state
        a1, b1 = slope(w, c, x, y)
        a2, b2 = slope(w, c, x + dt / 2 * a1, y + dt / 2 * b1)
        a3, b3 = slope(w, c, x + dt / 2 * a2, y + dt / 2 * b2)
        a4, b4 = slope(w, c, x + dt * a3, y + dt * b3)
        x = x + dt / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        y = y + dt / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
        targets = center + reach * jnp.tanh(x)
        return (x, y), jnp.concatenate([targets, constant]) if thrusters else targets

    return Controller(len(gene_names), gene_names, decode, init, step)


def make_sine(
    robot: Robot, max_frequency: float = 2.0, amplitude: float = 1.0, harmonics: int = 1
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
        robot: whose hinges are driven.
        max_frequency: upper end of f [Hz].
        amplitude: share of the hinges' range used [-].
        harmonics: how many sines are added up [-].

    Returns:
        The controller; genes: u and v of the first harmonic (one per hinge each), of the second and
        so on, offsets, then the frequency.
    """
    n = robot.mj_model.nu
    middle, half = _range(robot)
    names = [robot.mj_model.actuator(i).name for i in range(n)]
    waves = [f"{x}{k + 1 if k else ''}" for k in range(harmonics) for x in "uv"]
    gene_names = tuple(f"{what} {name}" for what in (*waves, "offset") for name in names)
    gene_names += ("frequency",)

    def decode(genes: jax.Array, order: np.ndarray) -> Any:
        rows = [genes[k * n : (k + 1) * n][order] for k in range(2 * harmonics + 1)]
        reach = amplitude * jnp.asarray(half, genes.dtype)[order]
        center = jnp.broadcast_to(jnp.asarray(middle, genes.dtype)[order], rows[0].shape)
        return decode_sine(rows, genes[-1:], reach, center, max_frequency)

    return Controller(len(gene_names), gene_names, decode, lambda parameters: (), step_sine)


def decode_sine(
    rows: list[jax.Array],
    frequency: jax.Array,
    reach: jax.Array,
    center: jax.Array,
    max_frequency: float,
) -> Any:
    """Parameters of the sines, as `make_sine` describes them.

    Args:
        rows: genes u, v of each harmonic, then offsets, `[nu, lanes]` each.
        frequency: its gene, `[1, lanes]`.
        reach: largest amplitude, `[nu, lanes]` or `[nu, 1]` [rad].
        center: `[nu, lanes]` [rad].
        max_frequency: upper end of the frequency [Hz].

    Returns:
        What `step_sine` takes.
    """
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


def step_sine(parameters: Any, state: Any, time: jax.Array, sense: Sense) -> tuple[Any, jax.Array]:
    """The step of a `Controller` made of sines."""
    sizes, offset, rate, center = parameters
    fade = jnp.minimum(time / 0.5, 1.0)
    wave = offset
    for k, (u, v) in enumerate(sizes):
        sine, cosine = sincos((k + 1) * rate * time)
        wave = wave + u * sine + v * cosine
    return state, center + fade * wave


# What `make_feedback` multiplies by its genes: names, and the size that counts as 1. Choices: an
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


def make_feedback(robot: Robot, depth: float = 1.0, gain: float = 2.0) -> Controller:
    """Commands that answer to depth and attitude, linearly: what an AUV needs to hold its depth.

    command_i = middle + half range × clip(sin(b_i) + gain Σ_k sin(W_ik) feature_k, -1, 1), with
    features depth error (core above `depth` counts positive) [0.2 m], climb [0.1 m/s], roll and
    pitch (the vertical's y and x in the core's frame) [0.2], and spin about the core's three axes
    [0.5 rad/s], each divided by the size in brackets. Zero genes: nothing moves.

    Args:
        robot: whose hinges and thrusters are driven.
        depth: to hold, of the core's centre below the still surface [m].
        gain: share of the range that a feature of size 1 may command at most [-].

    Returns:
        The controller; genes: a bias per actuator, then the gains, actuator by actuator.
    """
    n, count = robot.mj_model.nu, len(_FEEDBACK)
    middle, half = _range(robot)
    names = [robot.mj_model.actuator(i).name for i in range(n)]
    gene_names = tuple(
        [f"bias {name}" for name in names]
        + [f"{feature} {name}" for name in names for feature, _ in _FEEDBACK]
    )

    def decode(genes: jax.Array, order: np.ndarray) -> Any:
        folded = jnp.sin(genes)
        bias = folded[:n][order]
        weights = gain * folded[n:].reshape(n, count, *genes.shape[1:])[order]
        wide = lambda x: jnp.broadcast_to(jnp.asarray(x, genes.dtype)[order], bias.shape)  # noqa: E731
        return bias, tuple(weights[:, k] for k in range(count)), wide(middle), wide(half)

    def step(parameters: Any, state: Any, time: jax.Array, sense: Sense) -> tuple[Any, jax.Array]:
        bias, weights, center, reach = parameters
        found = (sense.height + depth, sense.climb, sense.up[1], sense.up[0], *sense.spin)
        command = bias
        for weight, feature, (_, size) in zip(weights, found, _FEEDBACK, strict=True):
            command = command + weight * (feature / size)
        return state, center + reach * jnp.clip(command, -1, 1)

    return Controller(len(gene_names), gene_names, decode, lambda parameters: (), step)


# By the name that a configuration gives; each takes (robot, settings).
CONTROLLERS: dict[str, Callable[[Robot, Any], Controller]] = {
    "cpg": lambda robot, settings: make_cpg(robot, settings.max_frequency, settings.amplitude),
    "sine": lambda robot, settings: make_sine(
        robot, settings.max_frequency, settings.amplitude, settings.harmonics
    ),
    "feedback": lambda robot, settings: make_feedback(robot, settings.depth, settings.gain),
}


def find_controller(robot: Robot, settings: Any, source: str = "config") -> Controller:
    """The controller that a configuration names, made for a robot.

    Args:
        robot: whose hinges and thrusters are driven.
        settings: a `config.ControllerConfig`. Its `type` is a name in `CONTROLLERS`, or
            FILE.py:FUNCTION for a function of the user's own, which takes the robot and these
            settings and returns a `Controller`.
        source: what messages call the configuration.

    Returns:
        The controller.

    Raises:
        InputError: the file or the function is missing, or what it makes is no controller of this
            robot; one line says where.
    """
    if settings.type in CONTROLLERS:
        return CONTROLLERS[settings.type](robot, settings)
    name = settings.type
    function = load_own(name, f"{source}: controller.type")
    controller = call_own(
        name, f"{short_name(name)} to make a controller", function, robot, settings
    )
    _check_own(name, controller, robot.mj_model.nu)
    return controller


def _check_own(name: str, controller: Any, nu: int) -> None:
    """Refuses what is no controller of `nu` actuators, before anything is compiled."""
    own = parse_own(name)
    place = f"{own.path}: {own.function}" if own else name
    if not isinstance(controller, Controller):
        raise InputError(f"{place}: expected a Controller; found {type(controller).__name__}")
    count = controller.num_genes
    if not isinstance(count, int) or count < 0:
        raise InputError(f"{place}: num_genes: expected a whole number >= 0; found {count!r}")
    if len(controller.gene_names) != count:
        raise InputError(
            f"{place}: gene_names: expected {count} of them, as num_genes says; found "
            f"{len(controller.gene_names)}"
        )
    lanes = 3
    one: Any = jax.ShapeDtypeStruct((lanes,), jnp.float32)
    order = np.arange(nu)

    def run(genes: jax.Array, time: jax.Array, sense: Sense) -> Any:
        parameters = controller.decode(genes, order)
        state = controller.init(parameters)
        return state, *controller.step(parameters, state, time, sense)

    before, after, targets = call_own(
        name,
        f"{short_name(name)}'s decode, init and step to give targets",
        jax.eval_shape,
        run,
        jax.ShapeDtypeStruct((count, lanes), jnp.float32),
        jax.ShapeDtypeStruct((), jnp.float32),
        Sense(one, one, (one, one, one), (one, one, one)),
    )
    if getattr(targets, "shape", None) != (nu, lanes):
        raise InputError(
            f"{place}: step: expected targets [nu, lanes], here [{nu}, {lanes}]; found "
            f"{list(targets.shape) if hasattr(targets, 'shape') else type(targets).__name__}"
        )
    if _shapes(before) != _shapes(after):
        raise InputError(
            f"{place}: step: expected a state of the shapes that init gives, {_shapes(before)}; "
            f"found {_shapes(after)}"
        )


def _shapes(state: Any) -> str:
    return str(jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}", state)).replace("'", "")
