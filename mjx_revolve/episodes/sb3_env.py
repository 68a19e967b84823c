"""The vector environment with Stable-Baselines3's interface.

`stable_baselines3` is an extra, imported when the first environment is made.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.vector_env import make_vector_env
from mjx_revolve.inputs.packages import check_package
from mjx_revolve.numerics.xla import LANES


@lru_cache(maxsize=1)
def _make_class() -> type:
    """The subclass of Stable-Baselines3's `VecEnv`, which is imported late."""
    from stable_baselines3.common.vec_env import VecEnv

    class WaterVecEnv(VecEnv):
        """See `make_sb3_env`."""

        def __init__(self, env: Any) -> None:
            self.env = env
            self.actions: np.ndarray | None = None
            super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

        def reset(self) -> np.ndarray:
            """Begins episodes, of the seeds of `seed` if it was called since the last time."""
            seeds = None if self._seeds[0] is None else self._seeds
            self._reset_seeds()
            return self.env.reset(seed=seeds)[0]

        def step_async(self, actions: np.ndarray) -> None:
            """Keeps the actions of the next step."""
            self.actions = actions

        def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
            """A control period; an episode's `score` in the info of its last."""
            seen, rewards, terminated, truncated, infos = self.env.step(self.actions)
            each: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
            for i in np.flatnonzero(terminated | truncated):
                each[i] = {
                    "terminal_observation": infos["final_obs"][i],
                    "TimeLimit.truncated": bool(truncated[i]),
                    "score": infos["final_info"]["score"][i],
                }
            return seen, rewards.astype(np.float32), terminated | truncated, each

        def close(self) -> None:
            """Lets go of the state."""
            self.env.close()

        def get_attr(self, attr_name: str, indices: object = None) -> list[Any]:
            """An attribute, the same for all of them."""
            return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

        def set_attr(self, attr_name: str, value: object, indices: object = None) -> None:
            """Not supported: there are no single environments."""
            raise NotImplementedError

        def env_method(
            self, method_name: str, *args: object, indices: object = None, **kw: object
        ) -> Any:
            """Not supported: there are no single environments."""
            raise NotImplementedError

        def env_is_wrapped(self, wrapper_class: object, indices: object = None) -> list[bool]:
            """False for all."""
            return [False] * len(list(self._get_indices(indices)))

    return WaterVecEnv


def make_sb3_env(
    config: Config | str | Path | Mapping[str, object], num_envs: int = LANES, **settings: Any
) -> Any:
    """A `VecEnv` of Stable-Baselines3, for its PPO, SAC and others.

    Args:
        config: as in `make_vector_env`.
        num_envs: how many environments.
        **settings: as in `make_vector_env`, but for `autoreset_mode`: it is SameStep.

    Returns:
        The environments.

    Raises:
        InputError: stable-baselines3 or gymnasium is not installed, or a setting is wrong.
    """
    check_package("make_sb3_env", "stable_baselines3")
    return _make_class()(make_vector_env(config, num_envs, autoreset_mode="SameStep", **settings))
