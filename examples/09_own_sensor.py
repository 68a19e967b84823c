"""Closed loop: sensors with noise, rate and delay, read by a network that all joints share."""

import jax
import numpy as np

from mjx_revolve import make_fitness

settings = {
    "task.duration": 4.0,
    "task.horizon": None,
    "task.trials": 1,
    "controller.type": "mlp",
    "controller.gain": 2.0,  # the default: that of the oscillators that this replaces is another
    "controller.hidden": 8,
    "controller.sensors": [
        {"type": "angle"},
        {"type": "depth", "range": [0, 2], "noise": 0.01},
        {"type": "gyro", "rate": 20, "delay": 0.05},
    ],
}
fitness = make_fitness("lake_swim", **settings)
genes = 0.3 * np.random.default_rng(0).normal(size=(64, fitness.num_genes))
scores = fitness(genes, jax.random.key(0))
print(f"{fitness.num_genes} weights, best of 64 random networks {scores.max():.3f}")
