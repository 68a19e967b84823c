"""evosax's strategies behind one small interface: `ask` for genes, `tell` their scores.

Three things happen here and nowhere else: scores (higher is better) become losses (evosax
minimises), failed and tied scores are made safe, and a strategy's state is kept as NumPy arrays, so
that a state read back from a checkpoint is the same thing as one that never left memory.
"""

from __future__ import annotations

import inspect
import json
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from mjx_revolve.episodes.bodies_config import LearningConfig
from mjx_revolve.episodes.config import EvolutionConfig
from mjx_revolve.episodes.strategy_names import STRATEGY_NAMES, find_strategy
from mjx_revolve.inputs.errors import InputError

# Strategies with the draws of a population in their state, which `tell` uses. Those that draw
# mirrored pairs (GuidedES, NoiseReuseES, PersistentES) are none: a pair would lose its half.
_REMEMBER = ("xNES", "MA_ES", "LM_MA_ES", "CR_FM_NES")
# The score of a failed rollout if no rollout of its generation has a score.
FAILED_SCORE = -1e6
# The step size never falls below this fraction of `std_init`: under noisy scores, a smaller step
# measures only the noise.
STD_FLOOR = 1e-3
# Smallest difference between scores that XLA does not flush to zero, with room to spare.
_SMALLEST_GAP = 1e-30


@cache
def _strategies() -> dict[str, type]:
    """Evosax's classes by name: imported, in half a second, while workers start."""
    from evosax.algorithms import algorithms

    return {name: algorithms[name] for name in STRATEGY_NAMES}


def __getattr__(name: str) -> dict[str, type]:
    """`STRATEGIES`: evosax's strategies by name, each a class."""
    if name == "STRATEGIES":
        return _strategies()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def losses_from_scores(scores: np.ndarray, penalty: float | None = None) -> np.ndarray:
    """Turns scores to be maximised into losses to be minimised, all finite and all different.

    Non-finite scores (a rollout that blew up) become worse than the worst finite one by the
    spread of the finite ones, or `FAILED_SCORE` if none is finite. Tied scores, which would shrink
    CMA-ES's step size to nothing, are set one unit in the last place apart, later rows worse;
    rows are exchangeable, so this needs no random numbers.

    Args:
        scores: `[P]` higher is better; may hold NaN and infinities.
        penalty: what a non-finite score becomes at most, instead of FAILED_SCORE; None: none.

    Returns:
        `[P]` float32 losses, lower is better.
    """
    scores = np.asarray(scores, np.float64)
    finite = np.isfinite(scores)
    scores = np.clip(scores, -1e30, 1e30, where=finite, out=scores.copy())
    worst = FAILED_SCORE
    if finite.any():
        low, high = scores[finite].min(), scores[finite].max()
        worst = low - max(high - low, 1e-3 * max(1.0, abs(low)))
    if penalty is not None:
        worst = min(worst, penalty)
    losses = (-np.where(finite, scores, worst)).astype(np.float32)  # the one negation
    order = np.argsort(losses, kind="stable")
    before = -np.inf
    for row in order:
        gap = max(float(np.spacing(np.float32(abs(before)))), _SMALLEST_GAP)
        if losses[row] <= before:
            losses[row] = np.float32(before + gap)
        before = float(losses[row])
    return losses


State = dict[str, Any]  # "fresh", and "algorithm": evosax's own


