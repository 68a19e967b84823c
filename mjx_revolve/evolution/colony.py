"""Evolution that lives in the world: birth, meeting, mating, ageing and death, no generations.

After Revolve's online evolution (Eiben et al. 2013, "The Triangle of Life", ECAL): a population
lives in one world; robots that meet and are about as fit as each other have children, which are
born in a clinic after a gestation; how long one lives follows from its fitness. Here bodies and
brains are inherited, and energy may come from places in the water.

The world goes on in intervals, which are what a run calls generations. Within one, robots swim,
feel and touch each other (`episodes.tank`); what happens to them takes effect at its end, in a
fixed order: time, energy, deaths, matings, births. All randomness follows from the seed and the
interval's number, so that a run that is stopped goes on as if it had not been.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mjx_revolve.engine.collisions import Touch
from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.colony_config import ColonyConfig
from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.fitness import read_modules
from mjx_revolve.episodes.tank import Tank, Trail, make_tank
from mjx_revolve.evolution.body_fitness import BodyFitness
from mjx_revolve.evolution.coevolution import SHOWN, best_of, check_seed, mean_known
from mjx_revolve.evolution.individuals import Individual, from_record, to_record
from mjx_revolve.evolution.loop import summarize
from mjx_revolve.evolution.pool import Pool
from mjx_revolve.inputs.errors import InputError

# By how much of their reach more robots are kept apart where they are born. A choice.
_ROOM = 1.0
CAUSES = ("age", "energy", "lost", "failed")
"""What robots die of: age, an empty battery, the arena's end, numbers that are none."""


@dataclass(frozen=True, eq=False)
class Citizen:
    """A robot that lives in the colony.

    Attributes:
        individual: body, brain and genes; its score is its fitness.
        place: in the tank.
        born: interval's end at which it was born [s].
        track: `[W, 3]` where its core was, newest last, as if there were no edge [m]: as much as
            fitness asks for.
        offset: `[3]` from where it is within the arena to where it would be [m].
        charge: of its battery [J].
        children: how many with whom, by number.
        busy: until when it is with child [s].
    """

    individual: Individual
    place: int
    born: float
    track: np.ndarray = field(repr=False)
    offset: np.ndarray = field(repr=False)
    charge: float
    children: Mapping[int, int] = field(default_factory=dict)
    busy: float = -1.0


@dataclass(frozen=True, eq=False)
class Pregnancy:
    """A child to come.

    Attributes:
        due: when [s].
        parents: as they were; the first gives the body.
    """

    due: float
    parents: tuple[Individual, Individual]


@dataclass(frozen=True, eq=False)
class Colony:
    """Everything that passes from one interval to the next.

    Attributes:
        generation: intervals that are done.
        citizens: who lives, by number.
        pregnancies: children to come, in the order of mating.
        elites: the fittest who ever lived as long as fitness is measured, best first.
        next_number: of the next individual.
        tank: arrays of the tank; see `Tank.to_arrays`.
        seconds: time spent [s]; not reproducible.
        born: of the last interval; not part of what passes on.
        died: of the last interval, as they were at the end; likewise.
        events: of the last interval, plain values; likewise.
    """

    generation: int = 0
    citizens: Mapping[int, Citizen] = field(default_factory=dict)
    pregnancies: tuple[Pregnancy, ...] = ()
    elites: tuple[Individual, ...] = ()
    next_number: int = 0
    tank: Mapping[str, np.ndarray] = field(default_factory=dict)
    seconds: float = 0.0
    born: tuple[Individual, ...] = ()
    died: tuple[Individual, ...] = ()
    events: tuple[Mapping[str, Any], ...] = ()

    @property
    def living(self) -> tuple[Individual, ...]:
        """Individuals that are alive."""
        return tuple(citizen.individual for citizen in self.citizens.values())


