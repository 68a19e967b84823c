"""A vector environment of Gymnasium.

`gymnasium` is an extra, `pip install 'gymnasium>=1.1'`, imported when the first environment is
made. All environments are stepped in one compiled call.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from enum import Enum
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.environment import (
    Environment,
    EnvironmentState,
    StepResult,
    choose,
    make_environment,
)
from mjx_revolve.episodes.fitness import Fitness, make_fitness
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.packages import check_package
from mjx_revolve.numerics.xla import LANES, jit, on_cpu

AUTORESET_MODES = ("NextStep", "SameStep")
"""When an episode that is over begins anew, by Gymnasium's names."""


def _next_step(
    environment: Environment, state: EnvironmentState, action: jax.Array
) -> tuple[EnvironmentState, jax.Array, StepResult, jax.Array]:
    """A control period; episodes that were over before it are restarted instead, without reward.

    Returns:
        The state, `[k, lanes]` observations, the result, and the observations again.
    """
    over = state.ended
    moved, outcome = environment.step(state, action)
    nothing = jax.tree.map(jnp.zeros_like, outcome)
    state, outcome = jax.lax.cond(
        jnp.any(over),
        lambda: choose(
            over, (environment.start(state.seed, state.episode + 1), nothing), (moved, outcome)
        ),
        lambda: (moved, outcome),
    )
    state, seen = environment.observe(state)
    return state, seen, outcome, seen


