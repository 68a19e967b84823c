"""Bodies that evolve, on a fitness that costs nothing: learning, generations, run folders."""

import csv
import json
from dataclasses import replace
from unittest.mock import Mock

import jax
import numpy as np
import pytest

import toys
from mjx_revolve import evolve as command
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.episodes.champion import champion_number
from mjx_revolve.episodes.config import load_config
from mjx_revolve.episodes.named_files import read_modules
from mjx_revolve.episodes.passport import Check, Passport
from mjx_revolve.evolution import individual_search
from mjx_revolve.evolution import run_folder as runs
from mjx_revolve.evolution.coevolution import BodyEvolution
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.generations import run_generations
from mjx_revolve.evolution.individuals import features, from_record, to_record
from mjx_revolve.evolution.learning import evaluate_again, learn, score_brains
from mjx_revolve.evolution.run import check_search
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from toys import CLOCK, make_toy_bodies


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    toys.write_bodies_config(tmp_path / "toy.yaml")
    return tmp_path


def start(folder, bodies=(), **evolution):
    """A pool over the toy, with other settings."""
    config = load_config(toys.write_bodies_config(folder / "other.yaml", bodies, **evolution))
    fitness = make_toy_bodies(config)
    return config, Executor(fitness, fitness.block_size)


def run(config, executor, search=None):
    """All generations: the last search, and all rows."""
    history = generations(config, executor, search)
    return history[-1][0], [row for _, row in history]


def generations(config, executor, search=None):
    """All searches and rows."""
    evolution = BodyEvolution(config, executor)
    return list(run_generations(evolution, config.evolution.generations, search))


def same(one, other, fitness):
    """Whether two individuals are the same in every bit, scores included."""
    return to_record(one, fitness.genotype) == to_record(other, fitness.genotype)


def main(*argv):
    return run_command(lambda argv: command.main(argv, make_toy_bodies), [str(a) for a in argv])


def founders(config, executor):
    evolution = BodyEvolution(config, executor)
    return evolution.ask(evolution.start()).offspring


@pytest.mark.long
def test_learning_does_not_depend_on_the_other_bodies(folder):
    for learning in ({}, {"population_size": 4, "generations": 3}):
        config, executor = start(folder, {"learning": learning})
        born, key = founders(config, executor), jax.random.key(3)
        together = learn(executor, born, key)
        alone = learn(executor, born[4:5], key)
        assert same(alone[0], together[4], executor.fitness)
        assert not np.isnan(alone[0].score)


@pytest.mark.slow
def test_learning_improves_and_is_what_counts(folder):
    config, executor = start(folder)
    born, key = founders(config, executor), jax.random.key(0)
    naive = learn(executor, born, key)
    for individual in naive:
        assert individual.learnt == individual.brain and individual.trials == 1
    config, executor = start(folder, {"learning": {"population_size": 8, "generations": 6}})
    learned = learn(executor, born, key)
    gains = [after.score - before.score for before, after in zip(naive, learned, strict=True)]
    assert min(gains) >= 0 and np.mean(gains) > 0.05
    for individual in learned:
        assert individual.trials == 48 and individual.brain in [n.brain for n in naive]
    with pytest.raises(InputError, match=r"^bodies.learning.strategy: expected one of"):
        founders(*start(folder, {"learning": {"strategy": "guess"}}))
    with pytest.raises(InputError, match=r"population_size: .* as many as bodies.seeds"):
        check_search(*start(folder, {"seeds": ["spider"] * 7, "max_modules": 20, "max_hinges": 8}))
    # Scored by itself, what was learnt gives the score again, on the same starts.
    wide = np.zeros((len(learned), 1, executor.num_genes), np.float32)
    for row, individual in zip(wide, learned, strict=True):
        row[:, executor.fitness.layout(individual.body).columns] = individual.genes
    again = score_brains(executor, learned, wide, jax.random.split(key)[0])
    for (score, _), individual in zip(again, learned, strict=True):
        assert score[0] == pytest.approx(individual.score, abs=1e-6)


