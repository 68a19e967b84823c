"""Strategies, the loop and the command line, on fitnesses that cost nothing.

Bits are compared within one process or on one machine with the same thread settings, as promised.
"""

import errno
import io
import itertools
import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from laboratory import XLA_FLAGS
from mjx_revolve import evolve as command
from mjx_revolve.episodes.champion import load_genes
from mjx_revolve.episodes.config import EvolutionConfig
from mjx_revolve.evolution import checkpoints, loop, progress, runs
from mjx_revolve.evolution import start as beginning
from mjx_revolve.evolution.loop import choose_champion, evolve, search_from_arrays, search_to_arrays
from mjx_revolve.evolution.strategies import (
    FAILED_SCORE,
    STRATEGIES,
    find_strategy,
    losses_from_scores,
    make_strategy,
)
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
# In metrics.csv, all but these is reproducible.
CLOCK = ("seconds", "evaluations_per_second")


class Quadratic:
    """The higher, the nearer to a target; noise by key, the same for all, as with real starts."""

    def __init__(self, num_genes=5, noise=0.0):
        self.num_genes = num_genes
        self.target = np.linspace(-1, 1, num_genes).astype(np.float32)
        self.noise = noise

    def evaluate(self, population, key):
        distance = jnp.sum((population - self.target) ** 2, axis=1)
        return self.noise * jax.random.normal(key) - distance, {"distance_m": jnp.sqrt(distance)}


class Broken(Quadratic):
    """Fails in every row that `fails` names."""

    def __init__(self, fails, value=np.nan):
        super().__init__()
        self.fails, self.value = fails, value

    def evaluate(self, population, key):
        scores, measures = super().evaluate(population, key)
        rows = np.arange(len(population))
        return jnp.where(self.fails(rows), self.value, scores), measures


def settings(**changes):
    return EvolutionConfig(**{"population_size": 16, "generations": 12, "seed": 1} | changes)


def finish(config, fitness, search=None):
    """The last search and all rows."""
    history = list(evolve(config, fitness, search))
    return history[-1][0], [row for _, row in history]


def same(a, b):
    """Whether two searches agree bit for bit, but for the clock."""
    a, b = (search_to_arrays(settings(), search) for search in (a, b))
    return a.keys() == b.keys() and all(
        a[name].dtype == b[name].dtype and a[name].tobytes() == b[name].tobytes()
        for name in a
        if name not in CLOCK
    )


def timeless(row):
    return {name: value for name, value in row.items() if name not in CLOCK}


# --- scores to losses ---


def test_losses_are_negated_scores():
    losses = losses_from_scores(np.float32([1.0, -2.0, 3.0]))
    assert losses.dtype == np.float32
    assert losses.tolist() == [-1.0, 2.0, -3.0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_failures_lose_by_the_spread_of_the_others(bad):
    losses = losses_from_scores(np.array([1.0, bad, -2.0, bad]))
    assert losses[[0, 2]].tolist() == [-1.0, 2.0]
    assert losses[1] == 5.0
    assert losses[3] == np.nextafter(np.float32(5.0), np.float32(6.0))  # no ties among failures


def test_all_failed():
    losses = losses_from_scores(np.full(4, np.nan))
    assert np.isfinite(losses).all()
    assert losses[0] == -FAILED_SCORE
    assert len(set(losses.tolist())) == 4


def test_a_penalty_counts_across_generations():
    assert losses_from_scores(np.array([1.0, np.nan]), -100.0)[1] == 100.0
    assert losses_from_scores(np.array([-1e4, np.nan]), -100.0)[1] > 1e4


@pytest.mark.parametrize("value", [0.0, 1e-20, 1.0, -3e8])
def test_ties_are_broken_by_almost_nothing_even_for_xla(value):
    losses = losses_from_scores(np.full(64, value, np.float32))
    assert np.all(np.diff(jnp.asarray(losses)) > 0)
    # XLA flushes denormals to zero: the ranks that evosax takes must be different there, too.
    ranks = jax.jit(lambda x: jax.scipy.stats.rankdata(x))(losses)
    assert np.asarray(ranks).tolist() == list(range(1, 65))
    assert abs(losses[-1] - losses[0]) <= 64 * max(np.spacing(np.float32(abs(value))), 1e-30)


def test_ties_keep_the_order_of_the_others():
    losses = losses_from_scores(np.array([1.0, 2.0, 1.0, 2.0, 0.0]))
    assert np.argsort(losses).tolist() == [1, 3, 0, 2, 4]


# --- strategies ---


QUICK = ("CMA_ES", "OpenES", "SNES", "PGPE")


@pytest.mark.parametrize("name", QUICK)
def test_strategies_reach_the_optimum(name):
    check_optimum(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(STRATEGIES) - {find_strategy(n) for n in QUICK}))