@lru_cache(maxsize=1)
def _make_class() -> type:
    """The subclass of Gymnasium's `VectorEnv`, which is imported late."""
    from gymnasium.error import ResetNeeded
    from gymnasium.spaces import Box
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space

    class WaterVectorEnv(VectorEnv):
        """Environments of one robot in one water; see `make_vector_env`."""

        def __init__(self, fitness: Fitness, environment: Environment, num_envs: int, mode: str):
            self.fitness, self.environment, self.num_envs = fitness, environment, num_envs
            self.autoreset_mode = AutoresetMode(mode)
            self.control_rate = environment.control_rate
            self.observation_names = environment.observation_names
            self.action_names = environment.action_names
            self.metadata = {
                "render_modes": [],
                "render_fps": self.control_rate,
                "autoreset_mode": self.autoreset_mode,
            }
            seen, done = len(self.observation_names), len(self.action_names)
            self.single_observation_space = Box(-1.0, 1.0, (seen,), np.float32)
            self.single_action_space = Box(-1.0, 1.0, (done,), np.float32)
            self.observation_space = batch_space(self.single_observation_space, num_envs)
            self.action_space = batch_space(self.single_action_space, num_envs)
            # Chunks of fixed shape, as those of a fitness: an environment's results do not
            # depend on the number or the state of others.
            self._lanes = LANES if on_cpu() else num_envs
            self._chunks = -(-num_envs // self._lanes)
            self._state: EnvironmentState | None = None
            self._seen = np.zeros((num_envs, seen), np.float32)
            same = mode == "SameStep"
            advance = environment.step_and_restart if same else partial(_next_step, environment)

            def step(state: EnvironmentState, actions: jax.Array) -> PyTree:
                found = jax.lax.map(lambda given: advance(*given), (state, self._split(actions)))
                state, seen, outcome, last = found
                return state, self._join(seen), jax.tree.map(self._join, outcome), self._join(last)

            def begin(seed: jax.Array, episode: jax.Array) -> PyTree:
                given = self._split(seed), self._split(episode)
                state, seen = jax.lax.map(lambda given: environment.begin(*given), given)
                return state, self._join(seen)

            def resume(mask: jax.Array, new: PyTree, old: PyTree) -> PyTree:
                return jax.vmap(choose)(self._split(mask), new, old)

            self._step = jit(step, donate_argnums=0)
            self._begin, self._resume = jit(begin), jit(resume)

        def _split(self, x: jax.Array) -> jax.Array:
            """`[num_envs, ...]` as `[chunks, ..., lanes]`, copies of the first behind them."""
            padding = self._chunks * self._lanes - self.num_envs
            if padding:
                x = jnp.concatenate([x, jnp.repeat(x[:1], padding, 0)])
            return jnp.moveaxis(x.reshape(self._chunks, self._lanes, *x.shape[1:]), 1, -1)

        def _join(self, x: jax.Array) -> jax.Array:
            """The inverse of `_split`."""
            x = jnp.moveaxis(x, -1, 1)
            return x.reshape(-1, *x.shape[2:])[: self.num_envs]

        def reset(
            self,
            *,
            seed: int | Sequence[int | None] | None = None,
            options: dict[str, object] | None = None,
        ) -> tuple[np.ndarray, dict[str, object]]:
            """Begins episodes.

            Args:
                seed: a whole number, of the first environment, the next one's is one higher; or one
                    for each; None, for all or for one: the next episode of the environment's own
                    seed, at first drawn by the operating system.
                options: `{"reset_mask": [num_envs] of bool}` for some of them only.

            Returns:
                `[num_envs, k]` observations, and {}.

            Raises:
                InputError: the seed or the mask is wrong.
            """
            mask = self._read_mask(options)
            if self._state is None:
                seeds = self._read_seeds(int(self.np_random.integers(2**32)))
                episodes = np.zeros(self.num_envs, np.int32)
            else:
                seeds = np.asarray(self._join(self._state.seed), np.int64)
                episodes = np.asarray(self._join(self._state.episode)) + 1
            if seed is not None:
                given = self._read_seeds(seed)
                seeds = np.where(given < 0, seeds, given)
                episodes = np.where(given < 0, episodes, 0)
                super().reset(seed=int(seeds[0]))
            state, seen = self._begin(jnp.asarray(seeds, jnp.uint32), jnp.asarray(episodes))
            if mask is not None and self._state is not None:
                chosen = jnp.asarray(mask)
                old = self._state, self._split(jnp.asarray(self._seen))
                both = self._resume(chosen, (state, self._split(seen)), old)
                state, seen = both[0], self._join(both[1])
            self._state, self._seen = state, np.array(seen, np.float32)
            return self._seen.copy(), {}

        def _read_seeds(self, seed: int | Sequence[int | None]) -> np.ndarray:
            """`[num_envs]` seeds, -1 for None."""

            def fits(x: Any) -> bool:
                whole = isinstance(x, int | np.integer) and not isinstance(x, bool)
                return x is None or (whole and 0 <= x < 2**32)

            given: Any = seed
            if hasattr(seed, "dtype"):
                with contextlib.suppress(TypeError):  # a key of JAX
                    given = np.asarray(seed).tolist()
            several = isinstance(given, Sequence) and not isinstance(given, str | bytes)
            each = list(given) if several else [given]
            if not all(map(fits, each)) or len(each) != (self.num_envs if several else 1):
                wanted = f"a whole number from 0 to {2**32 - 1}, or {self.num_envs} of them"
                raise InputError("seed", wanted, repr(seed))
            found = np.array([-1 if x is None else int(x) for x in each])
            return found if several else (found + np.arange(self.num_envs)) % 2**32

        def _read_mask(self, options: Mapping[str, object] | None) -> np.ndarray | None:
            if not options or "reset_mask" not in options:
                return None
            mask = np.asarray(options["reset_mask"])
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
                found = f"{list(mask.shape)} of {mask.dtype}"
                raise InputError("options: reset_mask", f"[{self.num_envs}] of bool", found)
            return mask

        def step(
            self, actions: ArrayLike
        ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, object]]:
            """A control period of all environments.

            Args:
                actions: `[num_envs, n]` between -1 and 1; see `Environment.step`.

            Returns:
                `[num_envs, k]` observations, `[num_envs]` rewards, terminated (the rollout blew
                up), truncated (the episode's time is over), and infos: `score` where one of these
                is true, in `final_info` beside `final_obs` in mode SameStep.

            Raises:
                InputError: the actions have another shape.
                gymnasium.error.ResetNeeded: `reset` was not called.
            """
            if self._state is None:
                raise ResetNeeded("expected a call of reset before step")
            given = jnp.asarray(actions, jnp.float32)
            shape = (self.num_envs, len(self.action_names))
            if given.shape != shape:
                raise InputError("actions", list(shape), list(given.shape))
            self._state, seen, outcome, last = self._step(self._state, given)
            self._seen = np.array(seen, np.float32)
            terminated, truncated = np.array(outcome.terminated), np.array(outcome.truncated)
            infos: dict[str, object] = {}
            over = terminated | truncated
            if over.any():
                score = np.where(over, np.asarray(outcome.score), 0.0)
                infos = {"score": score, "_score": over.copy()}
                if self.autoreset_mode == AutoresetMode.SAME_STEP:
                    final = np.where(over[:, None], np.asarray(last, np.float32), np.float32(0))
                    infos = {"final_obs": final, "_final_obs": over.copy(),
                             "final_info": infos, "_final_info": over.copy()}  # fmt: skip
            rewards = np.asarray(outcome.reward).astype(np.float64)
            return self._seen.copy(), rewards, terminated, truncated, infos

        def close_extras(self, **kwargs: object) -> None:
            """Lets go of the state."""
            self._state = None

        def __repr__(self) -> str:
            """A line: `WaterVectorEnv(directed_swim in lake, 64 of them at 20 Hz)`."""
            where = self.fitness.config.subject
            return f"WaterVectorEnv({where}, {self.num_envs} of them at {self.control_rate:g} Hz)"

    return WaterVectorEnv