def fitness_of(track: np.ndarray, look: float, settings: Any) -> float:
    """Fitness of a robot from where it was.

    5 times the speed of its net displacement and once that along its path, as Revolve's online
    evolution has it, or whatever weights are set; both horizontally and vertically.

    Args:
        track: `[W, 3]` places at equal intervals [m].
        look: the interval [s].
        settings: a `LifeConfig`.

    Returns:
        The fitness [-]; 0 for less than two places, or for one who is thrown about.
    """
    if len(track) < 2:
        return 0.0
    steps = np.linalg.norm(np.diff(track, axis=0), axis=1)
    span = look * (len(track) - 1)
    path, net = float(steps.sum()) / span, float(np.linalg.norm(track[-1] - track[0])) / span
    if not np.isfinite(path) or path > settings.limit:
        return 0.0
    return settings.net * net + settings.path * path


def life_span(fitness: float, settings: Any) -> float:
    """How old a robot of some fitness gets [s]; `settings` is a `LifeConfig`."""
    share = min(fitness, settings.full_fitness) / settings.full_fitness
    return max(settings.childhood, settings.max_age * share)


def share_power(distance: np.ndarray, settings: Any) -> np.ndarray:
    """What chargers give to robots.

    Args:
        distance: `[chargers, robots]` between them [m].
        settings: an `EnergyConfig`.

    Returns:
        `[robots]` power [W].
    """
    wanted = settings.most * np.minimum(1, (settings.reach / np.maximum(distance, 1e-9)) ** 2)
    total = wanted.sum(1, keepdims=True)
    given = wanted * np.minimum(1, settings.power / np.maximum(total, 1e-12))
    return np.minimum(given.sum(0), settings.most)


def colony_of(
    config: Config, pool: Pool, search: Colony | None = None
) -> Iterator[tuple[Colony, dict[str, float]]]:
    """Lets a colony live, one interval at a time.

    Args:
        config: how.
        pool: a pool over a `BodyFitness`.
        search: where to go on; None: a new world.

    Yields:
        The colony after each interval, and the interval's figures.
    """
    world = _Commune(config, pool.fitness)
    search = Colony() if search is None else search
    world.load(search)
    while search.generation < config.evolution.generations:
        search, row = world.advance(search)
        yield search, row


def make_colony_tank(config: Config, fitness: BodyFitness) -> Tank:
    """The tank of a colony, empty.

    Args:
        config: with a colony.
        fitness: of its bodies.

    Returns:
        The tank.

    Raises:
        InputError: the world is gusty.
    """
    assert config.colony is not None
    touch = Touch() if config.colony.touch else None
    return make_tank(fitness.mixed, config.evolution.population_size, touch=touch)


def robots_in(fitness: BodyFitness, search: Colony) -> dict[int, Robot]:
    """Who is where in a colony's tank."""
    return {c.place: fitness.build(c.individual.body) for c in search.citizens.values()}