def test_all_other_strategies_get_nearer(name):
    # These search at random, or with a step that ignores what they find.
    weak = ("RandomSearch", "SimpleGA", "DiffusionEvolution", "GESMR_GA", "iAMaLGaM_Univariate")
    check_optimum(name, within=1.0 if name in weak else 0.2)


def check_optimum(name, within=0.05):
    fitness = Quadratic()
    start = float(np.sum(fitness.target**2))  # 2.5
    population = 8 if name == "LM_MA_ES" else 16 if name in QUICK else 32
    config = settings(strategy=name, population_size=population, generations=60)
    search, rows = finish(config, fitness)
    assert search.evaluations == 60 * population
    assert -search.elite_scores[0] < within * start
    assert rows[-1]["champion"] == max(row["best"] for row in rows)
    assert np.allclose(search.elites[0], fitness.target, atol=2 * np.sqrt(within * start))


def test_names_are_found_however_written():
    assert find_strategy("cma-es") == "CMA_ES"
    assert find_strategy("OpenES") == "Open_ES"
    assert find_strategy("sep cma es") == "Sep_CMA_ES"
    assert find_strategy("DE") == "DifferentialEvolution"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"strategy": "CMA_SE"}, "evolution.strategy: expected one of ARS, "),
        ({"strategy": "CMA_SE"}, "found 'CMA_SE'; did you mean CMA_ES?"),
        ({"strategy": "SV_CMA_ES"}, "evolution.strategy: expected one of"),
        ({"strategy": "OpenES", "population_size": 15},
         "evolution.population_size: expected an even number for Open_ES; found 15"),
        ({"strategy": "PGPE", "population_size": 15},
         "evolution.population_size: expected an even number for PGPE; found 15"),
        ({"strategy": "LM_MA_ES", "population_size": 16},
         "evolution.population_size: expected at most twice the 5 genes for LM_MA_ES; found 16"),
        ({"strategy_params": {"std_mni": 1.0}},
         "evolution.strategy_params.std_mni: expected one of c_1, c_c, c_mean, c_mu, c_std, chi_n, "
         "d_std, mu_eff, std_max, std_min, weights for CMA_ES; found an unknown name"),
        ({"strategy_params": {"std_init": 1.0}},
         "evolution.strategy_params.std_init: expected evolution.std_init; found it here"),
        ({"strategy_params": {"std_min": "a"}},
         "evolution.strategy_params.std_min: expected a finite number; found 'a'"),
        ({"strategy_params": {"std_min": float("inf")}}, "expected a finite number; found inf"),
        ({"strategy_params": {"std_min": True}}, "expected a finite number; found True"),
        ({"strategy_params": {"weights": [1, 2]}}, "expected numbers of shape [16]; found [1, 2]"),
        ({"strategy_params": {"learning_rate": 0.1}}, "learning_rate: expected one of"),
        ({"strategy": "PGPE", "strategy_params": {"learning_rate": -1}},
         "evolution.strategy_params.learning_rate: expected a number > 0; found -1"),
        ({"strategy": "DE", "strategy_params": {"elitism": 1}},
         "evolution.strategy_params.elitism: expected true or false; found 1"),
    ],
)  # fmt: skip
def test_wrong_strategies(changes, message):
    with pytest.raises(InputError, match=re.escape(message)):
        make_strategy(settings(**changes), 5)


def test_strategy_params_arrive():
    strategy = make_strategy(settings(strategy_params={"std_min": 0.25, "c_mean": 0.5}), 5)
    assert (float(strategy.params.std_min), float(strategy.params.c_mean)) == (0.25, 0.5)
    assert float(strategy.params.std_init) == 0.5
    de = make_strategy(settings(strategy="DE", strategy_params={"elitism": False}), 5)
    assert de.params.elitism is False


# --- the loop ---


def test_same_seed_same_bits():
    fitness = Quadratic(noise=0.1)
    (first, rows), (second, others) = (finish(settings(), fitness) for _ in range(2))
    assert same(first, second)
    assert [timeless(row) for row in rows] == [timeless(row) for row in others]
    third, _ = finish(settings(seed=2), fitness)
    assert not np.array_equal(first.elites, third.elites)


@pytest.mark.parametrize("name", ["CMA_ES", "OpenES", "PSO"])
def test_going_on_from_arrays_gives_the_same_bits(name):
    fitness = Quadratic(noise=0.1)
    config = settings(strategy=name, generations=6)
    history = [search for search, _ in evolve(config, fitness)]
    for start in (0, 2):
        arrays = search_to_arrays(config, history[start])
        search = search_from_arrays(config, fitness.num_genes, arrays)
        assert same(search, history[start])
        again, _ = finish(config, fitness, search)
        assert same(again, history[-1])


