"""A controller of one's own: a travelling wave in four genes that drives any body."""

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve import make_fitness
from mjx_revolve.control import Gene, make_controller


def make_wave(plant, settings):
    """Joints swing alike, each later than the last."""

    def decode(genes, plant):  # genes: [4, lanes]
        swing, rate, lag, turn = jnp.sin(genes)  # in -1 to 1, however large the genes become
        frequency = settings.max_frequency * (1 + rate) / 2  # Hz
        phase = np.pi * lag * plant.source  # `source`: the robot's number of each row's joint
        return swing, frequency, phase, turn, plant.middle(genes), plant.reach(genes)

    def step(parameters, state, time, sense):
        swing, frequency, phase, turn, middle, reach = parameters
        wave = swing * jnp.sin(2 * np.pi * frequency * time - phase)
        return state, middle + reach * jnp.clip(wave + turn, -1, 1)  # joint targets [rad]

    genes = [Gene(name, "robot") for name in ("swing", "rate", "lag", "turn")]
    return make_controller(plant, genes, decode, lambda parameters: (), step)


if __name__ == "__main__":
    wave = {"controller.type": f"{__file__}:make_wave", "task.duration": 4.0, "task.horizon": None}
    fitness = make_fitness("lake_swim", morphology="snake", **wave)  # or any other body
    genes = np.random.default_rng(0).normal(0, 1, (64, fitness.num_genes))
    scores = fitness(genes, jax.random.key(0))
    print(f"best of 64 waves: {scores.max():.3f} body lengths/s")
