"""Fitnesses that cost nothing and that worker processes can import by name, and a config."""

import contextlib
import itertools
import json
import os
import signal
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.evolution.body_fitness import BodyFitness, make_body_fitness
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.run_folder import RunFolder

# In metrics.csv, all but these is reproducible.
CLOCK = ("seconds", "evaluations_per_second")

# A configuration: five robots in a small arena, with a charger.
COLONY = {
    "trim": "neutral",
    "world": {"name": "empty_underwater", "bed": False, "drag": "ellipsoid", "timestep": 0.0125},
    "controller": {"type": "sine"},
    "task": {"type": "speed", "duration": 2.0, "settle": 0.5, "trials": 1, "depth": 1.0},
    "bodies": {
        "max_modules": 5, "max_hinges": 2, "brains": {"inheritance": "darwinian", "std_init": 1.0},
    },
    "colony": {
        "interval": 4.0, "look": 0.5, "arena": {"size": 2.5, "depth": 3.0},
        "birth": {"radius": 1.0, "gestation": 6.0, "initial": 5, "least": 3},
        "mating": {"distance": 0.9, "likeness": 0.1, "adult": 3.0, "children": 2},
        "life": {"window": 4.0, "max_age": 40.0, "childhood": 12.0, "full_fitness": 0.2},
        "energy": {"start": 5.0, "capacity": 8.0, "idle": 0.2, "chargers": [[0, 0, -1]]},
    },
    "evolution": {
        "population_size": 8, "generations": 12, "checkpoint_every": 5, "seed": 3,
        "passport": False,
    },
}  # fmt: skip


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


def enter_folder(path: Path, monkeypatch, **evolution) -> Path:
    """A folder with a configuration, current."""
    monkeypatch.chdir(path)
    write_config(path / "toy.yaml", **{"population_size": 8, "checkpoint_every": 2} | evolution)
    return path


def contents(folder: Path) -> tuple:
    """What must be the same, to the last bit, for two runs of the same seed."""
    run = RunFolder(folder)
    tables = [
        {name: a.tobytes() for name, a in table.items() if name not in CLOCK}
        for table in (run.load_metrics(), run.load_checkpoint().arrays)
    ]
    genes = (folder / "champion" / "genes.yaml").read_text()
    return tables, genes, run.info.get("champion")


class DroppedError(Exception):
    """Stands for kill -9: nothing that the program does at its end happens."""


def dropping(evaluation: int, make=None):
    """Makes a fitness that drops the process at an evaluation; by default a noisy `Quadratic`."""
    count = itertools.count(1)

    def make_fitness(config):
        fitness = make(config) if make else Quadratic(noise=0.1)
        evaluate = fitness.evaluate

        def drop(population, key):
            if next(count) == evaluation:
                raise DroppedError
            return evaluate(population, key)

        fitness.evaluate = drop
        return fitness

    return make_fitness


def wait_for(condition, seconds=300.0) -> None:
    """Waits until a condition holds."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def read_until(process, words: str) -> list[str]:
    """What a process has printed up to a line with some words; one that hangs is killed."""
    lines, clock = [], threading.Timer(120.0, process.kill)
    clock.start()
    for line in process.stdout:
        lines.append(line)
        if words in line:
            clock.cancel()
            return lines
    raise AssertionError("".join(lines))


class Quadratic:
    """The higher, the nearer to a target; noise by key, the same for all, as with real starts."""

    def __init__(self, num_genes=5, noise=0.0):
        self.num_genes = num_genes
        self.target = np.linspace(-1, 1, num_genes).astype(np.float32)
        self.noise = noise

    def evaluate(self, population, key):
        distance = jnp.sum((population - self.target) ** 2, axis=1)
        return self.noise * jax.random.normal(key) - distance, {"distance_m": jnp.sqrt(distance)}


class Toy(Quadratic):
    """The same in blocks of 4; noise by key, another for each place, as real starts have it."""

    block_size: int | None = 4

    def evaluate(self, population, key):
        scores, measures = super().evaluate(population, key)
        # Rows see one another's places, as padded rows must not.
        noise = 0.1 * jax.random.normal(key, (self.num_genes,))
        return jnp.tanh(population @ noise) + scores, measures


def make_toy(config):
    return Toy()


class SlowToy(Toy):
    def evaluate(self, population, key):
        time.sleep(0.05)
        return super().evaluate(population, key)


def make_slow(config):
    return SlowToy()


class TroubledToy(SlowToy):
    """Does once what the file $TOY_TROUBLE says, if there is one; dies of a gene above 100."""

    def evaluate(self, population, key):
        if np.max(population) > 100:
            os.kill(os.getpid(), signal.SIGKILL)
        order = Path(os.environ["TOY_TROUBLE"])
        mine = order.with_suffix(f".{os.getpid()}")
        with contextlib.suppress(FileNotFoundError):
            order.rename(mine)  # for one worker only
            match mine.read_text():
                case "kill":
                    os.kill(os.getpid(), signal.SIGKILL)
                case "stop":
                    os.kill(os.getpid(), signal.SIGSTOP)
                case "hang":
                    time.sleep(3600)
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

    def evaluate(self, genes, which, bodies, key):
        hinges = np.array([body.num_hinges for body in bodies])[np.asarray(which)]
        own = np.zeros(np.shape(genes), bool)
        for row, k in enumerate(np.asarray(which)):
            own[row, self.layout(bodies[k]).columns] = True
        away = np.sum(np.where(own, np.asarray(genes) - 0.5, 0) ** 2, 1) / own.sum(1)
        noise = 0.01 * np.asarray(jax.random.normal(key))
        names = dict.fromkeys(self.measure_names, np.asarray(hinges, np.float32))
        return -((hinges - 3.0) ** 2) - away + noise, names

    def body_fitness(self, body):
        """An object that no replay can use."""
        return object()


def make_toy_bodies(config):
    made = make_body_fitness(config)
    return BodyToy(made.config, made.genotype, made.mixed, made.brains, made.seeds)


def check_scores(executor: Executor, seed: int, size: int = 22) -> None:
    """The same bits as in this process."""
    population = np.random.default_rng(seed).normal(size=(size, 5)).astype(np.float32)
    key = jax.random.key(seed)
    scores, measures = executor.evaluate(population, key)
    alone, alone_measures = Executor(Toy(), 4).evaluate(population, key)
    assert scores.dtype == np.float32 and scores.shape == (size,)
    assert measures.keys() == alone_measures.keys() == {"distance_m"}
    assert scores.tobytes() == alone.tobytes()
    assert measures["distance_m"].tobytes() == alone_measures["distance_m"].tobytes()