def test_arrays_of_another_search_are_refused():
    config, fitness = settings(generations=1), Quadratic()
    search, _ = finish(config, fitness)
    arrays = search_to_arrays(config, search)
    for other, genes, message in (
        (settings(strategy="SNES"), 5, "expected float32"),
        (settings(), 6, "checkpoint: elites: expected float32 [4, 6], as CMA_ES of this version"),
        (settings(seed=9), 5, "expected the key of evolution.seed 9; found another"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            search_from_arrays(other, genes, arrays)


def test_rows_hold_the_figures():
    fitness = Quadratic()
    config = settings(generations=1)
    _, (row,) = finish(config, fitness)
    assert list(row)[:6] == ["generation", "evaluations", "best", "mean", "std", "median"]
    assert (row["generation"], row["evaluations"], row["failed"], row["restarts"]) == (1, 16, 0, 0)
    assert row["mean"] < row["best"] == row["champion"]
    assert row["distance_m"] == pytest.approx(np.sqrt(-row["best"]), rel=1e-6)
    assert row["step_size"] == pytest.approx(config.std_init, rel=0.3)


def test_failures_do_not_spread():
    config = settings(generations=40)
    search, rows = finish(config, Broken(lambda rows: rows % 4 == 0))
    assert all(row["failed"] == 4 for row in rows)
    assert all(np.isfinite(row["mean"]) for row in rows)
    assert search.elite_scores[0] > -0.05


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_search_where_everything_fails_goes_on(value):
    search, rows = finish(settings(), Broken(lambda rows: rows >= 0, value))
    assert all(row["failed"] == 16 and np.isnan(row["best"]) for row in rows)
    assert search.elite_scores.tolist() == [-np.inf] * 4
    assert np.isfinite(search.state["algorithm"].mean).all()
    assert rows[-1]["step_size"] > 0.05


def test_a_fitness_may_name_its_worst_score():
    fitness = Broken(lambda rows: rows == 2, -1000.0)
    fitness.worst_score = -1000.0
    _, rows = finish(settings(generations=2), fitness)
    assert all(row["failed"] == 1 and row["mean"] > -50 for row in rows)


def test_ties_do_not_shrink_the_step():
    # evosax alone: 0.5 to 8e-8 in 60 generations.
    class Flat(Quadratic):
        def evaluate(self, population, key):
            return jnp.zeros(len(population)), {}

    _, rows = finish(settings(generations=60), Flat())
    assert min(row["step_size"] for row in rows) > 0.1
    assert rows[-1]["restarts"] == 0


def test_a_stalled_search_starts_anew_and_keeps_its_champion():
    search, rows = finish(settings(generations=150), Quadratic())
    restart = next(row for row in rows if row["restarts"] == 1)
    assert restart["step_size"] > 0.2
    before = rows[restart["generation"] - 2]
    assert before["step_size"] <= 2 * loop.STD_FLOOR * 0.5
    champions = [row["champion"] for row in rows]
    assert champions == sorted(champions)
    assert rows[-1]["champion"] > -1e-5
    assert search.restarts == rows[-1]["restarts"]


def test_a_broken_state_starts_anew():
    config, fitness = settings(generations=3), Quadratic()
    search, _ = finish(config, fitness)
    state = search.state
    broken = state["algorithm"].replace(mean=np.full(5, np.nan, np.float32))
    search = loop.replace(search, state=state | {"algorithm": broken})
    search, rows = finish(settings(generations=5), fitness, search)
    assert [row["restarts"] for row in rows] == [1, 1]
    assert np.isfinite(search.state["algorithm"].mean).all()


def test_a_fitness_of_the_wrong_shape():
    class Wrong(Quadratic):
        def evaluate(self, population, key):
            return jnp.zeros(3), {}

    with pytest.raises(ValueError, match="expected 16 scores; found shape"):
        next(evolve(settings(), Wrong()))


def test_the_champion_is_judged_on_fresh_keys():
    class Lucky(Quadratic):
        """A bonus that depends on the key favours whoever happens to fit."""

        def __init__(self):
            super().__init__()
            self.seen = []

        def evaluate(self, population, key):
            self.seen.append(jax.random.key_data(key).tobytes())
            bonus = 2 * (population @ jax.random.normal(key, (self.num_genes,)))
            scores, measures = super().evaluate(population, key)
            return scores + bonus, measures

    fitness, config = Lucky(), settings(generations=30)
    search, _ = finish(config, fitness)
    champion = choose_champion(config, fitness, search)
    assert len(set(fitness.seen)) == len(fitness.seen) == 30 + 8 + 16
    # Luck fades: the score in evolution was too good, the reported one is what to expect.
    expected = -np.sum((champion.genes - fitness.target) ** 2)
    spread = 2 * np.linalg.norm(champion.genes)
    assert champion.std == pytest.approx(spread, rel=0.6)
    assert abs(champion.score - expected) < 4 * spread / np.sqrt(16)
    assert champion.score < search.elite_scores[0]
    assert champion.measures.keys() == {"distance_m"}


def test_candidates_that_fail_do_not_win():
    config = settings(generations=5)
    search, _ = finish(config, Quadratic())
    champion = choose_champion(config, Broken(lambda rows: rows != 2), search)
    assert champion.origin == f"best of generation {search.elite_generations[2]}"
    nobody = choose_champion(config, Broken(lambda rows: rows >= 0), search)
    assert nobody.score == FAILED_SCORE


# --- the command line ---


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a config, current; the compilation cache off."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
    monkeypatch.chdir(tmp_path)
    toys.write_config(tmp_path / "toy.yaml", population_size=8, checkpoint_every=2)
    return tmp_path


def toy(config):
    return Quadratic(noise=0.1)


def run_main(*argv, make_fitness=toy):
    return run_command(lambda argv: command.main(argv, make_fitness), [str(a) for a in argv])


def metrics(folder):
    table = runs.load_metrics(folder / "metrics.csv")
    return {name: column.tobytes() for name, column in table.items() if name not in CLOCK}


def contents(folder):
    """What must be the same for two runs of the same seed."""
    run = runs.Run(folder)
    checkpoint = run.load_checkpoint()
    arrays = {name: a.tobytes() for name, a in checkpoint.arrays.items() if name not in CLOCK}
    return metrics(folder), (folder / "champion" / "genes.yaml").read_text(), arrays


class DroppedError(Exception):
    """Stands for kill -9: nothing that the program does at its end happens."""


def dropping(generation):
    """A fitness that drops the process in a generation."""

    def make(config):
        fitness = Quadratic(noise=0.1)
        count = itertools.count(1)
        evaluate = fitness.evaluate

        def drop(population, key):
            if next(count) == generation:
                raise DroppedError
            return evaluate(population, key)

        fitness.evaluate = drop
        return fitness

    return make


def test_a_run_documents_itself(folder, capsys):
    assert run_main("toy.yaml", "--out", "run", "--seed", 5, "--set", "task.duration=4") == 0
    out = capsys.readouterr().out
    lines = out.splitlines()
    assert lines[0].startswith("5 genes | speed in lake | SNES 8 x 7, seed 5 | cpu with ")
    assert [line.split("  ")[0] for line in lines[1:8]] == [
        f"generation {i}/7" for i in range(1, 8)
    ]
    assert re.search(r"  best -?[\d.]+  mean -?[\d.]+  evaluations/s [\d.]+", lines[1])
    assert re.match(r"champion: -?\S+ ± \S+ body lengths/s over 16 fresh starts \(", lines[8])
    assert lines[-1] == "run folder: run"
    run = folder / "run"
    names = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    assert names >= {
        "config.yaml", "run.json", "metrics.csv", "fitness.png", "champion/genes.yaml",
        "inputs/robot.yaml", "checkpoints/generation_000007.npz",
    }  # fmt: skip
    info = json.loads((run / "run.json").read_text())
    assert info["versions"].keys() >= {"python", "jax", "jaxlib", "mujoco", "evosax", "numpy"}
    assert info["seed"] == 5
    assert info.keys() >= {"argv", "platform", "cpu_count", "device", "threads", "started",
                           "model_hash", "finished", "champion"}  # fmt: skip
    assert runs.Run(run).load_config().task.duration == 4
    assert load_genes(run).shape == (5,)
    assert len(runs.load_metrics(run / "metrics.csv")["best"]) == 7


def test_default_folder(folder):
    assert run_main("toy.yaml", "--set", "evolution.generations=1") == 0
    (run,) = (folder / "runs").iterdir()
    assert re.fullmatch(r"toy-\d{8}-\d{6}", run.name)


@pytest.mark.parametrize("drop", [1, 4, 6])
def test_a_dropped_run_continues_bit_for_bit(folder, drop, capsys):
    assert run_main("toy.yaml", "--out", "whole") == 0
    with pytest.raises(DroppedError):
        run_main("toy.yaml", "--out", "part", make_fitness=dropping(drop))
    if drop == 1:  # before the first checkpoint
        assert run_main("--resume", "part") == 2
        assert "expected a checkpoint to resume from; found none" in capsys.readouterr().err
        return
    assert run_main("--resume", "part") == 0
    assert f"resuming after generation {(drop - 1) // 2 * 2}" in capsys.readouterr().out
    assert contents(folder / "part") == contents(folder / "whole")
    assert len(json.loads((folder / "part" / "run.json").read_text())["resumed"]) == 1


def test_a_damaged_checkpoint_costs_only_time(folder, capsys):
    assert run_main("toy.yaml", "--out", "whole") == 0
    with pytest.raises(DroppedError):
        run_main("toy.yaml", "--out", "part", make_fitness=dropping(6))
    newest = folder / "part" / "checkpoints" / "generation_000004.npz"
    newest.write_bytes(newest.read_bytes()[:1000])
    assert run_main("toy.yaml", "--resume", "part") == 0
    out, err = capsys.readouterr()
    assert "passed over a damaged checkpoint: generation_000004.npz" in err
    assert "resuming after generation 2" in out
    assert contents(folder / "part") == contents(folder / "whole")


def test_a_finished_run(folder, capsys):
    assert run_main("toy.yaml", "--out", "run", "--set", "evolution.generations=4") == 0
    before = contents(folder / "run")
    capsys.readouterr()
    assert run_main("--resume", "run") == 0
    assert capsys.readouterr().out == (
        "run: finished after 4 generations; to go on: --set evolution.generations=8\n"
    )
    assert contents(folder / "run") == before
    # Going on gives what a longer run would have given.
    assert run_main("toy.yaml", "--out", "long") == 0
    assert run_main("--resume", "run", "--set", "evolution.generations=7") == 0
    assert contents(folder / "run") == contents(folder / "long")
    assert runs.Run(folder / "run").load_config().evolution.generations == 7


def test_a_run_that_lacks_only_its_champion(folder):
    assert run_main("toy.yaml", "--out", "run") == 0
    before = contents(folder / "run")
    shutil.rmtree(folder / "run" / "champion")
    runs.Run(folder / "run").update_info(finished=None)
    assert run_main("--resume", "run") == 0
    assert contents(folder / "run") == before


def test_resuming_remembers_the_settings(folder):
    assert run_main("toy.yaml", "--out", "run", "--seed", 3, "--set", "task.trials=3") == 0
    more = ("--set", "evolution.generations=8")
    assert run_main("toy.yaml", "--resume", "run", *more) == 0
    config = runs.Run(folder / "run").load_config()
    assert (config.evolution.seed, config.task.trials, config.evolution.generations) == (3, 3, 8)


@pytest.fixture
def stopped(folder):
    """A run that was dropped after its first checkpoint."""
    with pytest.raises(DroppedError):
        run_main("toy.yaml", "--out", "run", make_fitness=dropping(4))
    return folder


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--set", "task.duration=4"], "--resume run: task.duration: expected 10.0 as in the run; "
         "found 4.0; only evolution.generations, checkpoint_every, keep_checkpoints, tensorboard "
         "may change"),
        (["--seed", "9"], "--resume run: evolution.seed: expected 0 as in the run; found 9"),
        (["--set", "world=empty_underwater"], "--resume run: world.name: expected 'lake' as in"),
        (["--set", "world.current=[1, 0, 0]"], "--resume run: world.current: expected None as in"),
        (["--set", "morphology=other.yaml"], "--resume run: morphology: expected"),
        (["--set", "evolution.population_size=16", "--set", "task.trials=1"], "(and 1 more)"),
        (["changed.yaml"], "run: task.type: expected 'speed' as in the run; found 'crawl'"),
        (["--out", "there"], "--resume run: expected no --out beside it; found there"),
        (["--set", "task.duration=-1"], "--set task.duration: expected a number > 0; found -1"),
        (["--set", "evolution.generations=0"], "expected a whole number >= 1; found 0"),
    ],
)  # fmt: skip
def test_a_run_stays_the_same_run(stopped, argv, message, capsys):
    (stopped / "other.yaml").write_text("id: other\n")
    changed = (stopped / "toy.yaml").read_text().replace("speed", "crawl")
    (stopped / "changed.yaml").write_text(changed)
    assert run_main("--resume", "run", *argv) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1