LONG = pytest.param("joint_checks", marks=pytest.mark.long)  # it swims for each of them


@pytest.mark.parametrize("lasts", [LONG, "step_changes", "kept_shares"])
def test_where_a_passport_is_required_the_living_are_candidates_too(folder, monkeypatch, lasts):
    """What all elites fail the last of the other living passes, tried second: its joints alone do
    what servos can, or its score alone holds at half the step, or for two minutes."""
    config, executor = start(folder, {"selection": {"type": "plus", "passport": "required"}})
    search, _ = run(config, executor)
    candidates = individual_search.list_candidates(search, True)
    elites, last, tried = individual_search.list_candidates(search, False), candidates[-1], []
    others = {one.number for one in candidates[len(elites) :]}
    assert elites == search.elites and others
    assert others == {one.number for one in search.living} - {one.number for one in elites}
    failing = [one.genes for one in elites]

    def judged(fitness, genes, seed):
        tried.append(genes)
        return Passport({"kept": Check("kept", float(genes not in failing), least=0.5)})

    def checked(robot, genes, settle):
        sound = lasts != "joint_checks" or np.array_equal(genes, last.genes)
        yield "torque", Check("torque", float(sound), least=0.5)

    def shares(name, good):
        """The last one's score stays; those of others, too, of which this is not the test."""
        stays = lambda body: name != lasts or body is last.body  # noqa: E731
        return lambda _, bodies, *rest: np.array([good if stays(x) else 0.5 for x in bodies])

    monkeypatch.setattr(individual_search, "make_passport", judged)
    monkeypatch.setattr(type(executor.fitness.mixed), "replay", lambda _, robots, genes, key: genes)
    monkeypatch.setattr(individual_search, "joint_checks", checked)
    monkeypatch.setattr(individual_search, "LONG", 2.0)  # what is swum is swum for two seconds
    if lasts != "joint_checks":
        monkeypatch.setattr(type(executor.fitness), "step_changes", shares("step_changes", 0.0))
        monkeypatch.setattr(type(executor.fitness), "kept_shares", shares("kept_shares", 1.0))
    champion = BodyEvolution(config, executor).choose_champion(search)
    assert champion.individual == last.number and not champion.passport.failed
    assert len(tried) == 2 and tried[0] in failing


