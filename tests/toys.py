"""Fitnesses that cost nothing and that worker processes can import by name, and a config."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.evolution.body_fitness import BodyFitness, make_body_fitness

# In metrics.csv, all but these is reproducible.
CLOCK = ("seconds", "evaluations_per_second")


def write_config(path: Path, **evolution) -> Path:
    """Writes a configuration for any of them, beside the robot that it names; 7 generations."""
    (path.parent / "robot.yaml").write_text("id: robot\n")
    data = {
        "morphology": "robot.yaml",
        "world": "lake",
        "task": {"type": "speed"},
        "evolution": {"strategy": "SNES", "generations": 7} | evolution,
    }
    path.write_text(json.dumps(data))
    return path


class Quadratic:
    """The higher, the nearer to a target; noise by key, the same for all, as with real starts."""

    def __init__(self, num_genes=5, noise=0.0):
        self.num_genes = num_genes
        self.target = np.linspace(-1, 1, num_genes).astype(np.float32)
        self.noise = noise

    def evaluate(self, population, key):
        distance = jnp.sum((population - self.target) ** 2, axis=1)
        return self.noise * jax.random.normal(key) - distance, {"distance_m": jnp.sqrt(distance)}


class Toy:
    """The higher, the nearer to a target, in blocks of 4; noise by key, as real starts have it."""

    num_genes = 5
    block_size: int | None = 4

    def __init__(self) -> None:
        self.target = np.linspace(-1, 1, self.num_genes).astype(np.float32)

    def evaluate(self, population, key):
        distance = jnp.sum((population - self.target) ** 2, axis=1)
        # Rows see one another's places, as padded rows must not.
        noise = 0.1 * jax.random.normal(key, (self.num_genes,))
        return jnp.tanh(population @ noise) - distance, {"distance_m": jnp.sqrt(distance)}


def make_toy(config):
    return Toy()


class SlowToy(Toy):
    def evaluate(self, population, key):
        time.sleep(0.02)
        return super().evaluate(population, key)


def make_slow(config):
    return SlowToy()


class TroubledToy(Toy):
    """Gets into trouble once: $TOY_TROUBLE is `kill`, `stop`, `raise` or `exit`, then `:FILE`.

    The file says that it has happened already.
    """

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def evaluate(self, population, key):
        self.count += 1
        kind, _, path = os.environ["TOY_TROUBLE"].partition(":")
        if self.count == 8 and not Path(path).exists():
            Path(path).write_text(str(os.getpid()))
            match kind:
                case "kill":
                    os.kill(os.getpid(), signal.SIGKILL)
                case "stop":
                    os.kill(os.getpid(), signal.SIGSTOP)
                case "raise":
                    raise FloatingPointError("all is lost\nreally")
                case "exit":
                    os.write(2, b"out of luck\n")
                    os._exit(3)
        return super().evaluate(population, key)


def make_troubled(config):
    return TroubledToy()


def make_broken(config):
    """Can be built by the leader only."""
    if os.environ.get("TOY_LEADER") != str(os.getpid()):
        raise RuntimeError("no such luck")
    return Toy()


def write_bodies_config(path: Path, bodies=(), **evolution) -> Path:
    """Writes a configuration of evolving bodies for `make_toy_bodies`; 5 generations of 6."""
    data = {
        "world": "empty_underwater",
        "controller": {"type": "sine"},
        "task": {"type": "speed", "duration": 1.0, "settle": 0.2, "trials": 1},
        "bodies": {"max_modules": 8, "max_hinges": 4} | dict(bodies),
        "evolution": {"population_size": 6, "generations": 5, "checkpoint_every": 1} | evolution,
    }
    path.write_text(json.dumps(data))
    return path


class BodyToy(BodyFitness):
    """Bodies are to have three hinges, and all their genes are to be a half."""

    block_size = 8

    def evaluate(self, bodies, which, genes, key):
        hinges = np.array([body.num_hinges for body in bodies])[np.asarray(which)]
        own = np.zeros(np.shape(genes), bool)
        for row, k in enumerate(np.asarray(which)):
            own[row, self.layout(bodies[k]).columns] = True
        away = np.sum(np.where(own, np.asarray(genes) - 0.5, 0) ** 2, 1) / own.sum(1)
        noise = 0.01 * np.asarray(jax.random.normal(key))
        names = dict.fromkeys(self.measured, np.asarray(hinges, np.float32))
        return -((hinges - 3.0) ** 2) - away + noise, names

    def single(self, path):
        """What nothing can be replayed with."""
        return object()


def make_toy_bodies(config):
    made = make_body_fitness(config)
    return BodyToy(made.config, made.genotype, made.mixed, made.brains, made.seeds)