@dataclass(frozen=True)
class Strategy:
    """A strategy with its settings; the state is passed in and handed back.

    A state is `{"fresh": bool, "algorithm": evosax's state}` with NumPy leaves. `fresh` says that
    a population-based strategy's first population has not been evaluated yet.

    Attributes:
        name: evosax's name.
        algorithm: evosax's object.
        params: evosax's parameters.
        std_init: standard deviation of the first population.
        population_based: whether the strategy keeps a population (DE, PSO, ...) rather than a
            distribution (CMA-ES, SNES, ...).
    """

    name: str
    algorithm: Any
    params: Any
    std_init: float
    population_based: bool

    def init(self, key: jax.Array, mean: ArrayLike | None = None) -> State:
        """Starts a search.

        Args:
            key: for the first population.
            mean: `[G]` where to start; zeros by default.

        Returns:
            The state.
        """
        num_genes = self.algorithm.num_dims
        mean = np.zeros(num_genes, np.float32) if mean is None else np.asarray(mean, np.float32)
        if not self.population_based:
            state = self.algorithm.init(key, mean, self.params)
            return _on_host({"fresh": False, "algorithm": state})
        key_population, key_init = jax.random.split(key)
        shape = (self.algorithm.population_size, num_genes)
        population = mean + self.std_init * jax.random.normal(key_population, shape)
        state = self.algorithm.init(key_init, population, jnp.zeros(shape[0]), self.params)
        return _on_host({"fresh": True, "algorithm": state})

    def ask(self, key: jax.Array, state: State) -> tuple[np.ndarray, State]:
        """Draws the next population.

        Args:
            key: for this generation's samples.
            state: the state.

        Returns:
            `[P, G]` genes, and the new state.
        """
        if state["fresh"]:
            return np.asarray(state["algorithm"].population), state
        population, algorithm = self.algorithm.ask(key, state["algorithm"], self.params)
        return np.asarray(population), _on_host({"fresh": state["fresh"], "algorithm": algorithm})

    def with_mean_first(self, state: State) -> State:
        """The state after `ask` if the mean takes the place of the first of the population.

        Some strategies remember what they drew, and would learn from a draw that was not tried.
        """
        if self.name not in _REMEMBER:
            return state
        algorithm = state["algorithm"]
        drawn = {x: getattr(algorithm, x) for x in ("z", "y") if hasattr(algorithm, x)}
        first = {name: np.concatenate([0 * x[:1], x[1:]]) for name, x in drawn.items()}
        return state | {"algorithm": algorithm.replace(**first)}

    def tell(
        self, key: jax.Array, population: np.ndarray, scores: np.ndarray, state: State
    ) -> State:
        """Updates the state by the scores of a generation.

        Args:
            key: for strategies that draw numbers here, too.
            population: `[P, G]` what `ask` returned.
            scores: `[P]` higher is better; NaN for a failure.
            state: the state.

        Returns:
            The new state.
        """
        # A strategy that keeps its population compares losses across generations, where "worse
        # than this generation's worst" could still beat an old one.
        losses = losses_from_scores(scores, FAILED_SCORE if self.population_based else None)
        if state["fresh"]:
            algorithm = self.algorithm.init(key, population, losses, self.params)
        else:
            algorithm, _ = self.algorithm.tell(
                key, population, losses, state["algorithm"], self.params
            )
        state = _on_host({"fresh": False, "algorithm": algorithm})
        return self._floor_std(state)

    def mean(self, state: State) -> np.ndarray | None:
        """The centre of the distribution, `[G]`; None for a population-based strategy."""
        return None if self.population_based else np.asarray(state["algorithm"].mean)

    def _floor_std(self, state: State) -> State:
        std = getattr(state["algorithm"], "std", None)
        if std is None or self.population_based:
            return state
        floor = np.float32(STD_FLOOR * self.std_init)
        # np.maximum propagates NaN: a broken state stays visible, and the loop restarts it.
        algorithm = state["algorithm"].replace(std=np.maximum(std, floor).astype(std.dtype))
        return state | {"algorithm": algorithm}


def _on_host(state: object) -> Any:
    return jax.tree.map(np.asarray, state)


def _constructor_settings(
    name: str, settings: dict[str, Any], std_init: float, size: int, num_genes: int
) -> tuple[dict[str, Any], dict[str, float]]:
    """Keyword arguments of evosax's class, and which settings made them, with their values.

    evosax's defaults assume a step size of 1; ours follow `std_init`, so that every strategy moves
    at all within the some ten generations that a robot can afford.
    """
    import optax

    takes = inspect.signature(_strategies()[name]).parameters
    keywords: dict[str, Any] = {}
    used: dict[str, float] = {}
    if "std_schedule" in takes:
        decay = used["std_decay"] = float(settings.get("std_decay", 0.98))
        # Of a step that grows, optax takes an end for the most.
        end = STD_FLOOR * std_init if decay < 1 else None
        keywords["std_schedule"] = optax.exponential_decay(std_init, 1, decay, end_value=end)
    if "optimizer" in takes and name not in ("SNES", "xNES", "DES", "SimpleES"):
        # The four left out follow the natural gradient, for which a plain step of 1 is right.
        used["learning_rate"] = float(settings.get("learning_rate", 0.2 * std_init))
        keywords["optimizer"] = optax.adam(used["learning_rate"])
    if name == "RandomSearch":
        keywords["sampling_fn"] = lambda key: std_init * jax.random.normal(key, (num_genes,))
    if name == "GESMR_GA":  # about sqrt(P) groups; evosax's single one leaves the step to chance
        keywords["num_groups"] = max(n for n in range(1, int(size**0.5) + 1) if (size - 1) % n == 0)
    return keywords, used


