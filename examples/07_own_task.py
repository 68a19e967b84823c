"""A task of one's own, named in a configuration by file: swim in a circle around the start."""

import jax.numpy as jnp
import numpy as np

from mjx_revolve import make_fitness
from mjx_revolve.episodes import Task


def circle(track, settings):
    """Turns around the vertical through the start, per second [1/s]."""
    x, y = (track.position - track.position[0])[:, :2].transpose(1, 0, 2)  # [time, lanes] [m]
    # Area swept around the start; sqrt with a tiny term keeps gradients finite at the start.
    swept = 0.5 * jnp.sum(x[:-1] * y[1:] - x[1:] * y[:-1], axis=0)
    radius = jnp.mean(jnp.sqrt(x**2 + y**2 + 1e-9), axis=0)
    return swept / (jnp.pi * radius**2) / track.duration


task = Task(circle, "1/s")  # `records=("joints",)` would add joint angles to the track

if __name__ == "__main__":
    import jax

    own = {"task.type": f"{__file__}:task", "task.duration": 4.0, "task.horizon": None}
    fitness = make_fitness("lake_swim", **own)
    genes = np.random.default_rng(0).normal(0, 0.5, (64, fitness.num_genes))
    scores, measures = fitness.evaluate(genes, jax.random.key(0))
    print(f"best of 64 random gaits: {scores.max():.3f} turns/s; measures: {', '.join(measures)}")
