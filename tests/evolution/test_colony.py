"""A colony: its rules by hand, births and deaths that add up, resume."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from laboratory import ROOT
from mjx_revolve.episodes.colony_config import ColonyConfig, EnergyConfig, LifeConfig
from mjx_revolve.episodes.config import load_config, make_config
from mjx_revolve.episodes.individual_log import INDIVIDUALS
from mjx_revolve.episodes.tank import TankTrajectory
from mjx_revolve.evolution.body_fitness import make_body_fitness
from mjx_revolve.evolution.colony import (
    CAUSES,
    Colony,
    Member,
    PendingBirth,
    age_members,
    fitness_of,
    found_colony,
    give_birth,
    life_span,
    make_rules,
    mate,
    remove_dead,
    share_power,
    wrap_edges,
)
from mjx_revolve.evolution.colony_search import ColonyEvolution
from mjx_revolve.evolution.executor import Executor, make_executor
from mjx_revolve.evolution.generations import run_generations
from mjx_revolve.evolution.reproduction import make_founder
from mjx_revolve.inputs.errors import InputError
from toys import COLONY


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
    """Within reach robots get the most; beyond, power falls as 1/d²; many robots share it."""
    energy = EnergyConfig(power=1.0, most=0.5, reach=1.0)
    assert share_power(np.array([[0.5, 2.0]]), energy) == pytest.approx([0.5, 0.125])
    assert share_power(np.full((1, 8), 0.2), energy) == pytest.approx(1 / 8)
    assert share_power(np.array([[0.5], [0.5]]), energy) == pytest.approx([0.5])


@pytest.fixture(scope="module")
def config():
    return make_config(COLONY, ROOT)


@pytest.fixture(scope="module")
def fitness(config):
    return make_body_fitness(config)


pytestmark = pytest.mark.usefixtures("quick_compiles")


@pytest.fixture(scope="module")
def rules(fitness):
    return make_rules(fitness)


def stand(fitness, places, scores, end=10.0):
    """A colony of members that stood still at some places, and their trajectory up to a time."""
    rng, members = np.random.default_rng(0), {}
    qpos = np.zeros((4, 7 + fitness.mixed.capacity.hinges, 8))
    for k, (place, score) in enumerate(zip(places, scores, strict=True)):
        individual = replace(make_founder(fitness, rng, k, 1), score=score)
        members[k] = Member(individual, k, 0.0, np.array([place], float), np.zeros(3), 5.0)
        qpos[:, :3, k] = place
    time = end - np.arange(4.0)[::-1]
    return Colony(members=members), TankTrajectory(time, qpos, np.zeros((4, 8)), np.ones(8, bool))


def parents(colony):
    """Numbers of the parents of children to come."""
    return [tuple(parent.number for parent in p.parents) for p in colony.pending_births]


def test_mating(fitness, rules):
    """The nearest first, each once; alike in fitness, adult, not gestating, pairs not too often,
    and only as long as there is room."""
    # Along a line: 0 and 1 are near, 2 a bit farther from 1, 3 far, 4 near 3 but much less fit.
    places = [(0, 0, -1), (0.3, 0, -1), (0.7, 0, -1), (-1.0, 1.0, -1), (-0.9, 1.0, -1)]
    colony, trajectory = stand(fitness, places, [0.1, 0.2, 0.15, 0.2, 0.01])
    mated, [event] = mate(colony, trajectory, rules)
    members = mated.members
    assert parents(mated) == [(1, 0)] and mated.pending_births[0].due == 16.0  # the fitter first
    assert members[0].busy_until == members[1].busy_until == 16.0
    assert members[0].children == {1: 1} and members[1].children == {0: 1}
    assert not members[2].children
    assert event["id"] == 0 and event["other"] == 1 and event["place"] == [0.15, 0, -1]
    # While it gestates, 1 does not mate; then with 2, as 0 and 1 have had their two.
    assert parents(mate(mated, trajectory._replace(time=trajectory.time + 2), rules)[0]) == [(1, 0)]
    later = {n: replace(m, busy_until=10.0 + 1e-12) for n, m in members.items()}
    later[0], later[1] = (replace(later[a], children={b: 2}) for a, b in ((0, 1), (1, 0)))
    assert parents(mate(Colony(members=later), trajectory, rules)[0]) == [(1, 2)]
    # Robots of 2 s do not mate, nor does any where all slots are promised.
    young = {n: replace(m, born=8.0) for n, m in colony.members.items()}
    assert parents(mate(Colony(members=young), trajectory, rules)[0]) == []
    promised = (PendingBirth(99.0, mated.pending_births[0].parents),) * 3
    full = replace(colony, pending_births=promised)
    assert mate(full, trajectory, rules)[0].pending_births == full.pending_births
    # One beyond the edge meets whom it touches there, not whom it will be put beside.
    for x, met in ((1.2, [(0, 1)]), (-1.2, [])):
        beside = stand(fitness, [(1.3, 0, -1), (x, 0, -1)], [0.2, 0.1])
        assert parents(mate(*beside, rules)[0]) == met


def test_deaths(fitness, rules):
    places = [(0, 0, -1), (1, 0, -3.5), (0, 1, -1), (1, 1, -1), (-1, 0, -1)]
    colony, trajectory = stand(fitness, places, [0.2, 0.2, 0.02, 0.2, 0.2], end=13.0)
    empty = replace(colony.members[3], charge=-9.0)
    trajectory.qpos[2, 4, 4] = np.nan
    # 2 has a tenth of full fitness: its childhood of 12 s is longer than 4 s.
    left, events = remove_dead(
        replace(colony, members={**colony.members, 3: empty}), trajectory, rules
    )
    assert list(left.members) == [0]
    assert {e["id"]: e["cause"] for e in events} == {1: "lost", 2: "age", 3: "energy", 4: "failed"}
    assert {e["cause"] for e in events} == set(CAUSES)
    assert np.isnan([one.score for one in left.died]).all()  # too young for their fitness to count
    whole = replace(left.members[0], track=np.zeros((rules.window, 3)))
    assert rules.measured(whole).score == 0.2
    assert left.died[0].measures == {"age": 13.0, "children": 0.0}


def test_an_interval_costs_energy_and_chargers_give_it(fitness, rules):
    """The charger at the origin gives 0 all it takes, .2 W for four looks of .5 s; idling costs
    .2 W over the interval of 4 s, motors what the trajectory has."""
    colony, trajectory = stand(fitness, [(0, 0, -1)], [0.0])
    trajectory.energy[:, 0] = 0.25
    member = age_members(colony, trajectory, rules).members[0]
    assert member.charge == pytest.approx(5.0 + 0.2 * 4 * 0.5 - 0.2 * 4.0 - 4 * 0.25)


def test_drifting_is_no_fitness(fitness, rules):
    """What the current carries has none; what keeps its place in it swims."""
    colony, trajectory = stand(fitness, [(0, 0, -1), (0, 0, -1)], [0.0, 0.0])
    trajectory.qpos[:, 0, 0] = 0.1 * rules.look * np.arange(1, 5)
    aged = age_members(colony, trajectory, rules._replace(current=np.array([0.1, 0, 0])))
    scores = [member.individual.score for member in aged.members.values()]
    assert scores == pytest.approx([0.0, 5 * 0.1 + 0.1])


def test_edges_wrap_without_a_jump_in_the_track(fitness, rules):
    colony, trajectory = stand(fitness, [(1.3, 0, -1)], [0.1])
    wrapped, shift = wrap_edges(colony, rules)
    assert shift[:, 0].tolist() == [-2.5, 0, 0] and not shift[:, 1:].any()
    member = wrapped.members[0]
    assert member.offset.tolist() == [2.5, 0, 0]
    assert member.position == pytest.approx([-1.2, 0, -1])
    trajectory.qpos[:, 0, 0] = [-1.2, -1.15, -1.1, -1.05]
    track = age_members(wrapped, trajectory, rules).members[0].track
    assert track[:, 0] == pytest.approx([1.3, 1.3, 1.35, 1.4, 1.45])


def test_births(fitness, rules):
    """Children that are due, in free slots and away from others, then founders up to the least."""
    colony, _ = stand(fitness, [(0, 0, -1), (0, 0.8, -1)], [0.2, 0.1])
    one, other = (member.individual for member in colony.members.values())
    pending = tuple(PendingBirth(due, (one, other)) for due in (10.0, 11.0))
    colony = replace(colony, pending_births=pending, next_number=2, generation=7)
    found, events = give_birth(colony, 10.0, rules, np.random.default_rng(1))
    assert found.pending_births == pending[1:]  # 11 s is not yet
    assert list(found.members) == [0, 1, 2] and found.next_number == 3
    child = found.members[2]
    assert child.individual.parents == (0, 1) and child.individual.born == 7
    assert child.slot == 2 and child.born == 10.0 and child.charge == 5.0
    assert np.hypot(*child.position[:2]) <= 1.0 and child.position[2] == -1.0
    assert found.born == (child.individual,) and events[0]["parents"] == [0, 1]
    # Of two in a full clinic, none is born: the child waits, and no founder takes its number.
    birth = rules.colony.birth.model_copy(update={"radius": 0.0})
    packed = rules._replace(colony=rules.colony.model_copy(update={"birth": birth}))
    found, events = give_birth(colony, 10.0, packed, np.random.default_rng(1))
    assert found.pending_births == pending and found.next_number == 2 and not events


def test_founders_are_seeds_their_mutants_and_random_ones():
    sown = {"max_modules": 17, "max_hinges": 8, "seeds": ["spider"], "random": 0.4}
    wide = {**COLONY["colony"], "arena": {"size": 9.0}}
    config = make_config({**COLONY, "bodies": sown, "colony": wide}, ROOT)
    rules = make_rules(make_body_fitness(config))
    found, _ = found_colony(Colony(), 0.0, rules, np.random.default_rng(0))
    origins = [one.origin for one in found.living]
    assert origins == ["seed spider", *["mutant of spider"] * 2, "random", "random"]


def test_the_noise_of_sensors_follows_from_the_seed(fitness):
    def noise(seed):
        config = make_config(COLONY | {"evolution": COLONY["evolution"] | {"seed": seed}}, ROOT)
        evolution = ColonyEvolution(config, Executor(fitness, fitness.block_size))
        evolution.ask(evolution.start())
        return set(evolution.tank.to_arrays()["noise"][evolution.tank.alive].tolist())

    assert noise(3) == noise(3) and len(noise(3)) > 1 and not noise(3) & noise(4)


@pytest.fixture(scope="module")
def history(config):
    """All intervals of a small colony: searches and rows."""
    with make_executor(config, workers=1) as executor:
        evolution = ColonyEvolution(config, executor)
        return list(run_generations(evolution, config.evolution.generations)), evolution


@pytest.mark.slow
def test_births_and_deaths_add_up(history, config):
    found, evolution = history
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
        assert set(search.members) == alive and row["living"] == len(alive)
        assert 3 <= len(alive) <= 8
        slots = [member.slot for member in search.members.values()]
        assert len(set(slots)) == len(slots)
        assert row["time"] == pytest.approx(4.0 * search.generation)
        assert not row["best"] > row["champion"]  # newborns' short spurts do not count
    last = (json.loads(line) for line in evolution.logs(search)[INDIVIDUALS])
    ages = {line["id"]: line["measures"]["age"] for line in last}
    assert all(ages[n] == 48.0 - member.born for n, member in search.members.items())
    events = [e["event"] for search, _ in found for e in search.events]
    assert {"birth", "mating", "death"} == set(events)  # this seed has all of them
    children = [i for search, _ in found for i in search.born if i.parents]
    assert children and all(len(i.parents) == 2 for i in children)


@pytest.mark.slow
def test_it_goes_on_from_any_checkpoint_bit_for_bit(history, config):
    found, evolution = history
    again = evolution.from_arrays(evolution.to_arrays(found[1][0]))
    rest = list(run_generations(evolution, config.evolution.generations, again))
    assert len(rest) == len(found) - 2
    for (one, row), (other, same) in zip(found[2:], rest, strict=True):
        assert json.dumps(one.events) == json.dumps(other.events)
        for name in row:
            if name not in ("seconds", "times_real_time", "evaluations_per_second"):
                assert np.array_equal(row[name], same[name], equal_nan=True), name
    last, same = (evolution.to_arrays(rows[-1][0]) for rows in (found, rest))
    assert last.keys() == same.keys()
    for name in last.keys() - {"seconds"}:
        # Slots that are free, or whose robot begins next, are stepped along with what was there.
        if not name.startswith("tank."):
            assert np.array_equal(last[name], same[name]), name
    begun = np.flatnonzero(last["tank.alive"] & ~last["tank.new"])
    assert begun.size
    for slot in begun:
        rows = evolution.tank.robots[slot].num_hinges
        for name in last:
            if name.startswith("tank.passage") and last[name].ndim:
                # So are rows of hinges that its body has not.
                own = np.s_[:rows, ..., slot] if last[name].ndim == 4 else np.s_[..., slot]
                assert np.array_equal(last[name][own], same[name][own]), name


def test_what_cannot_be_a_colony_is_refused():
    bodies, colony = COLONY["bodies"], COLONY["colony"]
    for changes, said in (
        ({"bodies": None},
         "bodies: expected how bodies evolve, as there is a colony; found nothing"),
        ({"bodies": bodies | {"learning": {"population_size": 4}}},
         "bodies.learning: expected nothing, as in a colony"),
        ({"bodies": bodies | {"seeds": ["core"] * 6}},
         "birth.initial: expected at least as many as bodies.seeds (6)"),
        ({"birth": {"initial": 9, "radius": 1.0}},
         "birth.initial: expected at most evolution.population_size (8); found 9"),
        ({"look": 5.0}, "look: expected at most the interval (4 s); found 5"),
        ({"arena": {"edge": "wall"}}, "colony.arena.edge: expected"),
        ({"arena": {"size": 2.5, "depth": 1.0}}, "arena.depth: expected more than task.depth (1 m"),
        ({"life": {"window": 9.0, "max_age": 8.0}}, "window: expected at most life.max_age (8 s)"),
        ({"energy": {"chargers": [[0, 9, -1]]}}, "chargers[0]: expected a place in the arena"),
    ):  # fmt: skip
        data = COLONY | (changes if "bodies" in changes else {"colony": colony | changes})
        with pytest.raises(InputError, match=re.escape(said)):
            make_config(data, ROOT)
    shallow = make_config(COLONY | {"world": COLONY["world"] | {"bed": -0.5}}, ROOT)
    with pytest.raises(InputError, match=r"task.depth: expected less than 0.5 m, the least depth"):
        make_rules(make_body_fitness(shallow))


def test_times_that_are_rounded_are_noted(config, fitness, caplog):
    step = fitness.mixed.world.timestep
    for look, window in ((1.4, 60), (1, 20.4)):
        times = {"look": look * step, "interval": 14 * step, "life": {"window": window * step}}
        odd = make_config(COLONY | {"colony": COLONY["colony"] | times}, ROOT)
        assert make_rules(replace(fitness, config=odd)).window == round(window) + 1
    found = "look: 0.0125 s, as it is whole steps", "life.window: 0.25 s, as it is whole looks"
    assert caplog.messages == [f"colony.{words} of 0.0125 s" for words in found]


@pytest.mark.slow
def test_the_shipped_configuration():
    """What docs/colony.md says of it."""
    config = load_config(ROOT / "configs" / "lake_colony.yaml")
    colony = config.colony
    assert isinstance(colony, ColonyConfig) and colony.energy is None and colony.touch
    assert (colony.birth.initial, config.evolution.population_size) == (48, 64)
    assert colony.interval * config.evolution.generations == 7200
    assert config.bodies.brains.inheritance == "darwinian"