def test_a_changed_robot_or_config_is_noticed(stopped, capsys, monkeypatch):
    monkeypatch.setattr(beginning, "model_hash", lambda fitness: "another")
    assert run_main("--resume", "run") == 2
    assert "expected the robot and the world that it began with; found them changed" in (
        capsys.readouterr().err
    )
    monkeypatch.undo()
    monkeypatch.chdir(stopped)
    path = stopped / "run" / "config.yaml"
    path.write_text(path.read_text().replace("duration: 10.0", "duration: 9.0"))
    assert run_main("--resume", "run") == 2
    assert "expected the config.yaml that it began with; found it changed" in (
        capsys.readouterr().err
    )


def test_another_host_is_mentioned(stopped, capsys, monkeypatch):
    host = beginning.describe_host()
    monkeypatch.setattr(beginning, "describe_host", lambda: host | {"cpu_count": 999})
    assert run_main("--resume", "run") == 0
    err = capsys.readouterr().err
    assert "continues, but not bit for bit, because this process differs: cpu_count" in err


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "expected a CONFIG, or --resume DIR; found neither"),
        (["none.yaml"], "none.yaml: expected a file; found none"),
        (["toy.yaml", "--fast"], "unrecognized arguments: --fast (see --help)"),
        (["toy.yaml", "--out", ""], "--out: expected a path; found ''"),
        (["toy.yaml", "--out", "full/file/run"], "expected the folder full/file; found a file"),
        (["toy.yaml", "--set", "evolution.strategy=CMA_SE"], "did you mean CMA_ES?"),
        (["toy.yaml", "--set", "evolution.strategy=PGPE", "--set", "evolution.population_size=9"],
         "toy.yaml: evolution.population_size: expected an even number for PGPE; found 9"),
        (["toy.yaml", "--set", "task.durtion=4"], "did you mean task.duration?"),
        (["toy.yaml", "--seed", "-1"], "--seed: expected a whole number from 0 to 4294967295"),
        (["toy.yaml", "--out", "full"], "--out full: expected a new or empty folder; found files"),
        (["--resume", "nowhere"], "nowhere: expected a run folder; found none"),
    ],
)  # fmt: skip
def test_wrong_commands_leave_nothing_behind(folder, argv, message, capsys):
    (folder / "full").mkdir()
    (folder / "full" / "file").touch()
    before = sorted(folder.rglob("*"))
    assert run_main(*argv) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert message in err
    assert err.count("\n") == 1
    assert sorted(folder.rglob("*")) == before


