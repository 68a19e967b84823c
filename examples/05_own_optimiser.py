"""An evolution strategy written out in JAX: ask, evaluate and tell inside one jitted function."""

import jax
import jax.numpy as jnp

from mjx_revolve import make_fitness

POPULATION, PARENTS = 64, 16
fitness = make_fitness(
    "lake_swim",
    **{"task.duration": 4.0, "task.settle": 1.0, "task.horizon": None, "task.trials": 1},
)


@jax.jit
def generation(mean, std, key):
    """One generation: the mean of the best becomes the next mean."""
    ask, evaluate = jax.random.split(key)
    population = mean + std * jax.random.normal(ask, (POPULATION, fitness.num_genes))
    scores = fitness(population, evaluate)
    best = jnp.argsort(scores)[-PARENTS:]
    return population[best].mean(0), 0.97 * std, scores


mean, std = jnp.zeros(fitness.num_genes), jnp.array(0.7)
for number in range(10):
    mean, std, scores = generation(mean, std, jax.random.key(number))
    if number in (0, 4, 9):
        print(f"generation {number + 1}: mean {scores.mean():.3f}, best {scores.max():.3f}")