def make_vector_env(
    config: Config | str | Path | Mapping[str, object],
    num_envs: int = LANES,
    *,
    sensors: Sequence[object] | None = None,
    control_rate: float | None = None,
    autoreset_mode: str | Enum = "NextStep",
    **overrides: object,
) -> Any:
    """A `gymnasium.vector.VectorEnv` of a configuration: its robot, its water, its task.

    Observations `[num_envs, k]` are outputs of sensors, each between -1 and 1: those of the robot
    as a whole, then joint after joint, in the order of `observation_names`. Actions `[num_envs, n]`
    are between -1 and 1, the ends of the range of each hinge's targets and each thruster's
    commands, in the order of `action_names`.
    Rewards add up to the task's score (see `environment`). An episode is truncated after
    `task.duration`, and terminated if it blows up, which costs `scoring.WORST`. `task.trials` and
    the rest of `controller` do not matter.

    Args:
        config: a `Config`, the path of a YAML file, a shipped configuration's name, or a mapping.
        num_envs: number of environments; on a CPU, multiples of 64 are most efficient.
        sensors: names of kinds or mappings, as in `controller.sensors`; by default those of the
            configuration, or else the robot's own, or else `sensors.DEFAULT_SENSORS`.
        control_rate: actions in a second [Hz]; by default the possible one nearest to 20.
        autoreset_mode: `NextStep`, Gymnasium's default: an episode that is over restarts at the
            next step, which ignores the action; or `SameStep`: at once, with its last observation
            in infos. Gymnasium's `AutoresetMode` does as well.
        **overrides: as `make_fitness` takes them.

    Returns:
        The environments. The same seed gives the same numbers, bit for bit, on one kind of
        processor; environment i depends on its seed and its actions alone.

    Raises:
        InputError: gymnasium is not installed, the configuration is wrong, or it evolves bodies.
    """
    check_package("make_vector_env", "gymnasium")
    whole = isinstance(num_envs, int | np.integer) and not isinstance(num_envs, bool)
    if not whole or num_envs < 1:
        raise InputError("num_envs", "a whole number >= 1", repr(num_envs))
    if isinstance(autoreset_mode, Enum):
        autoreset_mode = autoreset_mode.value
    if autoreset_mode not in AUTORESET_MODES:
        known = f"one of {', '.join(AUTORESET_MODES)}"
        raise InputError("autoreset_mode", known, repr(autoreset_mode))
    fitness = make_fitness(config, **overrides)
    environment = make_environment(fitness, control_rate, sensors)
    return _make_class()(fitness, environment, int(num_envs), autoreset_mode)