def test_wrong_robots_leave_nothing_behind(folder, capsys):
    def refuse(config):
        raise InputError(f"{config.morphology}: body: expected a mapping; found none")

    assert run_main("toy.yaml", "--out", "run", make_fitness=refuse) == 2
    assert "body: expected a mapping" in capsys.readouterr().err
    assert not (folder / "run").exists()


def test_a_full_disk_costs_one_generation(folder, capsys, monkeypatch):
    assert run_main("toy.yaml", "--out", "whole") == 0
    write = checkpoints.write_atomic

    def full(path, content):
        if path.name == "generation_000004.npz":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write(path, content)

    monkeypatch.setattr(checkpoints, "write_atomic", full)
    capsys.readouterr()
    assert run_main("toy.yaml", "--out", "part") == 1
    err = capsys.readouterr().err.splitlines()
    assert err[0].endswith("part/checkpoints/generation_000004.npz: No space left on device")
    last = "part/checkpoints/generation_000002.npz"
    assert err[1] == f"the last checkpoint, {last}, is intact; make room, then"
    assert err[2].endswith("-m mjx_revolve.evolve --resume part")
    monkeypatch.setattr(checkpoints, "write_atomic", write)
    assert run_main("--resume", "part") == 0
    assert contents(folder / "part") == contents(folder / "whole")