@pytest.mark.long
def test_blocks_hold_one_body_where_many_brains_are_tried(folder):
    for size, alone in ((1, False), (5, False), (6, True), (9, False), (20, True)):
        config, executor = start(folder, {"learning": {"population_size": size}})
        watched = Mock(wraps=executor.fitness.evaluate)
        object.__setattr__(executor.fitness, "evaluate", watched)
        learn(executor, founders(config, executor), jax.random.key(0))
        seen = [call.args for call in watched.call_args_list]
        assert executor.fitness.one_body_per_block == alone
        assert {len(genes) for genes, *_ in seen} == {8}
        assert all(len(bodies) == 1 for _, _, bodies, _ in seen) == alone
        assert len(seen) == (6 * -(-size // 8) if alone else -(-6 * size // 8))


def test_those_that_fail_have_no_score(folder):
    config, executor = start(folder, {"learning": {"population_size": 4, "generations": 2}})
    inner = executor.fitness.evaluate

    def fail(genes, which, bodies, key):
        scores, measures = inner(genes, which, bodies, key)
        lost = np.array([body.num_hinges < 3 for body in bodies])[which]
        return np.where(lost, executor.fitness.worst_score, scores), measures

    object.__setattr__(executor.fitness, "evaluate", fail)
    for individual in learn(executor, founders(config, executor), jax.random.key(0)):
        lost = individual.body.num_hinges < 3
        assert np.isnan(individual.score) == lost == (individual.learnt is None)
    search, rows = run(config, executor)
    assert any(row["failed"] for row in rows)
    assert all(individual.body.num_hinges >= 3 for individual in search.elites)


SCHEMES = [
    {"type": "plus"},
    {"type": "comma", "offspring": 9},
    {"type": "generational", "elites": 2},
    {"type": "steady", "offspring": 3},
    {"type": "plus", "max_age": 2},
    {"type": "random"},
    {"type": "nsga2", "objectives": ["score", "-num_modules", "novelty"],
     "novelty": ["num_hinges", "length"]},
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("selection", SCHEMES, ids=lambda s: s["type"])
def test_generations(folder, selection):
    config, executor = start(folder, {"selection": selection})
    search, rows = run(config, executor)
    per = selection.get("offspring", 6)
    assert [row["generation"] for row in rows] == [1, 2, 3, 4, 5]
    assert search.next_number == search.trials == rows[-1]["evaluations"] == 6 + 4 * per
    assert len(search.living) == 6
    champions = [row["champion"] for row in rows]
    assert champions == sorted(champions) and champions[-1] == search.elites[0].score
    if selection["type"] == "plus" and "max_age" not in selection:
        assert search.elites[0].number in {i.number for i in search.living}
        means = [row["living_mean"] for row in rows]
        assert means == sorted(means)
    for individual in search.living:
        assert all(parent < individual.number for parent in individual.parents)
        assert individual.born == 1 or individual.parents or selection["type"] == "random"
    if "novelty" in selection:  # none is its own neighbour
        own = features(search.living, selection["novelty"])
        numbers = np.array([one.number for one in search.living])
        known = [replace(search, novelty_archive=own[n:], novelty_ids=numbers[n:]) for n in (0, 6)]
        evolution = BodyEvolution(config, executor)
        np.testing.assert_array_equal(*(evolution._novelty(search.living, k) for k in known))
    again, repeated = run(config, executor)
    assert all(map(lambda a, b: same(a, b, executor.fitness), search.living, again.living))
    for row, other in zip(rows, repeated, strict=True):
        assert {k: v for k, v in row.items() if k not in CLOCK} == pytest.approx(
            {k: v for k, v in other.items() if k not in CLOCK}, nan_ok=True, abs=0, rel=0
        )


def test_parents_and_children_have_random_streams_of_their_own(folder, monkeypatch):
    evolution = BodyEvolution(*start(folder, {"selection": {"type": "steady", "offspring": 1}}))
    search, _ = run(*start(folder), None)
    seeds, make = [], np.random.default_rng
    monkeypatch.setattr(np.random, "default_rng", lambda s: seeds.append(s) or make(s))
    evolution._children(search, 7)
    assert len({make(seed).random() for seed in seeds}) == len(seeds) >= 2


@pytest.mark.parametrize("kind", ["plus", "generational"])
def test_reevaluated_scores_are_means_over_starts_that_no_brain_was_chosen_on(folder, kind):
    bodies = {"selection": {"type": kind, "reevaluate": True}, "learning": {"population_size": 3}}
    config, executor = start(folder, bodies)
    history = generations(config, executor)
    search, last = history[-1]
    fitness, key = executor.fitness, jax.random.key(config.evolution.seed)
    assert search.trials == 6 * (3 + 1) + 4 * 6 * (3 + 2)
    assert last["champion"] == search.elites[0].score
    evolution = BodyEvolution(config, executor)
    lines = [line for each, _ in history for line in evolution.logs(each)["individuals.jsonl"]]
    logged = {line["id"]: line["score"] for line in map(json.loads, lines)}
    ages = set()
    for one in search.living:
        wide = np.zeros((1, executor.num_genes), np.float32)
        wide[:, fitness.layout(one.body).columns] = one.genes
        keys = [jax.random.fold_in(key, generation) for generation in range(one.born, 6)]
        starts = [jax.random.fold_in(each, 2) for each in keys]
        scores = [score_brains(executor, [one], [wide], each)[0][0][0] for each in starts]
        assert one.score == pytest.approx(np.mean(scores), abs=1e-6)
        assert logged[one.number] == one.score
        ages.add(len(scores))
    assert len(ages) > 1
    assert {one.number: logged[one.number] for one in search.elites} == {
        one.number: one.score for one in search.elites
    }


def test_what_workers_lose_costs_no_score_and_a_blow_up_costs_all(folder, monkeypatch):
    config, executor = start(folder)
    one = learn(executor, founders(config, executor), jax.random.key(0))[0]
    for score, expected in ((np.nan, one.score), (-np.inf, np.nan)):
        found = [(np.array([score]), dict.fromkeys(one.measures, np.zeros(1)))]
        where = "mjx_revolve.evolution.learning.score_brains"
        monkeypatch.setattr(where, lambda *_, found=found: found)
        (again,) = evaluate_again(executor, [one], jax.random.key(1))
        assert again.score == pytest.approx(expected, nan_ok=True)


@pytest.mark.slow
def test_evolution_finds_the_optimum(folder):
    found = {}
    for kind in ("plus", "random"):
        bodies = {"selection": {"type": kind}, "brains": {"mutation": 0.1}}
        config, executor = start(folder, bodies, population_size=10, generations=20)
        search, _ = run(config, executor)
        found[kind] = search.elites[0].score
        assert search.elites[0].body.num_hinges == 3
    # Both find the hinges; of what is left, inheritance leaves less than half.
    assert found["random"] > -0.5
    assert found["plus"] > found["random"] / 2


@pytest.mark.slow
def test_inheritance(folder):
    learning = {"population_size": 8, "generations": 4, "std_init": 0.5}
    for how in ("lamarckian", "darwinian", "none"):
        brains = {"inheritance": how, "mutation": 0.0}
        config, executor = start(folder, {"brains": brains, "learning": learning, "crossover": 0.0})
        individuals, pairs = {}, 0
        for search, _ in generations(config, executor):
            for child in search.offspring:
                individuals[child.number] = child
                for parent in (individuals[number] for number in child.parents):
                    same_joints = child.brain.keys() & parent.brain.keys()
                    source = parent.learnt if how == "lamarckian" else parent.brain
                    alike = [child.brain[name] == source[name] for name in same_joints]
                    assert any(alike) == all(alike) == (how != "none")
                    pairs += 1
        assert pairs == 24


def test_clones_have_the_body_of_a_parent_and_a_brain_of_their_own(folder):
    config, executor = start(folder, {"cloning": 0.5})
    known = {}
    for search, _ in generations(config, executor):
        known |= {child.number: child for child in search.offspring}
    clones = [one for one in known.values() if one.origin == "cloning"]
    assert 6 < len(clones) < 18  # of 24 children
    for clone in clones:
        (parent,) = (known[number] for number in clone.parents)
        assert clone.body == parent.body and clone.brain != parent.learnt


@pytest.mark.parametrize("genotype", ["plasticoding", "cppn"])
def test_other_genotypes(folder, genotype):
    config, executor = start(folder, {"genotype": genotype, "brains": {"type": "cppn"}})
    search, _ = run(config, executor)
    for individual in search.living:
        again = from_record(
            json.loads(json.dumps(to_record(individual, executor.fitness.genotype))),
            executor.fitness.genotype, read_modules(config),
            executor.fitness.brains.check,
        )  # fmt: skip
        assert same(individual, again, executor.fitness)


def test_seeds_begin_the_population(folder):
    bodies = {"seeds": ["snake", "spider"], "random": 0.5, "max_modules": 30, "max_hinges": 10}
    config, executor = start(folder, bodies)
    first = founders(config, executor)
    assert [i.origin for i in first] == ["seed snake", "seed spider", "mutant of snake",
                                        "random", "random", "random"]  # fmt: skip
    for individual, seed in zip(first, executor.fitness.seeds, strict=False):
        assert individual.body.modules == seed.modules
    assert first[2].body.modules != first[0].body.modules


ARCHIVE = {
    "selection": {"type": "map_elites", "offspring": 8},
    "archive": {"axes": {"num_hinges": {"low": 0.5, "high": 4.5, "cells": 4},
                         "num_modules": {"low": 1.5, "high": 8.5, "cells": 7}}},
}  # fmt: skip


def test_map_elites_keeps_the_best_of_each_kind(folder):
    config, executor = start(folder, ARCHIVE, generations=12)
    best: dict = {}
    for search, row in generations(config, executor):
        for one in search.offspring:
            cell = (one.body.num_hinges, one.body.num_modules)
            if cell not in best or one.score > best[cell].score:
                best[cell] = one
        assert {i.number for i in search.living} == {i.number for i in best.values()}
        assert row["coverage"] == pytest.approx(len(best) / 28)
    assert len(best) > 12


def contents(folder):
    """What must be the same for two runs of the same seed."""
    names = ("champion/morphology.yaml", "individuals.jsonl", "generations.jsonl")
    return toys.contents(folder), [(folder / name).read_text() for name in names]


@pytest.mark.slow
@pytest.mark.sampled(1)
@pytest.mark.parametrize("bodies", [
    {"learning": {"population_size": 4, "generations": 2, "strategy": "CMA_ES"},
     "selection": {"reevaluate": True}},
    ARCHIVE,
    {"selection": {"type": "nsga2", "objectives": ["score", "novelty"], "novelty": ["length"]},
     "genotype": "plasticoding", "brains": {"type": "cppn"}},
], ids=["learning", "map_elites", "plasticoding"])  # fmt: skip
def test_a_run_that_goes_on_ends_as_one_that_never_stopped(folder, no_pictures, bodies, capsys):
    toys.write_bodies_config(folder / "toy.yaml", bodies)
    assert main("toy.yaml", "--out", "whole") == 0
    assert main("toy.yaml", "--out", "parts", "--set", "evolution.generations=2") == 0
    assert main("--resume", "parts", "--set", "evolution.generations=5") == 0
    assert "resuming after generation 2" in capsys.readouterr().out
    assert contents(folder / "whole") == contents(folder / "parts")


@pytest.mark.slow
def test_what_is_in_a_run_folder(folder, capsys):
    toys.write_bodies_config(folder / "toy.yaml", ARCHIVE)
    assert main("toy.yaml", "--out", "run") == 0
    out = capsys.readouterr().out
    assert "bodies (tree, at most 8 modules)" in out and "champion: " in out
    run_folder = folder / "run"
    individuals = [json.loads(line) for line in (run_folder / "individuals.jsonl").open()]
    assert [person["id"] for person in individuals] == list(range(len(individuals)))
    last = [json.loads(line) for line in (run_folder / "generations.jsonl").open()][-1]
    rows = list(csv.DictReader((run_folder / "archive.csv").open()))
    assert {int(row["id"]) for row in rows} == set(last["living"])
    for row in rows:
        person = individuals[int(row["id"])]
        assert float(row["score"]) == pytest.approx(person["score"])
        assert float(row["num_hinges"]) == person["descriptors"]["num_hinges"]
    archive, lives = runs.load_archive(run_folder)
    assert [life.number for life in lives] == [int(row["id"]) for row in rows]
    assert [life.score for life in lives] == [archive.scores[int(row["cell"])] for row in rows]
    body = load_morphology(run_folder / "champion" / "morphology.yaml")
    assert body.num_hinges == 3
    champion = individuals[champion_number(run_folder)]
    assert champion["body"] == json.loads(json.dumps(body.to_mapping()))
    assert (run_folder / "bodies.png").read_bytes().startswith(b"\x89PNG")
    table = runs.RunFolder(run_folder).load_metrics()
    assert table["coverage"][-1] == pytest.approx(len(rows) / 28)


@pytest.mark.slow
def test_workers_change_nothing(folder, no_pictures):
    toys.write_bodies_config(folder / "toy.yaml", {"learning": {"population_size": 6}})
    assert main("toy.yaml", "--out", "one", "--set", "evolution.generations=2") == 0
    argv = ("toy.yaml", "--out", "two", "--workers", "2", "--set", "evolution.generations=2")
    assert main(*argv) == 0
    assert contents(folder / "one") == contents(folder / "two")
