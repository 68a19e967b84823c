"""Gymnasium's ids of the shipped tasks: `gymnasium.make("mjx_revolve/LakeSwim-v0")`.

`register_envs()` registers them with Gymnasium, and so does importing this file, as
`gymnasium.make("mjx_revolve.episodes.gym_ids:mjx_revolve/LakeSwim-v0")` does. Nothing heavy is
imported before the first environment is made.
"""

from __future__ import annotations

import importlib.util
from functools import lru_cache
from typing import Any

import numpy as np

from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.packages import check_package

CONFIGS = (
    "auv_escape", "auv_follow_bed", "auv_follow_course", "auv_hold_depth", "auv_hold_heading",
    "auv_search", "fish_swim", "lake_swim", "lake_target",
)  # fmt: skip
"""Shipped configurations of one robot, each with an id."""


def env_id(config: str) -> str:
    """The id of a shipped configuration: of `lake_swim`, `mjx_revolve/LakeSwim-v0`."""
    return f"mjx_revolve/{config.title().replace('_', '')}-v0"


def register_envs() -> None:
    """Registers an id for each of `CONFIGS`, for `gymnasium.make` and `gymnasium.make_vec`.

    Raises:
        InputError: gymnasium is not installed.
    """
    check_package("register_envs", "gymnasium")
    from gymnasium.envs.registration import register, registry

    place = __name__.rpartition(".")[0]
    for config in CONFIGS:
        if env_id(config) not in registry:
            register(
                env_id(config),
                entry_point=f"{place}.gym_ids:make_env",
                vector_entry_point=f"{place}.vector_env:make_vector_env",
                kwargs={"config": config},
            )


def make_env(config: Any, **settings: Any) -> Any:
    """A single `gymnasium.Env`, with the arguments of `make_vector_env` but for those of many.

    On a CPU it costs as much as 64 environments. An episode that is over must be reset; `reset`
    without a seed begins the seed's next episode.

    Raises:
        InputError: there is a `num_envs` or an `autoreset_mode`, or a `render_mode` that is not
            None; otherwise as `make_vector_env`.
    """
    from mjx_revolve.episodes.vector_env import make_vector_env

    for name in ("num_envs", "autoreset_mode"):
        if name in settings:
            raise InputError(name, "none, as this is a single Env", show(settings[name]))
    if (mode := settings.pop("render_mode", None)) is not None:
        raise InputError("render_mode", "none, as nothing is drawn", show(mode))
    return _make_class()(make_vector_env(config, 1, **settings))


@lru_cache(maxsize=1)
def _make_class() -> type:
    """The subclass of Gymnasium's `Env`, which is imported late."""
    from gymnasium import Env

    class WaterEnv(Env):
        """One environment; see `make_env`."""

        def __init__(self, env: Any) -> None:
            self.env = env
            self.observation_space = env.single_observation_space
            self.action_space = env.single_action_space
            self.metadata = {"render_modes": [], "render_fps": env.control_rate}

        def reset(
            self, *, seed: int | None = None, options: dict[str, Any] | None = None
        ) -> tuple[np.ndarray, dict[str, Any]]:
            """Begins an episode; see `WaterVectorEnv.reset`."""
            super().reset(seed=seed)
            return self.env.reset(seed=seed)[0][0], {}

        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
            """A control period; `score` in the infos of the last."""
            seen, rewards, terminated, truncated, infos = self.env.step(np.asarray(action)[None])
            info = {"score": float(infos["score"][0])} if infos else {}
            return seen[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info

        def close(self) -> None:
            """Lets go of the state."""
            self.env.close()

    return WaterEnv


if importlib.util.find_spec("gymnasium") is not None:
    register_envs()
