"""A pure environment of one robot, with `reset` and `step` as in brax.

Both can be jitted, vmapped and scanned. Under `jax.vmap` the batch becomes the lanes of our step;
states have the environments on the first axis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import PyTree

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.environment import Environment, EnvironmentState, make_environment
from mjx_revolve.episodes.fitness import make_fitness
from mjx_revolve.episodes.starts import check_key
from mjx_revolve.inputs.errors import InputError


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WaterState:
    """State of an environment, with brax's names.

    Attributes:
        pipeline_state: of the episode.
        obs: `[k]` observation, between -1 and 1.
        reward: of the last step; 0 after `reset`.
        done: 1.0 if the last step ended the episode, else 0.0.
        metrics: `score`: the task's so far; at the end, the episode's.
        info: `truncation`: 1.0 if the episode's time is over; entries of wrappers are kept.
    """

    pipeline_state: EnvironmentState
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)

    def replace(self, **changes: Any) -> WaterState:
        """The state with some fields changed."""
        return replace(self, **changes)


def _of_one(run: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """A function of lanes as a function of a single lane; `jax.vmap` maps batches to lanes."""

    @custom_vmap
    def single(*given: PyTree) -> PyTree:
        lane = jax.tree.map(lambda x: x[..., None], given)
        return jax.tree.map(lambda x: x[..., 0], run(*lane))

    @single.def_vmap
    def batch(size: int, batched: PyTree, *given: PyTree) -> PyTree:
        whole = jax.tree.map(
            lambda x, is_batched: x if is_batched else jnp.broadcast_to(x, (size, *x.shape)),
            given, tuple(batched),
        )  # fmt: skip
        lanes = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), whole)
        found = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), run(*lanes))
        return found, jax.tree.map(lambda _: True, found)

    return single


class FunctionalEnv:
    """See `make_functional_env`.

    Attributes:
        environment: that it steps.
        observation_size: numbers of an observation; `environment.observation_names` has them.
        action_size: numbers of an action; `environment.action_names` has them.
        backend: of the physics; part of brax's interface.
    """

    backend = "mjx_revolve"

    def __init__(self, environment: Environment, auto_reset: bool) -> None:
        """Keeps what it steps."""
        self.environment = environment
        self.observation_size = len(environment.observation_names)
        self.action_size = len(environment.action_names)

        def advance(state: PyTree, action: jax.Array) -> PyTree:
            if auto_reset:
                return environment.step_and_restart(state, action)[:3]
            moved, result = environment.step(state, action)
            moved, seen = environment.observe(moved)
            return moved, seen, result

        self._begin, self._advance = _of_one(environment.begin), _of_one(advance)

    @property
    def unwrapped(self) -> FunctionalEnv:
        """The environment itself; part of brax's interface."""
        return self

    def reset(self, rng: jax.Array) -> WaterState:
        """An episode's start, which follows from the key alone."""
        check_key(rng)
        # 32 bits with x64, too: more are no seed of `make_vector_env`.
        state, seen = self._begin(jax.random.bits(rng, (), "uint32"), jnp.int32(0))
        zero = jnp.zeros((), seen.dtype)
        return WaterState(state, seen, zero, zero, {"score": zero}, {"truncation": zero})

    def step(self, state: WaterState, action: jax.Array) -> WaterState:
        """A control period with an action `[action_size]` between -1 and 1."""
        action = jnp.asarray(action)
        if action.ndim != 1:
            raise InputError("action", f"{self.action_size} numbers", list(action.shape))
        after, seen, result = self._advance(state.pipeline_state, action)
        done = (result.terminated | result.truncated).astype(seen.dtype)
        return WaterState(
            after, seen, result.reward, done, {**state.metrics, "score": result.score},
            {**state.info, "truncation": result.truncated.astype(seen.dtype)},
        )  # fmt: skip


def make_functional_env(
    config: Config | str | Path | Mapping[str, object],
    *,
    sensors: Sequence[object] | None = None,
    control_rate: float | None = None,
    auto_reset: bool = False,
    **overrides: object,
) -> FunctionalEnv:
    """A pure environment of a configuration: `state = env.reset(key)`, `env.step(state, action)`.

    Observations, actions, rewards and episodes are those of `make_vector_env`. In batches, on a
    CPU, `jax.vmap` over multiples of 64 makes the most of it.

    Args:
        config: as `make_fitness` takes it.
        sensors: as in `make_vector_env`.
        control_rate: as in `make_vector_env` [Hz].
        auto_reset: an episode that is over begins anew in the same step, as the next one of its
            key; if false, the caller resets it.
        **overrides: as `make_fitness` takes them.

    Returns:
        The environment.

    Raises:
        InputError: the configuration is wrong, or evolves bodies.
    """
    fitness = make_fitness(config, **overrides)
    return FunctionalEnv(make_environment(fitness, control_rate, sensors), auto_reset)