SCRIPT = """
import sys, time
from mjx_revolve import evolve
from mjx_revolve.inputs.commands import run_command

def make_fitness(config):
    from test_evolve import Quadratic

    class Slow(Quadratic):
        def evaluate(self, population, key):
            time.sleep(0.02)
            return super().evaluate(population, key)

    return Slow(noise=0.1)

assert "numpy" not in sys.modules and "jax" not in sys.modules, "loaded before the settings"
sys.exit(run_command(lambda argv: evolve.main(argv, make_fitness), sys.argv[1:]))
"""


def start(folder, *argv):
    """The command in a process of its own, compiled like this one's: bits are compared."""
    script = folder / "script.py"
    script.write_text(SCRIPT)
    path = f"{ROOT}{os.pathsep}{ROOT / 'tests'}"
    return subprocess.Popen(
        [sys.executable, str(script), *argv], cwd=folder, text=True,
        env=os.environ | XLA_FLAGS | {"PYTHONPATH": path, "JAX_COMPILATION_CACHE_DIR": ""},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


def read_until(process, words):
    lines = []
    for line in process.stdout:
        lines.append(line)
        if words in line:
            return lines
    raise AssertionError("".join(lines))


def test_ctrl_c_saves_and_says_how_to_go_on(folder):
    process = start(folder, "toy.yaml", "--out", "run", "--set", "evolution.generations=2000")
    read_until(process, "generation 50/")
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "finishing what is under way; press Ctrl-C again to quit at once" in out
    done = int(re.search(r"stopped after generation (\d+); all of it is saved", out).group(1))
    assert re.search(r"resume: \S*python\S* -m mjx_revolve.evolve --resume run\n$", out)
    assert (folder / "run" / "checkpoints" / f"generation_{done:06d}.npz").exists()
    genes = (folder / "run" / "champion" / "genes.yaml").read_text()
    assert "not yet judged on fresh starts" in genes
    # Here, with other thread settings perhaps, SNES still gives the same bits: no LAPACK in it.
    more = f"evolution.generations={done + 3}"
    assert run_main("--resume", "run", "--set", more) == 0
    assert run_main("toy.yaml", "--out", "whole", "--set", more) == 0
    assert contents(folder / "run") == contents(folder / "whole")


@pytest.mark.slow
def test_sigterm_and_impatience(folder):
    process = start(folder, "toy.yaml", "--out", "run", "--set", "evolution.generations=2000")
    read_until(process, "generation 1/")
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 143
    process = start(folder, "--resume", "run")
    read_until(process, "generation ")
    # Two at once: the second one ends it there and then.
    process.send_signal(signal.SIGINT)
    time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) in (-signal.SIGINT, 130)


