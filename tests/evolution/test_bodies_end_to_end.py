"""The smallest run in which bodies evolve, with real water, from the command to the champion."""

import json

import jax
import numpy as np
import pytest

from mjx_revolve import evolve as command
from mjx_revolve.episodes.champion import load_episode
from mjx_revolve.episodes.config import load_config
from mjx_revolve.episodes.named_files import read_modules
from mjx_revolve.episodes.scoring import replay_key
from mjx_revolve.evolution.body_fitness import make_body_fitness
from mjx_revolve.evolution.coevolution import BodyEvolution
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.individuals import from_record
from mjx_revolve.evolution.learning import score_brains
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.shipped import find_shipped

CONFIG = {
    "world": "empty_underwater",
    "trim": "neutral",
    "controller": {"type": "sine"},
    "task": {"type": "speed", "duration": 0.5, "settle": 0.1, "trials": 1},
    "bodies": {"max_modules": 5, "max_hinges": 2, "learning": {"population_size": 3}},
    "evolution": {"population_size": 4, "generations": 2, "checkpoint_every": 1, "passport": False},
}


@pytest.mark.slow
def test_the_smallest_run(tmp_path, monkeypatch, capsys, no_pictures, quick_compiles):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.yaml").write_text(json.dumps(CONFIG))
    argv = ["small.yaml", "--out", "run", "--workers", "1"]
    assert run_command(command.main, argv) == 0
    assert "champion: " in capsys.readouterr().out
    individuals = [json.loads(line) for line in (tmp_path / "run" / "individuals.jsonl").open()]
    assert len(individuals) == 8 and sum(bool(person["parents"]) for person in individuals) == 4

    fitness = make_body_fitness(load_config("small.yaml"))
    executor = Executor(fitness, fitness.block_size)
    modules = read_modules(fitness.config)
    lived = [from_record(p, fitness.genotype, modules, fitness.brains.check) for p in individuals]
    for one in lived[::3]:
        key = jax.random.fold_in(jax.random.key(0), one.born)
        [(scores, measures)] = score(executor, one, jax.random.split(key)[0])
        assert scores[0] == one.score
        assert {name: float(x[0]) for name, x in measures.items()} == one.measures
        assert 0 <= one.measures["energy_j"] < 1

    # Alone the champion is stepped by another program, and by the one that users see replayed.
    episode = load_episode("run")
    key = replay_key(0)
    champion = next(one for one in lived if one.genes == tuple(map(float, episode.genes)))
    [(scores, measures)] = score(executor, champion, key)
    judged, found = episode.fitness.judge(episode.trajectory, key)
    assert judged == pytest.approx(scores[0], abs=1e-4)
    assert found.keys() == measures.keys()
    for name, value in measures.items():
        assert found[name] == pytest.approx(float(value[0]), rel=1e-3, abs=1e-4), name


def score(executor, one, key):
    """What somebody has learnt, scored by itself."""
    genes = np.zeros((1, executor.num_genes), np.float32)
    genes[0, executor.fitness.layout(one.body).columns] = one.genes
    return score_brains(executor, [one], [genes], key)


@pytest.mark.sampled(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", ["lake_coevolve", "bed_coevolve", "lake_map_elites"])
def test_shipped_configurations(name):
    config = load_config(find_shipped(name, "configs"))
    fitness = make_body_fitness(config)
    BodyEvolution(config, Executor(fitness, fitness.block_size))
    rng = np.random.default_rng(1)
    bodies = [fitness.genotype.develop(fitness.genotype.random(rng)) for _ in range(40)]
    packed = fitness.mixed.pack([fitness.build(body) for body in bodies])
    assert packed.count.max() <= fitness.mixed.capacity.rows
    assert fitness.mixed.touches == (name == "bed_coevolve")


@pytest.mark.slow
def test_no_child_floats_where_all_are_trimmed():
    big = ["bodies.modules=[ActiveHinge]", "bodies.max_modules=20", "bodies.max_hinges=19"]
    fitness = make_body_fitness(load_config(find_shipped("lake_coevolve", "configs"), big))
    genotype, rng = fitness.genotype, np.random.default_rng(1)
    for _ in range(40):
        fitness.build(genotype.develop(genotype.mutate(rng, genotype.random(rng))))
