"""A colony: fitness and life by hand, who mates, births and deaths that add up, resume."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
import yaml

from laboratory import QUICK, ROOT
from mjx_revolve.episodes.colony_config import ColonyConfig, EnergyConfig, LifeConfig
from mjx_revolve.episodes.config import load_config, make_config
from mjx_revolve.episodes.lives import read_generations, read_lives
from mjx_revolve.episodes.tank import Trail
from mjx_revolve.evolution.body_fitness import make_body_fitness
from mjx_revolve.evolution.colony import (
    Citizen,
    Colony,
    Pregnancy,
    _Commune,
    colony_from_arrays,
    colony_of,
    colony_to_arrays,
    fitness_of,
    life_span,
    share_power,
)
from mjx_revolve.evolution.pool import make_pool
from mjx_revolve.evolve import main
from mjx_revolve.inputs.errors import InputError

SETTINGS = {
    "trim": "neutral",
    "world": {"name": "empty_underwater", "bed": False, "drag": "ellipsoid", "timestep": 0.0125},
    "controller": {"type": "sine"},
    "task": {"type": "speed", "duration": 2.0, "settle": 0.5, "trials": 1, "depth": 1.0},
    "bodies": {
        "max_modules": 5,
        "max_hinges": 2,
        "brains": {"inheritance": "darwinian", "std_init": 1.0},
    },
    "colony": {
        "interval": 4.0,
        "look": 0.5,
        "arena": {"size": 2.5, "depth": 3.0},
        "birth": {"radius": 1.0, "gestation": 6.0, "initial": 5, "least": 3},
        "mating": {"distance": 0.9, "likeness": 0.1, "adult": 3.0, "children": 2},
        "life": {"window": 4.0, "max_age": 40.0, "childhood": 12.0, "full_fitness": 0.2},
        "energy": {"start": 5.0, "capacity": 8.0, "idle": 0.2, "chargers": [[0, 0, -1]]},
    },
    "evolution": {"population_size": 8, "generations": 12, "checkpoint_every": 5, "seed": 3},
}


def test_fitness_by_hand():
    """A zigzag: 1 m forth in 10 s while the path is twice as long; weights 5 and 1."""
    zigzag = np.array([[0, 0, 0], [0.5, np.sqrt(0.75), 0], [1.0, 0, 0]])
    assert fitness_of(zigzag, 5.0, LifeConfig()) == pytest.approx(5 * 0.1 + 0.2)
    assert fitness_of(zigzag[:1], 5.0, LifeConfig()) == 0
    assert fitness_of(zigzag, 1.0, LifeConfig(limit=0.5)) == 0  # 1 m/s: thrown about
    assert fitness_of(np.array([[0, 0, 0], [np.nan, 0, 0]]), 1.0, LifeConfig()) == 0


def test_life_span_by_hand():
    life = LifeConfig(max_age=100.0, full_fitness=0.5, childhood=10.0)
    assert [life_span(f, life) for f in (0.0, 0.25, 0.5, 2.0)] == pytest.approx([10, 50, 100, 100])


def test_chargers_share_their_power():
    """Within reach everybody gets the most; beyond it falls as 1/d²; a crowd shares."""
    energy = EnergyConfig(power=1.0, most=0.5, reach=1.0)
    assert share_power(np.array([[0.5, 2.0]]), energy) == pytest.approx([0.5, 0.125])
    crowd = share_power(np.full((1, 8), 0.2), energy)
    assert crowd == pytest.approx(1 / 8)
    assert share_power(np.array([[0.5], [0.5]]), energy) == pytest.approx([0.5])


@pytest.fixture(scope="module")
def config():
    return make_config(SETTINGS, ROOT)


@pytest.fixture(scope="module")
def fitness(config):
    return make_body_fitness(config)


@pytest.fixture(scope="module", autouse=True)
def quick_compiles():
    """Leaves out the compiler's optimisations."""
    with pytest.MonkeyPatch.context() as patch:
        for place in ("tank", "evaluation"):
            patch.setattr(f"mjx_revolve.episodes.{place}.compiler_options", lambda: QUICK)
        yield


def crowd(commune, places, scores, born=0.0):
    """Citizens who stood still at some places; those before each one are numbered from 0."""
    rng, citizens = np.random.default_rng(0), {}
    commune.events, commune.born, commune.next_number = [], [], 0
    genotype = commune.fitness.genotype
    trail = np.zeros((4, 7 + commune.tank.mixed.capacity.hinges, commune.tank.places))
    for k, (place, score) in enumerate(zip(places, scores, strict=True)):
        individual = commune._grow(rng, (), 1, "random", genotype.random(rng))
        individual = replace(individual, score=score)
        track = np.array([place], float)
        citizens[k] = Citizen(individual, k, born, track, np.zeros(3), 5.0)
        trail[:, :3, k] = place
    return citizens, Trail(np.arange(4.0), trail, np.zeros((4, 8)), np.ones(8, bool))