class _Commune:
    """A colony and its tank.

    Whoever watches sets `finer`, how many rows trails have from look to look, and finds in `seen`
    who lived through the last interval, and its trail.
    """

    def __init__(self, config: Config, fitness: BodyFitness) -> None:
        assert config.colony is not None
        self.config, self.fitness = config, fitness
        self.colony: ColonyConfig = config.colony
        self.tank = make_colony_tank(config, fitness)
        step = self.tank.timestep
        # Whole steps, and whole looks in an interval.
        self.look = max(1, round(self.colony.look / step)) * step
        self.looks = max(1, round(self.colony.interval / self.look))
        self.interval = self.looks * self.look
        self.kept = 1 + max(1, round(self.colony.life.window / self.look))
        self.finer = 1
        self.seen: tuple[Mapping[int, Citizen], Trail] | None = None

    def load(self, search: Colony) -> None:
        """Fills the tank as it was."""
        if search.tank:
            self.tank.from_arrays(search.tank, robots_in(self.fitness, search))

    def advance(self, search: Colony) -> tuple[Colony, dict[str, float]]:
        """One interval."""
        began = time.perf_counter()
        generation = search.generation + 1
        rng = np.random.default_rng([self.config.evolution.seed, generation])
        self.events: list[dict[str, Any]] = []
        self.born: list[Individual] = []
        self.next_number = search.next_number
        if not search.generation:
            search = self._found(search, rng)
        self._point_out(search.citizens)
        trail = self.tank.advance(self.interval, self.look / self.finer)
        self.seen = search.citizens, trail
        trail = _every(trail, self.finer)
        now = self.tank.time
        citizens = {
            number: self._age(citizen, trail) for number, citizen in search.citizens.items()
        }
        citizens, died = self._bury(citizens, trail, now)
        citizens = self._wrap(citizens)
        citizens, pregnancies = self._mate(citizens, search.pregnancies, trail, now)
        citizens, pregnancies = self._deliver(rng, citizens, pregnancies, generation, now)
        # Only who has lived for as long as fitness is measured counts.
        known = [c.individual for c in citizens.values() if len(c.track) >= self.kept]
        elites = fittest([*search.elites, *(i for i in died if self._is_known(i)), *known])
        seconds = time.perf_counter() - began
        found = Colony(
            generation=generation,
            citizens=citizens,
            pregnancies=pregnancies,
            elites=elites,
            next_number=self.next_number,
            tank=self.tank.to_arrays(),
            seconds=search.seconds + seconds,
            born=tuple(self.born),
            died=tuple(died),
            events=tuple(self.events),
        )
        return found, self._row(found, seconds)

    # --- who is born

    def _found(self, search: Colony, rng: np.random.Generator) -> Colony:
        """The first robots: seeds, then strangers, all over the arena."""
        count, citizens = self.colony.birth.initial, dict(search.citizens)
        genotype, seeds = self.fitness.genotype, self.fitness.seeds
        for k in range(count):
            if k < len(seeds):
                assert genotype.adopt is not None
                genome, origin = genotype.adopt(seeds[k]), f"seed {seeds[k].name}"
            else:
                genome, origin = genotype.random(rng), "random"
            individual = self._grow(rng, (), 1, origin, genome)
            half = self.colony.arena.size / 2
            self._settle(rng, citizens, individual, half, square=True)
        return replace(search, citizens=citizens)

    def _grow(
        self,
        rng: np.random.Generator,
        parents: Sequence[Individual],
        generation: int,
        origin: str,
        genome: Any,
    ) -> Individual:
        """A new individual: its body, and the brain that it is born with."""
        assert self.config.bodies is not None
        body = self.fitness.genotype.develop(genome)
        layout, brains = self.fitness.layout(body), self.fitness.brains
        if not parents or self.config.bodies.brains.inheritance == "none":
            brain = brains.draw(rng, layout)
        else:
            brain = brains.inherit(rng, [parent.brain for parent in parents], layout)
        genes = brains.express(brains.to_vector(brain, layout), layout)[layout.columns]
        number, self.next_number = self.next_number, self.next_number + 1
        return Individual(
            number=number,
            parents=tuple(parent.number for parent in parents),
            born=generation,
            origin=origin,
            genome=genome,
            body=body,
            brain=brain,
            learnt=brain,
            genes=tuple(map(float, genes)),
            measures={"age": 0.0, "children": 0.0},
        )

    def _settle(
        self,
        rng: np.random.Generator,
        citizens: dict[int, Citizen],
        individual: Individual,
        radius: float,
        square: bool = False,
    ) -> bool:
        """Puts a robot in where nobody is; whether there was such a place."""
        robot = self.fitness.build(individual.body)
        reach = _reach(robot)
        others = [
            (self._place_of(c), _reach(self.fitness.build(c.individual.body)))
            for c in citizens.values()
        ]
        depth = self.tank.world.surface_height - self.config.task.depth
        for _ in range(self.colony.birth.attempts):
            x, y = rng.uniform(-1, 1, 2) * radius
            if not square:
                angle, away = rng.uniform(0, 2 * np.pi), radius * np.sqrt(rng.uniform())
                x, y = away * np.cos(angle), away * np.sin(angle)
            place = np.array([x, y, depth])
            yaw = rng.uniform(0, 2 * np.pi)
            far = [np.linalg.norm(place - other) > _ROOM * (reach + r) for other, r in others]
            if all(far):
                quat = (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
                lane = self.tank.add(
                    robot, individual.genes, place.tolist(), quat, noise=individual.number % 2**32
                )
                energy = self.colony.energy
                citizens[individual.number] = Citizen(
                    individual, lane, self.tank.time, place[None], np.zeros(3),
                    energy.start if energy else float("inf"),
                )  # fmt: skip
                self.born.append(individual)
                self._tell("birth", individual.number, place, parents=list(individual.parents),
                           origin=individual.origin)  # fmt: skip
                return True
        return False

    def _place_of(self, citizen: Citizen) -> np.ndarray:
        """Where a robot is within the arena [m]."""
        return np.asarray(citizen.track[-1] - citizen.offset)

    def _inside(self, place: np.ndarray) -> np.ndarray:
        if self.colony.arena.edge == "lost":
            return place
        size = self.colony.arena.size
        found = np.array(place, float)
        found[..., :2] -= size * np.round(found[..., :2] / size)
        return found

    def _deliver(
        self,
        rng: np.random.Generator,
        citizens: dict[int, Citizen],
        pregnancies: tuple[Pregnancy, ...],
        generation: int,
        now: float,
    ) -> tuple[dict[int, Citizen], tuple[Pregnancy, ...]]:
        """Births of those that are due, as far as there is room; then strangers."""
        assert self.config.bodies is not None
        bodies, genotype = self.config.bodies, self.fitness.genotype
        birth, places = self.colony.birth, self.config.evolution.population_size
        waiting: list[Pregnancy] = []
        for pregnancy in pregnancies:
            if pregnancy.due > now + 1e-9 or len(citizens) >= places:
                waiting.append(pregnancy)
                continue
            first, second = pregnancy.parents
            genome, origin, parents = first.genome, "mutation", [first]
            if rng.random() < bodies.crossover:
                genome, origin = genotype.cross(rng, genome, second.genome), "crossover"
            parents.append(second)
            if origin == "mutation" or rng.random() < bodies.mutation:
                genome = genotype.mutate(rng, genome)
                origin = "mutation" if origin == "mutation" else "crossover, mutation"
            child = self._grow(rng, parents, generation, origin, genome)
            if not self._settle(rng, citizens, child, birth.radius):
                self.next_number -= 1
                waiting.append(pregnancy)
        for _ in range(max(0, min(birth.least, places) - len(citizens))):
            stranger = self._grow(rng, (), generation, "random", genotype.random(rng))
            if not self._settle(rng, citizens, stranger, birth.radius):
                self.next_number -= 1
                break
        return citizens, tuple(waiting)

    # --- what becomes of them

    def _point_out(self, citizens: Mapping[int, Citizen]) -> None:
        """Tells each robot how fit others look, and where the nearest charger is."""
        full = self.colony.life.full_fitness
        for citizen in citizens.values():
            score = citizen.individual.score
            self.tank.tag[citizen.place] = 0.0 if np.isnan(score) else min(score / full, 1.0)
        energy = self.colony.energy
        if energy is None or not energy.chargers:
            return
        chargers = np.array(energy.chargers)
        target = np.zeros((3, self.tank.places))
        for citizen in citizens.values():
            away = np.linalg.norm(chargers - self._place_of(citizen), axis=1)
            target[:, citizen.place] = chargers[int(np.argmin(away))]
        self.tank.set_targets(target)

    def _age(self, citizen: Citizen, trail: Trail) -> Citizen:
        """An interval later: where it was, what it has taken, and its fitness."""
        k = citizen.place
        # The trail begins within the arena; the track goes on beyond its edges.
        fresh = trail.position[:, :, k].astype(float) + citizen.offset
        track = np.concatenate([citizen.track, fresh])[-self.kept :]
        charge = citizen.charge
        energy = self.colony.energy
        if energy is not None:
            work = float(trail.energy[:, k].sum())
            charge -= work + energy.idle * self.interval
        score = fitness_of(track, self.look, self.colony.life)
        return replace(
            citizen,
            individual=replace(citizen.individual, score=score),
            track=track,
            charge=charge,
        )

    def _charge(self, citizens: dict[int, Citizen], trail: Trail) -> dict[int, Citizen]:
        """What chargers have given over the interval."""
        energy = self.colony.energy
        if energy is None or not energy.chargers or not citizens:
            return citizens
        lanes = [citizen.place for citizen in citizens.values()]
        place = self._inside(trail.position[:, :, lanes].transpose(0, 2, 1))
        away = np.linalg.norm(place[:, None] - np.array(energy.chargers)[None, :, None], axis=-1)
        away = np.nan_to_num(away, nan=1e9)
        given = self.look * np.sum([share_power(x, energy) for x in away], 0)
        return {
            number: replace(citizen, charge=min(citizen.charge + float(joules), energy.capacity))
            for (number, citizen), joules in zip(citizens.items(), given, strict=True)
        }

    def _bury(
        self, citizens: dict[int, Citizen], trail: Trail, now: float
    ) -> tuple[dict[int, Citizen], list[Individual]]:
        """Who goes on, and who has died, as they were."""
        arena, life = self.colony.arena, self.colony.life
        citizens = self._charge(citizens, trail)
        alive, died = {}, []
        for number, citizen in citizens.items():
            place, age = citizen.track[-1], now - citizen.born
            whole = np.isfinite(trail.qpos[:, : 7 + citizen.individual.body.num_hinges,
                                           citizen.place]).all()  # fmt: skip
            low = self.tank.world.surface_height - arena.depth
            cause = None
            if not whole:
                cause = "failed"
            elif place[2] < low or (
                arena.edge == "lost" and np.abs(place[:2]).max() > arena.size / 2
            ):
                cause = "lost"
            elif citizen.charge <= 0:
                cause = "energy"
            elif age >= life_span(citizen.individual.score, life) - 1e-9:
                cause = "age"
            if cause is None:
                alive[number] = citizen
                continue
            self.tank.remove(citizen.place)
            score = float("nan") if cause == "failed" else citizen.individual.score
            ended = replace(
                citizen.individual,
                score=score,
                measures={"age": age, "children": float(sum(citizen.children.values()))},
            )
            died.append(ended)
            self._tell("death", number, self._place_of(citizen), cause=cause, age=age,
                       score=None if np.isnan(score) else score)  # fmt: skip
        return alive, died

    def _wrap(self, citizens: dict[int, Citizen]) -> dict[int, Citizen]:
        """Brings those who have left the arena back in on the other side."""
        shift, found = np.zeros((3, self.tank.places)), dict(citizens)
        for number, citizen in citizens.items():
            place = self._place_of(citizen)
            back = self._inside(place) - place
            if np.any(back):
                shift[:, citizen.place] = back
                found[number] = replace(citizen, offset=citizen.offset - back)
        if np.any(shift):
            self.tank.move(shift)
        return found

    def _mate(
        self,
        citizens: dict[int, Citizen],
        pregnancies: tuple[Pregnancy, ...],
        trail: Trail,
        now: float,
    ) -> tuple[dict[int, Citizen], tuple[Pregnancy, ...]]:
        """Pairs of those who have met, the nearest first, as long as there is room for a child."""
        mating, birth = self.colony.mating, self.colony.birth
        ready = [
            n for n, c in citizens.items()
            if now - c.born >= mating.adult and c.busy <= now and c.individual.score > 0
        ]  # fmt: skip
        if len(ready) < 2:
            return citizens, pregnancies
        lanes = [citizens[n].place for n in ready]
        place = self._inside(trail.position[:, :, lanes].transpose(0, 2, 1))
        away = np.linalg.norm(place[:, :, None] - place[:, None], axis=-1)
        nearest = away.min(0)
        first, second = np.nonzero(np.triu(nearest <= mating.distance, 1))
        taken: set[int] = set()
        found = list(pregnancies)
        room = self.config.evolution.population_size - len(citizens)
        for k in np.lexsort((second, first, nearest[first, second])):
            pair = ready[first[k]], ready[second[k]]
            one, other = (citizens[n] for n in pair)
            scores = one.individual.score, other.individual.score
            have = one.children.get(pair[1], 0)
            if len(found) >= room:
                break
            if taken & set(pair) or have >= mating.children:
                continue
            if min(scores) < mating.likeness * max(scores):
                continue
            taken |= set(pair)
            due = now + birth.gestation
            fitter, less = (one, other) if scores[0] >= scores[1] else (other, one)
            found.append(Pregnancy(due, (fitter.individual, less.individual)))
            for mine, theirs in (pair, pair[::-1]):
                children = {**citizens[mine].children, theirs: have + 1}
                citizens[mine] = replace(citizens[mine], busy=due, children=children)
            when = int(np.argmin(away[:, first[k], second[k]]))
            where = (place[when, first[k]] + place[when, second[k]]) / 2
            self._tell("mating", pair[0], where, other=pair[1])
        return citizens, tuple(found)

    def _tell(self, event: str, number: int, place: np.ndarray, **facts: Any) -> None:
        """Notes an event."""
        where = [round(float(x), 3) if np.isfinite(x) else None for x in place]
        head = {"time": round(self.tank.time, 6), "event": event, "id": number, "place": where}
        self.events.append(head | facts)

    def _is_known(self, individual: Individual) -> bool:
        """Whether one who has died had lived for as long as fitness is measured."""
        return individual.measures["age"] >= self.look * (self.kept - 1) - 1e-9

    # --- what is told

    def _row(self, search: Colony, seconds: float) -> dict[str, float]:
        living = search.living
        scores = np.array([individual.score for individual in living])
        now, count = self.tank.time, {name: 0 for name in ("birth", "mating", "death")}
        causes = dict.fromkeys(CAUSES, 0)
        for event in search.events:
            count[event["event"]] += 1
            if event["event"] == "death":
                causes[event["cause"]] += 1
        ages = [now - citizen.born for citizen in search.citizens.values()]
        charges = [citizen.charge for citizen in search.citizens.values()]
        row: dict[str, float] = {
            "generation": search.generation,
            "evaluations": search.next_number,
            **summarize(scores),
            "champion": search.elites[0].score if search.elites else float("nan"),
            "failed": causes["failed"],
            "living": len(living),
            "living_mean": mean_known(scores),
            "time": now,
            "births": count["birth"],
            "matings": count["mating"],
            **{f"died_of_{name}": causes[name] for name in CAUSES},
            "expected": len(search.pregnancies),
            "mean_age": mean_known(ages),
        }
        if self.colony.energy is not None:
            row["mean_charge"] = mean_known(charges)
        for name in SHOWN:
            row[f"mean_{name}"] = mean_known([float(i.descriptors[name]) for i in living])
        row["seconds"] = search.seconds
        row["times_real_time"] = self.interval / seconds
        row["evaluations_per_second"] = len(self.born) / seconds
        return row


def fittest(individuals: Sequence[Individual]) -> tuple[Individual, ...]:
    """Those with the best scores, each once and at its best; of equals, the older ones."""
    known: dict[int, Individual] = {}
    for individual in individuals:
        if np.isfinite(individual.score):
            best = known.setdefault(individual.number, individual)
            known[individual.number] = max(best, individual, key=lambda i: i.score)
    return best_of(list(known.values()))


def _every(trail: Trail, stride: int) -> Trail:
    """A trail of every so many of its rows, with all of its energy."""
    if stride == 1:
        return trail
    energy = trail.energy.reshape(-1, stride, trail.energy.shape[1]).sum(1)
    k = slice(stride - 1, None, stride)
    return trail._replace(time=trail.time[k], qpos=trail.qpos[k], energy=energy)


def _reach(robot: Robot) -> float:
    """How far a robot's corners are from its core at rest [m]."""
    corners = robot.assembly.layout.core_corners()
    return float(np.linalg.norm(corners, axis=-1).max())


# --- to and from a checkpoint ---------------------------------------------------------------------

_COUNTERS = ("generation", "next_number", "seconds")


def colony_to_arrays(config: Config, fitness: BodyFitness, search: Colony) -> dict[str, Any]:
    """A colony as named arrays, for `runs.Run.save_checkpoint`."""
    people = {i.number: i for i in (*search.elites, *search.living)}
    expected = [(p.due, *(i.number for i in p.parents)) for p in search.pregnancies]
    # Parents as they were when they mated; of several matings, their bodies and brains are one.
    parents = {i.number: i for p in search.pregnancies for i in p.parents}
    people = parents | people
    citizens = [
        {
            "id": number,
            "place": c.place,
            "born": c.born,
            "charge": None if c.charge == float("inf") else c.charge,
            "children": [[k, n] for k, n in c.children.items()],
            "busy": c.busy,
            "offset": c.offset.tolist(),
            "length": len(c.track),
        }
        for number, c in search.citizens.items()
    ]
    records = [to_record(people[number], fitness.genotype) for number in sorted(people)]
    plain = {
        "citizens": citizens,
        "expected": expected,
        "elites": [[i.number, i.score] for i in search.elites],
        "individuals": records,
    }
    found = {name: np.asarray(getattr(search, name)) for name in _COUNTERS}
    found["seed"] = np.asarray(config.evolution.seed)
    found["plain"] = np.frombuffer(json.dumps(plain).encode(), np.uint8)
    tracks = [c.track for c in search.citizens.values()]
    found["tracks"] = np.concatenate([*tracks, np.zeros((0, 3))])
    return found | {f"tank.{name}": value for name, value in search.tank.items()}


def colony_from_arrays(
    config: Config, fitness: BodyFitness, arrays: Mapping[str, np.ndarray]
) -> Colony:
    """The inverse of `colony_to_arrays`.

    Raises:
        InputError: the arrays are damaged, or those of another run.
    """
    try:
        check_seed(config, arrays)
        modules = read_modules(config)
        plain = json.loads(arrays["plain"].tobytes())
        people = {}
        for record in plain["individuals"]:
            individual = from_record(record, fitness.genotype, modules, fitness.brains.check)
            people[individual.number] = individual
        citizens, start = {}, 0
        for row in plain["citizens"]:
            end = start + int(row["length"])
            charge = row["charge"]
            citizens[int(row["id"])] = Citizen(
                individual=people[int(row["id"])],
                place=int(row["place"]),
                born=float(row["born"]),
                track=arrays["tracks"][start:end],
                offset=np.array(row["offset"], float),
                charge=float("inf") if charge is None else float(charge),
                children={int(k): int(n) for k, n in row["children"]},
                busy=float(row["busy"]),
            )
            start = end
        pregnancies = tuple(
            Pregnancy(float(due), (people[int(a)], people[int(b)]))
            for due, a, b in plain["expected"]
        )
        elites = tuple(replace(people[int(n)], score=float(score)) for n, score in plain["elites"])
        tank = {k.removeprefix("tank."): v for k, v in arrays.items() if k.startswith("tank.")}
        fields: dict[str, Any] = {name: arrays[name].item() for name in _COUNTERS}
        return Colony(
            citizens=citizens, pregnancies=pregnancies, elites=elites, tank=tank, **fields
        )
    except InputError:
        raise
    except (KeyError, ValueError, TypeError, AttributeError, OverflowError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"expected a colony; found {reason}") from None