def make_strategy(config: EvolutionConfig | LearningConfig, num_genes: int) -> Strategy:
    """Builds the strategy that a configuration names.

    `config.strategy_params` may hold evosax's own parameters of the strategy, and where they apply
    `learning_rate` (of the Adam optimiser) and `std_decay` (factor on the step size for each
    generation).

    Args:
        config: name, population size, `std_init` and settings.
        num_genes: length of the genes.

    Returns:
        The strategy.

    Raises:
        InputError: there is no such strategy, it cannot take this population size, or it has no
            such parameter.
    """
    # One object per setting and process: evosax's methods are compiled anew for each object.
    return _make_strategy(
        find_strategy(config.strategy),
        config.population_size,
        config.std_init,
        json.dumps(config.strategy_params, sort_keys=True, default=str),
        num_genes,
    )


@lru_cache(maxsize=16)
def _make_strategy(
    name: str, size: int, std_init: float, params_json: str, num_genes: int
) -> Strategy:
    from evosax.algorithms import distribution_based_algorithms

    settings: dict[str, Any] = json.loads(params_json)
    for key in ("learning_rate", "std_decay"):
        value = settings.get(key, 1.0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
            raise InputError(f"evolution.strategy_params.{key}", "a number > 0", repr(value))
    keywords, used = _constructor_settings(name, settings, std_init, size, num_genes)
    if name == "LM_MA_ES" and size > 2 * num_genes:  # beyond, its first c_c > 2: a negative root
        most = f"at most twice the {num_genes} genes for {name}"
        raise InputError("evolution.population_size", most, size)
    if name == "ESMC" and size % 2:  # evosax takes it, and asks for one individual less
        raise InputError("evolution.population_size", f"an even number for {name}", size)
    try:
        algorithm = _strategies()[name](
            population_size=size, solution=jnp.zeros(num_genes), **keywords
        )
    except AssertionError as error:  # how evosax refuses a population size
        rule = "an even number" if "even" in str(error) else f"a size that it can take ({error})"
        raise InputError("evolution.population_size", f"{rule} for {name}", size) from None
    params = algorithm.default_params
    fields = set(params.__dataclass_fields__)
    if "std_init" in fields:
        params = params.replace(std_init=jnp.asarray(std_init))
    if name == "GradientlessDescent":  # its search radius plays the part of the step size
        params = params.replace(radius_max=std_init, radius_min=STD_FLOOR * std_init)
    changes = {key: value for key, value in settings.items() if key not in used}
    free = sorted((fields - {"std_init", "params"}) | set(used))
    for key, value in changes.items():
        if key == "std_init":
            raise InputError("evolution.strategy_params.std_init", "evolution.std_init", "it here")
        if key not in free:
            known = f"one of {', '.join(free) or 'none at all'} for {name}"
            raise InputError(f"evolution.strategy_params.{key}", known, "an unknown name")
        params = params.replace(**{key: _as_param(key, value, getattr(params, key))})
    population_based = name not in distribution_based_algorithms
    return Strategy(name, algorithm, params, std_init, population_based)


def _as_param(key: str, value: object, default: jax.Array) -> jax.Array:
    """A setting with the shape of evosax's default."""
    shape = np.shape(default)
    kind = f"numbers of shape {list(shape)}" if shape else "a finite number"
    if isinstance(default, bool | np.bool_):
        if isinstance(value, bool):
            return value
        kind = "true or false"
    elif not isinstance(value, bool):
        try:
            array = np.asarray(value, np.float32)
        except (TypeError, ValueError):
            array = np.array(np.nan)
        if array.shape == shape and np.isfinite(array).all():
            return jnp.asarray(array, jnp.asarray(default).dtype)
    raise InputError(f"evolution.strategy_params.{key}", kind, repr(value))