def test_who_mates(config, fitness):
    """The nearest first, each once; alike in fitness, adult, not with child, pairs not too often,
    and only as long as there is room."""
    commune = _Commune(config, fitness)
    # Along a line: 0 and 1 are near, 2 a bit farther from 1, 3 far, 4 near 3 but much less fit.
    places = [(0, 0, -1), (0.3, 0, -1), (0.7, 0, -1), (-1.0, 1.0, -1), (-0.9, 1.0, -1)]
    citizens, trail = crowd(commune, places, [0.1, 0.2, 0.15, 0.2, 0.01])
    mated, found = commune._mate(citizens, (), trail, 10.0)
    assert [tuple(i.number for i in p.parents) for p in found] == [(1, 0)]  # the fitter first
    assert found[0].due == 16.0 and mated[0].busy == mated[1].busy == 16.0
    assert mated[0].children == {1: 1} and mated[1].children == {0: 1} and not mated[2].children
    [event] = commune.events
    assert event["id"] == 0 and event["other"] == 1 and event["place"] == [0.15, 0, -1]
    # With child, 1 mates with nobody; then with 2, as 0 and 1 have had their two.
    again, more = commune._mate(mated, found, trail, 12.0)
    assert len(more) == 1 and again is not None
    later = {n: replace(c, busy=-1.0) for n, c in mated.items()}
    later[0], later[1] = (replace(later[a], children={b: 2}) for a, b in ((0, 1), (1, 0)))
    _, third = commune._mate(later, (), trail, 20.0)
    assert [tuple(i.number for i in p.parents) for p in third] == [(1, 2)]
    # Children of 3 s mate with nobody, nor does anybody where all places are promised.
    assert (
        commune._mate({n: replace(c, born=8.0) for n, c in citizens.items()}, (), trail, 10.0)[1]
        == ()
    )
    full = tuple(Pregnancy(99.0, found[0].parents) for _ in range(3))
    assert commune._mate(citizens, full, trail, 10.0)[1] == full


def test_who_dies(config, fitness):
    commune = _Commune(config, fitness)
    places = [(0, 0, -1), (1, 0, -3.5), (0, 1, -1), (1, 1, -1), (-1, 0, -1)]
    citizens, trail = crowd(commune, places, [0.2, 0.2, 0.02, 0.2, 0.2])
    for k in range(5):
        commune.tank.robots[k] = fitness.build(citizens[k].individual.body)
    citizens[3] = replace(citizens[3], charge=-9.0)
    trail.qpos[2, 4, 4] = np.nan
    # 2 has a tenth of full fitness: its childhood of 12 s is longer than 4 s.
    alive, died = commune._bury(citizens, trail, 13.0)
    assert list(alive) == [0]
    assert {e["id"]: e["cause"] for e in commune.events} == {
        1: "lost", 2: "age", 3: "energy", 4: "failed"
    }  # fmt: skip
    assert np.isnan(died[-1].score) and died[0].measures == {"age": 13.0, "children": 0.0}
    # The charger at the origin has given 0 all it takes: .2 W for four looks of .5 s.
    assert alive[0].charge == pytest.approx(5.0 + 0.2 * 4 * 0.5)


def test_edges_wrap_without_a_jump_in_the_track(config, fitness):
    commune = _Commune(config, fitness)
    citizens, trail = crowd(commune, [(1.3, 0, -1)], [0.1])
    found = commune._wrap(citizens)[0]
    assert found.offset.tolist() == [2.5, 0, 0]
    assert commune._place_of(found) == pytest.approx([-1.2, 0, -1])
    trail.qpos[:, 0, 0] = [-1.2, -1.15, -1.1, -1.05]
    track = commune._age(found, trail).track
    assert track[:, 0] == pytest.approx([1.3, 1.3, 1.35, 1.4, 1.45])


@pytest.fixture(scope="module")
def lives(config):
    """All intervals of a small colony: searches and rows."""
    with make_pool(config, workers=1) as pool:
        return list(colony_of(config, pool)), pool


