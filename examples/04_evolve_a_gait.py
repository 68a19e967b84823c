"""CMA-ES of the library `cma` on the fitness of a shipped configuration."""

import cma
import jax
import numpy as np

from mjx_revolve import make_fitness, prepare_process

prepare_process()  # compiled programs are kept for the next time
# So short an episode counts as it is: a horizon asks where a gait leads in two minutes.
settings = {"task.duration": 5.0, "task.settle": 1.0, "task.horizon": None, "task.trials": 2}
fitness = make_fitness("fish_swim", **settings)

search = cma.CMAEvolutionStrategy(
    fitness.num_genes * [0.0], 0.5, {"popsize": 32, "seed": 1, "verbose": -9}
)
for generation in range(15):
    population = np.array(search.ask())  # [32, num_genes]
    scores = np.asarray(fitness(population, jax.random.key(generation)))  # higher is better
    search.tell(population, list(-scores))
    if generation % 5 == 4:
        print(f"generation {generation + 1}: best {scores.max():.3f}, mean {scores.mean():.3f}")

# Judged on starts that the search never saw.
fresh = fitness(np.tile(search.mean, (32, 1)), jax.random.key(1000))
print(f"the mean of the search: {fresh[0]:.3f} body lengths/s")
