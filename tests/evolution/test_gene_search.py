"""Strategies and the search over genes, on fitnesses that cost nothing."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evosax.algorithms import algorithms

from mjx_revolve.episodes.config import EvolutionConfig
from mjx_revolve.episodes.passport import Check, Passport
from mjx_revolve.episodes.strategy_names import STRATEGY_NAMES, find_strategy
from mjx_revolve.evolution import gene_search
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.gene_search import GeneEvolution
from mjx_revolve.evolution.generations import run_generations
from mjx_revolve.evolution.strategies import (
    FAILED_SCORE,
    STD_FLOOR,
    losses_from_scores,
    make_strategy,
)
from mjx_revolve.inputs.errors import InputError
from toys import CLOCK, Quadratic


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
    history = list(
        run_generations(GeneEvolution(config, Executor(fitness)), config.generations, search)
    )
    return history[-1][0], [row for _, row in history]


def choose_champion(config, fitness, search):
    return GeneEvolution(config, Executor(fitness)).choose_champion(search)


def same(a, b):
    """Whether two searches agree bit for bit, but for the clock."""
    evolution = GeneEvolution(settings(), Executor(Quadratic()))
    a, b = (evolution.to_arrays(search) for search in (a, b))
    return a.keys() == b.keys() and all(
        a[name].dtype == b[name].dtype and a[name].tobytes() == b[name].tobytes()
        for name in a
        if name not in CLOCK
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_failures_lose_by_the_spread_of_the_others(bad):
    losses = losses_from_scores(np.array([1.0, bad, -2.0, bad]))
    assert losses[[0, 2]].tolist() == [-1.0, 2.0]
    assert losses[1] == 5.0
    assert losses[3] == np.nextafter(np.float32(5.0), np.float32(6.0))  # no ties among failures


def test_all_failed_and_penalties():
    losses = losses_from_scores(np.full(4, np.nan))
    assert np.isfinite(losses).all()
    assert losses[0] == -FAILED_SCORE
    assert len(set(losses.tolist())) == 4
    assert losses_from_scores(np.array([1.0, np.nan]), -100.0)[1] == 100.0
    assert losses_from_scores(np.array([-1e4, np.nan]), -100.0)[1] > 1e4


QUICK = ("CMA_ES", "OpenES", "SNES", "PGPE")
# These search at random, or with a step that ignores what they find.
WEAK = ("RandomSearch", "SimpleGA", "DiffusionEvolution", "GESMR_GA", "iAMaLGaM_Univariate")
OTHERS = sorted(set(STRATEGY_NAMES) - {find_strategy(name) for name in QUICK})


def test_all_of_evosax_is_known_without_it():
    assert set(STRATEGY_NAMES) == set(algorithms) - {"SV_CMA_ES", "SV_Open_ES"}


@pytest.mark.slow
@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", [*QUICK, *OTHERS])
def test_strategies_reach_the_optimum_or_get_nearer(name):
    within = 0.05 if name in QUICK else 1.0 if name in WEAK else 0.2
    fitness = Quadratic()
    start = float(np.sum(fitness.target**2))  # 2.5
    population = 8 if name == "LM_MA_ES" else 16 if name in QUICK else 32
    config = settings(strategy=name, population_size=population, generations=60)
    search, rows = finish(config, fitness)
    assert search.evaluations == 60 * population
    assert -search.elite_scores[0] < within * start
    assert rows[-1]["champion"] == max(row["best"] for row in rows)
    score = -np.sum((search.elites[0] - fitness.target) ** 2)
    assert search.elite_scores[0] == pytest.approx(score, rel=1e-5)  # these genes have it


@pytest.mark.parametrize(
    ("changes", "message"),
    [
({"strategy": "CMA_SE"}, "found 'CMA_SE'; did you mean CMA_ES?"),
({"strategy": "OpenES", "population_size": 15},
         "evolution.population_size: expected an even number for Open_ES; found 15"),
({"strategy": "ESMC", "population_size": 15}, "expected an even number for ESMC; found 15"),
({"strategy_params": {"std_mni": 1.0}},
         "evolution.strategy_params.std_mni: expected one of c_1, c_c, c_mean, c_mu, c_std, chi_n, "
         "d_std, mu_eff, std_max, std_min, weights for CMA_ES; found an unknown name"),
({"strategy_params": {"weights": [1, 2]}}, "expected numbers of shape [16]; found [1, 2]"),
({"strategy": "DE", "strategy_params": {"elitism": 1}},
         "evolution.strategy_params.elitism: expected true or false; found 1")
],
)  # fmt: skip
def test_wrong_strategies(changes, message):
    with pytest.raises(InputError, match=re.escape(message)):
        make_strategy(settings(**changes), 5)


@pytest.mark.parametrize("name", ["CMA_ES", "OpenES", "PSO"])
def test_going_on_from_arrays_gives_the_same_bits(name):
    fitness = Quadratic(noise=0.1)
    config = settings(strategy=name, generations=6)
    evolution = GeneEvolution(config, Executor(fitness))
    history = [search for search, _ in run_generations(evolution, config.generations)]
    for start in (0, 2):
        search = evolution.from_arrays(evolution.to_arrays(history[start]))
        assert same(search, history[start])
        again, _ = finish(config, fitness, search)
        assert same(again, history[-1])
    other, _ = finish(settings(strategy=name, generations=6, seed=2), fitness)
    assert not np.array_equal(other.elites, again.elites)


def test_arrays_of_another_search_are_refused():
    config, fitness = settings(generations=1), Quadratic()
    search, _ = finish(config, fitness)
    arrays = GeneEvolution(config, Executor(fitness)).to_arrays(search)
    for other, genes, message in (
        (settings(strategy="SNES"), 5, "expected float32"),
        (settings(), 6, "elites: expected float32 [4, 6], as CMA_ES of this version"),
        (settings(seed=9), 5, "expected the key of evolution.seed 9; found another"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            GeneEvolution(other, Executor(Quadratic(genes))).from_arrays(arrays)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_search_where_everything_fails_goes_on(value):
    search, rows = finish(settings(), Broken(lambda rows: rows >= 0, value))
    assert all(row["failed"] == 16 and np.isnan(row["best"]) for row in rows)
    assert search.elite_scores.tolist() == [-np.inf] * 4
    assert np.isfinite(search.state["algorithm"].mean).all()
    assert rows[-1]["step_size"] > 0.05


def test_a_stalled_search_starts_anew_and_keeps_its_champion():
    search, rows = finish(settings(generations=150), Quadratic())
    restart = next(row for row in rows if row["restarts"] == 1)
    assert restart["step_size"] > 0.2
    before = rows[restart["generation"] - 2]
    assert before["step_size"] <= 2 * STD_FLOOR * 0.5
    champions = [row["champion"] for row in rows]
    assert champions == sorted(champions)
    assert rows[-1]["champion"] > -1e-5
    assert search.restarts == rows[-1]["restarts"]


def test_a_broken_state_starts_anew():
    config, fitness = settings(generations=3), Quadratic()
    search, _ = finish(config, fitness)
    state = search.state
    broken = state["algorithm"].replace(mean=np.full(5, np.nan, np.float32))
    search = replace(search, state=state | {"algorithm": broken})
    search, rows = finish(settings(generations=5), fitness, search)
    assert [row["restarts"] for row in rows] == [1, 1]
    assert np.isfinite(search.state["algorithm"].mean).all()


def test_the_champion_is_judged_on_fresh_keys():
    class Lucky(Quadratic):
        """A bonus that depends on the key favours some genes by chance."""

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


def test_doing_nothing_is_a_candidate():

    class Still(Quadratic):
        def evaluate(self, population, key):
            _, measures = super().evaluate(population, key)
            return -jnp.sum(population**2, 1), measures

    config = settings(generations=3)
    search, _ = finish(config, Quadratic())
    champion = choose_champion(config, Still(), search)
    assert champion.origin.startswith("zero genes")
    assert champion.score == 0 and not champion.genes.any()
    # Of equal ones, what has evolved wins.
    champion = choose_champion(config, Broken(lambda rows: rows >= 0, 1.0), search)
    assert champion.origin.startswith("best of generation")
    with pytest.raises(InputError, match=r"champion: expected a score .+; found none: all failed"):
        choose_champion(config, Broken(lambda rows: rows >= 0, np.nan), search)


def test_where_a_passport_is_required_the_first_that_passes_becomes_the_champion(monkeypatch):
    config, fitness = settings(generations=30), Quadratic()
    search, _ = finish(config, fitness)
    best = choose_champion(config, fitness, search)

    def judged(fitness, genes, seed):
        right = not np.array_equal(genes, best.genes)
        return Passport({"kept": Check("kept", float(right), least=0.5)})

    monkeypatch.setattr(gene_search, "make_passport", judged)
    second = choose_champion(settings(generations=30, passport="required"), fitness, search)
    assert not np.array_equal(second.genes, best.genes) and not second.passport.failed
    assert second.score <= best.score and best.passport is None