@pytest.mark.slow
def test_births_and_deaths_add_up(lives, config):
    found, _ = lives
    alive, seen = set(), set()
    total = 0
    for search, row in found:
        for event in search.events:
            if event["event"] == "birth":
                assert event["id"] not in seen
                assert set(event["parents"]) <= seen
                seen.add(event["id"])
                alive.add(event["id"])
                total += 1
            if event["event"] == "death":
                alive.remove(event["id"])
        assert set(search.citizens) == alive and row["living"] == len(alive)
        assert 3 <= len(alive) <= 8
        places = [c.place for c in search.citizens.values()]
        assert len(set(places)) == len(places)
        assert row["time"] == pytest.approx(4.0 * search.generation)
    events = [e["event"] for search, _ in found for e in search.events]
    assert {"birth", "mating", "death"} == set(events)  # this seed has all of them
    children = [i for search, _ in found for i in search.born if i.parents]
    assert children and all(len(i.parents) == 2 for i in children)


@pytest.mark.slow
def test_it_goes_on_from_any_checkpoint_bit_for_bit(lives, config):
    found, pool = lives
    fitness = pool.fitness
    arrays = colony_to_arrays(config, fitness, found[4][0])
    again = colony_from_arrays(config, fitness, arrays)
    rest = list(colony_of(config, pool, again))
    assert len(rest) == len(found) - 5
    for (one, row), (other, same) in zip(found[5:], rest, strict=True):
        assert json.dumps(one.events) == json.dumps(other.events)
        for name in row:
            if name not in ("seconds", "times_real_time", "evaluations_per_second"):
                assert np.array_equal(row[name], same[name], equal_nan=True), name
    last, same = (colony_to_arrays(config, fitness, s[-1][0]) for s in (found, rest))
    assert last.keys() == same.keys()
    for name in last.keys() - {"seconds"}:
        # Places that nobody has are stepped along, whoever was there last.
        if not name.startswith("tank."):
            assert np.array_equal(last[name], same[name]), name
    here = last["tank.alive"]
    for name in last:
        if name.startswith("tank.passage") and last[name].ndim:
            assert np.array_equal(last[name][..., here], same[name][..., here]), name


@pytest.mark.slow
def test_the_command_writes_and_resumes_a_run(tmp_path, lives, capsys):
    """Stopped after five intervals and resumed, it tells what `lives` did in one go."""
    path, run = tmp_path / "colony.yaml", tmp_path / "run"
    path.write_text(yaml.safe_dump(SETTINGS))
    assert main([str(path), "--out", str(run), "--set", "evolution.generations=5"]) == 0
    assert main(["--resume", str(run), "--set", "evolution.generations=10"]) == 0
    searches = [search for search, _ in lives[0][:10]]
    events = [json.loads(line) for line in (run / "events.jsonl").read_text().splitlines()]
    assert events == json.loads(json.dumps([e for search in searches for e in search.events]))
    living, _ = read_generations(run)
    assert living == {s.generation: tuple(i.number for i in s.living) for s in searches}
    people, wrong = read_lives(run)
    assert not wrong and sorted(people) == list(range(searches[-1].next_number))
    ended = {i.number: i.score for search in searches for i in search.died}
    for number, score in ended.items():
        assert people[number].score == pytest.approx(score, nan_ok=True)
    assert (run / "champion" / "genes.yaml").is_file()
    out = capsys.readouterr().out
    assert "champion:" in out and "generation 10/10" in out


def test_what_cannot_be_a_colony_is_refused():
    def wrong(**changes):
        data = {**SETTINGS, **changes}
        with pytest.raises(InputError) as error:
            make_config(data, ROOT)
        return str(error.value)

    assert "bodies: expected how bodies evolve, as there is a colony; found nothing" in wrong(
        bodies=None
    )
    learning = {**SETTINGS["bodies"], "learning": {"population_size": 4}}
    assert "bodies.learning: expected nothing, as in a colony" in wrong(bodies=learning)
    colony = SETTINGS["colony"]
    many = {**colony, "birth": {"initial": 9, "radius": 1.0}}
    assert "birth.initial: expected at most evolution.population_size (8); found 9" in wrong(
        colony=many
    )
    assert "look: expected at most the interval (4 s); found 5" in wrong(
        colony={**colony, "look": 5.0}
    )
    assert "colony.arena.edge: expected" in wrong(colony={**colony, "arena": {"edge": "wall"}})


def test_a_gusty_world_is_refused(config):
    gust = {"std": 0.1, "time": 2.0}
    data = {**SETTINGS, "world": {"name": "lake", "bed": False, "gust": gust}}
    with (
        pytest.raises(InputError, match="without gusts"),
        make_pool(make_config(data, ROOT), workers=1) as pool,
    ):
        _Commune(pool.config, pool.fitness)


def test_the_shipped_configuration_loads():
    found = load_config(ROOT / "configs" / "lake_colony.yaml")
    assert isinstance(found.colony, ColonyConfig)
    assert Colony().living == () and jax.device_count() > 0
