"""A gradient through sensors, brain, servos and water: truncated backpropagation through time."""

import jax
import optax

from mjx_revolve import make_fitness
from mjx_revolve.episodes import make_windows

settings = {"task.duration": 6.0, "task.settle": 0.0, "task.trials": 4}
# What counts is the way swum, in one water: where it would get to in two minutes, as fish_swim has
# it, depends so much on how it turns that three windows learn little.
settings |= {"task.horizon": None, "task.robust": None}
fitness = make_fitness("fish_swim", **settings)
windows = make_windows(fitness, horizon=2.0)  # three windows of two seconds each
genes = 0.3 * jax.random.normal(jax.random.key(0), (4, fitness.num_genes))
optimiser = optax.adam(0.05)
memory = optimiser.init(genes)
for episode in range(12):
    episodes = windows.init(genes, jax.random.key(episode))
    gain = 0.0
    for _ in range(windows.count):
        gradients, episodes = windows.step(genes, episodes)  # .gain [4, 4], .gradient [4, 4, genes]
        change, memory = optimiser.update(-gradients.gradient.mean(1), memory)
        genes = optax.apply_updates(genes, change)
        gain += float(gradients.gain.mean())
    print(f"episode {episode + 1}: mean score {gain:+.3f}")
