"""A pure environment, as brax and gymnax have them: whole episodes in one compiled scan."""

import jax
import jax.numpy as jnp

from mjx_revolve.episodes import make_functional_env

env = make_functional_env(
    "fish_swim", **{"task.duration": 2.0, "task.settle": 0.5, "task.horizon": None}
)
steps = env.environment.num_steps


def episode(weights, key):
    """The score of a linear policy."""

    def step(state, _):
        action = jnp.tanh(state.obs @ weights)
        return env.step(state, action), state.reward

    last, _ = jax.lax.scan(step, env.reset(key), length=steps)
    return last.metrics["score"]


weights = jax.random.normal(jax.random.key(0), (64, env.observation_size, env.action_size))
keys = jax.random.split(jax.random.key(1), 64)
scores = jax.jit(jax.vmap(episode))(weights, keys)
print(f"{steps} steps, 64 random policies: best score {scores.max():.3f}")