@pytest.mark.slow
def test_kill_nine_costs_only_time(folder):
    argv = ("--set", "evolution.strategy=CMA_ES", "--set", "evolution.generations=40")
    whole = start(folder, "toy.yaml", "--out", "whole", *argv)
    whole.communicate(timeout=120)
    part = start(folder, "toy.yaml", "--out", "part", *argv)
    read_until(part, "generation 11/")
    part.kill()
    part.wait()
    again = start(folder, "--resume", "part")
    out, _ = again.communicate(timeout=120)
    assert (whole.returncode, again.returncode) == (0, 0), out
    assert contents(folder / "part") == contents(folder / "whole")


# --- what it says while it goes on ---


class Terminal(io.StringIO):
    """A terminal; `drawn` is what stood on it, one after the other."""

    def __init__(self, encoding="utf-8"):
        super().__init__()
        self.code = encoding

    encoding = property(lambda self: self.code)

    def isatty(self):
        return True

    @property
    def drawn(self):
        return self.getvalue().split("\r")[1:]


def row(generation, **more):
    return {"generation": generation, "best": 0.25, "mean": 1 / 3, "std": 0.1,
            "evaluations_per_second": 1234.5} | more  # fmt: skip


@pytest.fixture
def clock(monkeypatch):
    """Time that passes only when told to."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    monkeypatch.setenv("TERM", "xterm")
    return now


@pytest.mark.parametrize(
    ("total", "stride"), [(1, 1), (60, 1), (61, 2), (120, 2), (200, 5), (500, 10), (2000, 50)]
)
def test_a_log_has_sixty_lines_at_most(total, stride, clock):
    assert progress.choose_stride(total) == stride
    out = io.StringIO()
    shown = progress.Progress(0, total, out)
    for generation in range(1, total + 1):
        shown.show(row(generation))
    shown.close()
    told = [int(line.split("/")[0].split()[1]) for line in out.getvalue().splitlines()]
    middle = range(stride, total + 1, stride)
    assert told == sorted({1, total, *middle})


def test_a_log_is_never_silent_for_long(clock):
    out = io.StringIO()
    shown = progress.Progress(0, 500, out)
    for generation in range(1, 6):
        shown.show(row(generation))
        clock[0] += 31.0
    assert len(out.getvalue().splitlines()) == 5


def test_plain_lines_tell_the_time_left(clock):
    out = io.StringIO()
    shown = progress.Progress(4, 10, out)
    clock[0] += 40.0  # compiling does not count
    shown.show(row(5))
    clock[0] += 15.0
    shown.show(row(6, failed=3))
    assert out.getvalue().splitlines() == [
        "generation 5/10  best 0.25  mean 0.3333  evaluations/s 1234  left ?",
        "generation 6/10  best 0.25  mean 0.3333  evaluations/s 1234  failed 3  left 01:00",
    ]


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "00:00"), (60.0, "01:00"), (11159.0, "3:05:59")]
)
def test_times_left(seconds, text, clock):
    out = io.StringIO()
    shown = progress.Progress(0, 3, out)
    shown.show(row(1))
    clock[0] += seconds
    shown.show(row(2))
    assert out.getvalue().splitlines()[-1].endswith(f"  left {text}")


@pytest.mark.parametrize("columns", [20, 50, 80, 200])
def test_the_live_line_fits_its_terminal(columns, clock, monkeypatch):
    monkeypatch.setattr(progress.Progress, "_columns", lambda self: columns - 1)
    out = Terminal()
    shown = progress.Progress(0, 4, out)
    for generation in (1, 2, 3):
        clock[0] += 2.0
        shown.show(row(generation))
    clock[0] += 0.01
    shown.show(row(4))  # the last one, too soon for any other
    shown.close()
    assert all(len(line.rstrip("\n")) < columns for line in out.drawn)
    assert out.drawn[0].startswith("generation 0/4  ")
    assert out.drawn[-1].startswith("generation 4/4  ")
    assert len(out.drawn) == 5
    assert out.getvalue().endswith("\n")
    if columns == 200:
        head, bar, *figures = re.split("  +", out.drawn[3])
        assert head == "generation 3/4" and set(bar[:-1]) == {"█"}
        assert figures == ["best 0.25", "mean 0.3333", "evaluations/s 1234", "left 00:02"]


def test_the_live_line_is_not_drawn_too_often(clock, monkeypatch):
    monkeypatch.setattr(progress.Progress, "_columns", lambda self: 120)
    out = Terminal("ascii")
    shown = progress.Progress(0, 1000, out)
    for generation in range(1, 101):
        clock[0] += 0.01
        shown.show(row(generation))
    assert len(out.drawn) < 15
    shown.close()  # interrupted: the last generation is there
    assert out.drawn[-1].startswith("generation 100/1000  ###")
    out.getvalue().encode("ascii")


def test_dumb_terminals_get_plain_lines(clock, monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    out = Terminal()
    progress.Progress(0, 4, out).show(row(1))
    assert out.getvalue() == (
        "generation 1/4  best 0.25  mean 0.3333  evaluations/s 1234  left ?\n"
    )


@pytest.mark.slow
def test_pandas_opens_the_metrics_of_a_run_that_goes_on(folder):
    pandas = pytest.importorskip("pandas")
    process = start(folder, "toy.yaml", "--out", "run", "--set", "evolution.generations=40")
    read_until(process, "generation 1/")
    seen = set()
    while process.poll() is None:
        frame = pandas.read_csv(folder / "run" / "metrics.csv")
        assert frame["generation"].tolist() == list(range(1, len(frame) + 1))
        assert frame.notna().all(axis=None)
        seen.add(len(frame))
        time.sleep(0.02)
    process.communicate(timeout=60)
    assert process.returncode == 0
    assert len(seen) > 10


# --- TensorBoard ---


def events(folder):
    """The scalars that a reader of the event files keeps: by tag, (step, value)."""
    from tensorboardX.proto.event_pb2 import Event

    found = []
    for path in sorted((folder / "tensorboard").iterdir()):
        data, at = path.read_bytes(), 0
        while at < len(data):
            (size,) = struct.unpack("<Q", data[at : at + 8])
            found.append(Event.FromString(data[at + 12 : at + 12 + size]))
            at += 12 + size + 4
    scalars = {}
    for event in found:
        if event.HasField("session_log"):  # what TensorBoard does: later steps are purged
            scalars = {tag: [x for x in xs if x[0] < event.step] for tag, xs in scalars.items()}
        for value in event.summary.value:
            scalars.setdefault(value.tag, []).append((event.step, value.simple_value))
    return scalars


def test_tensorboard_has_what_the_metrics_have(folder):
    pytest.importorskip("tensorboardX")
    board = ("--set", "evolution.tensorboard=true")
    assert run_main("toy.yaml", "--out", "whole", *board) == 0
    with pytest.raises(DroppedError):
        run_main("toy.yaml", "--out", "part", *board, make_fitness=dropping(6))
    assert [step for step, _ in events(folder / "part")["fitness/best"]] == [1, 2, 3, 4, 5]
    assert run_main("--resume", "part") == 0
    assert len(list((folder / "part" / "tensorboard").iterdir())) == 2
    for name in ("whole", "part"):
        table = runs.load_metrics(folder / name / "metrics.csv")
        scalars = events(folder / name)
        assert len(scalars) == len(table) - 1  # the generation is the step
        assert {tag.split("/")[0] for tag in scalars} == {"fitness", "search", "measures", "time"}
        for tag, points in scalars.items():
            column = table[tag.split("/")[1]]
            assert [step for step, _ in points] == list(range(1, 8))
            assert np.allclose([value for _, value in points], column, rtol=1e-6)
    assert contents(folder / "part") == contents(folder / "whole")


def test_tensorboard_itself_reads_it(folder):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    pytest.importorskip("tensorboardX")
    board = ("--set", "evolution.tensorboard=true")
    with pytest.raises(DroppedError):
        run_main("toy.yaml", "--out", "run", *board, make_fitness=dropping(6))
    assert run_main("--resume", "run") == 0
    reader = accumulator.EventAccumulator(str(folder / "run" / "tensorboard"))
    reader.Reload()
    assert [event.step for event in reader.Scalars("fitness/best")] == list(range(1, 8))


def test_tensorboard_may_begin_late_and_end_early(folder):
    pytest.importorskip("tensorboardX")
    assert run_main("toy.yaml", "--out", "run") == 0
    board = ("--set", "evolution.generations=9", "--set", "evolution.tensorboard=true")
    assert run_main("--resume", "run", *board) == 0
    assert [step for step, _ in events(folder / "run")["search/step_size"]] == list(range(1, 10))
    less = ("--set", "evolution.generations=10", "--set", "evolution.tensorboard=false")
    assert run_main("--resume", "run", *less) == 0
    assert len(events(folder / "run")["search/step_size"]) == 9


@pytest.mark.parametrize("argv", [("toy.yaml", "--out", "new"), ("--resume", "run")])
def test_tensorboard_is_missed_before_anything_begins(stopped, argv, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    assert run_main(*argv, "--set", "evolution.tensorboard=true") == 2
    err = capsys.readouterr().err
    assert "evolution.tensorboard: expected the package tensorboardX (pip install" in err
    assert err.count("\n") == 1
    assert not (stopped / "new").exists()


def test_a_full_disk_is_noticed_by_tensorboard(folder, capsys, monkeypatch):
    pytest.importorskip("tensorboardX")
    from tensorboardX.event_file_writer import EventsWriter

    def full(self, event):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(EventsWriter, "write_event", full)
    assert run_main("toy.yaml", "--out", "run", "--set", "evolution.tensorboard=true") == 1
    err = capsys.readouterr().err
    assert err == f"error: {folder / 'run' / 'tensorboard'}: No space left on device\n"
