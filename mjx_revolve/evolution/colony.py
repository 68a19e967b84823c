"""The rules of a colony: robots in one world that meet, mate, are born, age and die.

After Revolve's online evolution (Eiben et al. 2013, "The Triangle of Life", ECAL): robots that meet
and have similar fitness have children, which are born in a clinic after a gestation; a robot's life
span follows from its fitness. Here bodies and brains are inherited, and energy may come from
chargers in the water.

The world advances in intervals, which are the generations of a run. Within one, robots swim and
touch each other (`episodes.tank`). The rules are applied at its end, in the order of the functions
here: energy and fitness, deaths, edges, matings, births. They are pure functions: colony → colony
and events (plain values for the log).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from mjx_revolve.episodes.colony_config import ColonyConfig, EnergyConfig, LifeConfig
from mjx_revolve.episodes.tank import TankTrajectory
from mjx_revolve.evolution.body_fitness import BodyFitness
from mjx_revolve.evolution.individuals import Individual
from mjx_revolve.evolution.reproduction import make_child, make_founder, make_founders
from mjx_revolve.inputs.errors import InputError, note
from mjx_revolve.water.bed import highest_bed

# At birth, robots are further apart than the sum of their radii times this. A choice.
_CLEARANCE = 1.0
# By which times that are sums of steps may fall short [s].
_ROUNDING = 1e-9
CAUSES = ("age", "energy", "lost", "failed")
"""Causes of death: age, an empty battery, the arena's end, a state that is not finite."""

Event = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Member:
    """A robot of the colony.

    Attributes:
        individual: body, brain and genes; its score is its fitness.
        slot: in the tank.
        born: end of the interval in which it was born [s].
        track: `[W, 3]` last positions of its core, newest last, without wrapping at edges [m]; the
            fitness is computed from them.
        offset: `[3]` from its position within the arena to that of the track [m].
        charge: of its battery [J].
        children: numbers of children by the other parent's number.
        busy_until: end of its gestation [s].
        quat: of the core at birth (w, x, y, z); not kept in checkpoints.
    """

    individual: Individual
    slot: int
    born: float
    track: np.ndarray = field(repr=False)
    offset: np.ndarray = field(repr=False)
    charge: float
    children: Mapping[int, int] = field(default_factory=dict)
    busy_until: float = -1.0
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @property
    def position(self) -> np.ndarray:
        """`[3]` of its core, within the arena [m]."""
        return np.asarray(self.track[-1] - self.offset)


@dataclass(frozen=True, eq=False)
class PendingBirth:
    """A child to come.

    Attributes:
        due: time of birth [s].
        parents: as they were at mating; the first gives the body.
    """

    due: float
    parents: tuple[Individual, Individual]


@dataclass(frozen=True, eq=False)
class Colony:
    """State of a colony between two intervals.

    Attributes:
        generation: number of finished intervals.
        members: the robots that are alive, by number.
        pending_births: children to come, in the order of mating.
        elites: the fittest that ever lived as long as fitness is measured, best first.
        next_number: of the next individual.
        tank: arrays of the tank; see `Tank.to_arrays`.
        seconds: time spent [s]; not reproducible.
        born: in the last interval; not saved, nor are the two below.
        died: in the last interval, in their state at its end; see `Rules.measured`.
        events: of the last interval.
    """

    generation: int = 0
    members: Mapping[int, Member] = field(default_factory=dict)
    pending_births: tuple[PendingBirth, ...] = ()
    elites: tuple[Individual, ...] = ()
    next_number: int = 0
    tank: Mapping[str, np.ndarray] = field(default_factory=dict)
    seconds: float = 0.0
    born: tuple[Individual, ...] = ()
    died: tuple[Individual, ...] = ()
    events: tuple[Event, ...] = ()

    @property
    def living(self) -> tuple[Individual, ...]:
        """Individuals that are alive."""
        return tuple(member.individual for member in self.members.values())


class Rules(NamedTuple):
    """Settings of a colony, in the steps of its world.

    Attributes:
        colony: the settings.
        fitness: genotype, brains and robots.
        look: time between rows of a trajectory [s], whole steps.
        looks: rows in an interval.
        window: positions over which fitness is measured.
        slots: the most robots that live at a time.
        current: `[3]` of the water, in which robots drift [m/s].
    """

    colony: ColonyConfig
    fitness: BodyFitness
    look: float
    looks: int
    window: int
    slots: int
    current: np.ndarray

    @property
    def interval(self) -> float:
        """Length of an interval [s]."""
        return self.looks * self.look

    @property
    def surface(self) -> float:
        """Height of the water's surface [m]."""
        return self.fitness.mixed.world.surface_height

    def time(self, colony: Colony) -> float:
        """Of a colony between two intervals [s]."""
        steps = int(colony.tank["steps"]) if colony.tank else 0
        return steps * self.fitness.mixed.world.timestep

    @property
    def birth_height(self) -> float:
        """Height at which robots are born [m]."""
        return self.surface - self.fitness.config.task.depth

    def measured(self, member: Member) -> Individual:
        """A member's individual, its score NaN until its age is the period of fitness.

        Over a shorter time, its start or a collision would have more weight.
        """
        known = len(member.track) >= self.window
        return member.individual if known else replace(member.individual, score=float("nan"))

    def aged(self, member: Member, now: float) -> Individual:
        """The same, with its age [s] and the number of its children as measures."""
        measures = {"age": now - member.born, "children": float(sum(member.children.values()))}
        return replace(self.measured(member), measures=measures)

    def inside(self, position: np.ndarray) -> np.ndarray:
        """Positions `[..., 3]` within the arena, where its edges wrap [m]."""
        if self.colony.arena.edge == "lost":
            return position
        size = self.colony.arena.size
        found = np.array(position, float)
        found[..., :2] -= size * np.round(found[..., :2] / size)
        return found


def make_rules(fitness: BodyFitness) -> Rules:
    """The rules of the colony that a fitness is configured for.

    Raises:
        InputError: robots would be born in the bed.
    """
    colony, world = fitness.config.colony, fitness.mixed.world
    assert colony is not None
    step = world.timestep
    look = max(1, round(colony.look / step)) * step
    looks = max(1, round(colony.interval / look))
    window = 1 + max(1, round(colony.life.window / look))
    slots = fitness.config.evolution.population_size
    rules = Rules(colony, fitness, look, looks, window, slots, np.array(world.current, float))
    steps, looked = f"colony.look is whole steps of {step:g} s", f"it is whole looks of {look:g} s"
    for name, wanted, found, why in (
        ("look", colony.look, look, f"it is whole steps of {step:g} s"),
        ("interval", colony.interval, rules.interval, steps),
        ("life.window", colony.life.window, (window - 1) * look, looked),
    ):
        if not math.isclose(found, wanted, rel_tol=1e-6):
            note(f"colony.{name}: {found:g} s, as {why}")
    if world.bed is not None:
        bed = highest_bed(world.bed, colony.arena.size / 2)
        if rules.birth_height <= bed:
            place = f"{fitness.config.origin('task.depth')}task.depth"
            most = f"less than {rules.surface - bed:g} m, the least depth of the bed in the arena"
            why = "as robots of a colony are born at this depth"
            raise InputError(place, f"{most}, {why}", f"{fitness.config.task.depth:g}")
    return rules


def _event(time: float, name: str, number: int, position: np.ndarray, **facts: object) -> Event:
    """An event as plain values."""
    where = [round(float(x), 3) if np.isfinite(x) else None for x in position]
    return {"time": round(float(time), 6), "event": name, "id": number, "place": where} | facts


# --- fitness and energy


def fitness_of(track: np.ndarray, look: float, settings: LifeConfig) -> float:
    """Fitness of a robot from its positions.

    5 times the speed of its net displacement and once that along its path, as Revolve's online
    evolution has it, or other weights; both horizontally and vertically.

    Args:
        track: `[W, 3]` positions at equal intervals, relative to water that moves evenly [m].
        look: the interval [s].
        settings: weights, and the speed limit above which a robot is thrown about.

    Returns:
        The fitness [-]; 0 for less than two positions, and above the limit.
    """
    if len(track) < 2:
        return 0.0
    steps = np.linalg.norm(np.diff(track, axis=0), axis=1)
    span = look * (len(track) - 1)
    path, net = float(steps.sum()) / span, float(np.linalg.norm(track[-1] - track[0])) / span
    if not np.isfinite(path) or path > settings.limit:
        return 0.0
    return settings.net * net + settings.path * path


def life_span(fitness: float, settings: LifeConfig) -> float:
    """Age at which a robot of some fitness dies [s]."""
    share = min(fitness, settings.full_fitness) / settings.full_fitness
    return max(settings.childhood, settings.max_age * share)


def share_power(distance: np.ndarray, settings: EnergyConfig) -> np.ndarray:
    """Power that chargers give to robots.

    Args:
        distance: `[chargers, robots]` between them [m].
        settings: of the chargers.

    Returns:
        `[robots]` power [W].
    """
    wanted = settings.most * np.minimum(1, (settings.reach / np.maximum(distance, 1e-9)) ** 2)
    total = wanted.sum(1, keepdims=True)
    given = wanted * np.minimum(1, settings.power / np.maximum(total, 1e-12))
    return np.minimum(given.sum(0), settings.most)


def age_members(colony: Colony, trajectory: TankTrajectory, rules: Rules) -> Colony:
    """Members an interval later: their tracks, batteries and fitness.

    A battery loses the work of the motors and the idle power, and gains the chargers' power. The
    current does not count as way: fitness is of the track relative to it.
    """
    energy, members = rules.colony.energy, {}
    given = _charged(colony, trajectory, rules)
    for (number, member), joules in zip(colony.members.items(), given, strict=True):
        k = member.slot
        # The trajectory is within the arena; the track continues beyond its edges.
        fresh = trajectory.position[:, :, k].astype(float) + member.offset
        track = np.concatenate([member.track, fresh])[-rules.window :]
        drift = rules.look * np.arange(len(track))[:, None] * rules.current
        score = fitness_of(track - drift, rules.look, rules.colony.life)
        charge = member.charge
        if energy is not None:
            used = float(trajectory.energy[:, k].sum()) + energy.idle * rules.interval
            charge = min(charge - used + float(joules), energy.capacity)
        individual = replace(member.individual, score=score)
        members[number] = replace(member, individual=individual, track=track, charge=charge)
    return replace(colony, members=members)


def _charged(colony: Colony, trajectory: TankTrajectory, rules: Rules) -> np.ndarray:
    """`[N]` what members get of chargers in an interval [J]."""
    energy, members = rules.colony.energy, colony.members.values()
    if energy is None or not energy.chargers or not members:
        return np.zeros(len(members))
    chargers = np.array(energy.chargers)[None, :, None]
    positions = _positions(members, trajectory)
    distance = np.linalg.norm(positions[:, None] - chargers, axis=-1)
    rows = np.nan_to_num(distance, nan=1e9)
    return np.asarray(rules.look * np.sum([share_power(row, energy) for row in rows], 0))


def _positions(members: Iterable[Member], trajectory: TankTrajectory) -> np.ndarray:
    """`[T, N, 3]` positions of members in the tank, where they touch and are sensed [m].

    Until the end of the interval they may be beyond the arena's edge.
    """
    slots = [member.slot for member in members]
    return trajectory.position[:, :, slots].transpose(0, 2, 1).astype(float)


# --- deaths and edges


def remove_dead(
    colony: Colony, trajectory: TankTrajectory, rules: Rules
) -> tuple[Colony, list[Event]]:
    """The colony without the members that have died, which are then in `died`."""
    now, alive, died, events = float(trajectory.time[-1]), {}, [], []
    for number, member in colony.members.items():
        individual = rules.aged(member, now)
        age = individual.measures["age"]
        cause = _cause_of_death(member, age, trajectory, rules)
        if cause is None:
            alive[number] = member
            continue
        score = float("nan") if cause == "failed" else individual.score
        died.append(replace(individual, score=score))
        events.append(
            _event(
                now, "death", number, member.position,
                cause=cause, age=age, score=None if np.isnan(score) else score,
            )
        )  # fmt: skip
    return replace(colony, members=alive, died=tuple(died)), events


def _cause_of_death(
    member: Member, age: float, trajectory: TankTrajectory, rules: Rules
) -> str | None:
    arena, core = rules.colony.arena, member.track[-1]
    qpos = trajectory.qpos[:, : 7 + member.individual.body.num_hinges, member.slot]
    outside = arena.edge == "lost" and np.abs(core[:2]).max() > arena.size / 2
    if not np.isfinite(qpos).all():
        return "failed"
    if core[2] < rules.surface - arena.depth or outside:
        return "lost"
    if member.charge <= 0:
        return "energy"
    span = life_span(member.individual.score, rules.colony.life)
    return "age" if age >= span - _ROUNDING else None


def wrap_edges(colony: Colony, rules: Rules) -> tuple[Colony, np.ndarray]:
    """Brings members that have left the arena back in on the other side.

    Returns:
        The colony, and `[3, slots]` displacements of the tank's robots [m].
    """
    shift, members = np.zeros((3, rules.slots)), dict(colony.members)
    for number, member in colony.members.items():
        back = rules.inside(member.position) - member.position
        if np.any(back):
            shift[:, member.slot] = back
            members[number] = replace(member, offset=member.offset - back)
    return replace(colony, members=members), shift


# --- matings and births


def mate(colony: Colony, trajectory: TankTrajectory, rules: Rules) -> tuple[Colony, list[Event]]:
    """Pairs of members that have met, the nearest first, as long as there is room for a child."""
    mating, now = rules.colony.mating, float(trajectory.time[-1])
    members, pending, events = dict(colony.members), list(colony.pending_births), []
    ready = [
        number
        for number, member in members.items()
        if now - member.born >= mating.adult - _ROUNDING
        and member.busy_until <= now + _ROUNDING
        and member.individual.score > 0
    ]
    if len(ready) < 2:
        return colony, []
    position = _positions([members[n] for n in ready], trajectory)
    distance = np.linalg.norm(position[:, :, None] - position[:, None], axis=-1)
    nearest = distance.min(0)
    first, second = np.nonzero(np.triu(nearest <= mating.distance, 1))
    taken: set[int] = set()
    room = rules.slots - len(members)
    for k in np.lexsort((second, first, nearest[first, second])):
        i, j = first[k], second[k]
        pair = ready[i], ready[j]
        one, other = (members[number] for number in pair)
        scores = one.individual.score, other.individual.score
        have = one.children.get(pair[1], 0)
        if len(pending) >= room:
            break
        if taken & set(pair) or have >= mating.children:
            continue
        if min(scores) < mating.likeness * max(scores):
            continue
        taken |= set(pair)
        due = now + rules.colony.birth.gestation
        fitter, less = (one, other) if scores[0] >= scores[1] else (other, one)
        pending.append(PendingBirth(due, (fitter.individual, less.individual)))
        for mine, theirs in (pair, pair[::-1]):
            children = {**members[mine].children, theirs: have + 1}
            members[mine] = replace(members[mine], busy_until=due, children=children)
        when = int(np.argmin(distance[:, i, j]))
        middle = rules.inside((position[when, i] + position[when, j]) / 2)
        events.append(_event(now, "mating", pair[0], middle, other=pair[1]))
    return replace(colony, members=members, pending_births=tuple(pending)), events


def found_colony(
    colony: Colony, time: float, rules: Rules, rng: np.random.Generator
) -> tuple[Colony, list[Event]]:
    """The first robots, all over the arena: seeds and their mutants, then random ones.

    A robot for which no free position is found is left out; the next one has its number.
    """
    events: list[Event] = []
    count = rules.colony.birth.initial
    for founder in make_founders(
        rules.fitness, [rng] * count, colony.next_number, colony.generation, sow=True
    ):
        founder = replace(founder, number=colony.next_number)
        placed = _place(colony, founder, time, rules, rng, everywhere=True)
        if placed is not None:
            colony, event = placed
            events.append(event)
    return colony, events


def give_birth(
    colony: Colony, time: float, rules: Rules, rng: np.random.Generator
) -> tuple[Colony, list[Event]]:
    """Births that are due, as far as there is room; then founders, where too few are alive.

    A child for which no free position is found waits for the next interval.
    """
    waiting: list[PendingBirth] = []
    events: list[Event] = []
    for pending in colony.pending_births:
        placed = None
        if pending.due <= time + _ROUNDING and len(colony.members) < rules.slots:
            child = make_child(
                rules.fitness, rng, colony.next_number, colony.generation, *pending.parents,
                both_brains=True,
            )  # fmt: skip
            placed = _place(colony, child, time, rules, rng)
        if placed is None:
            waiting.append(pending)
        else:
            colony, event = placed
            events.append(event)
    for _ in range(max(0, min(rules.colony.birth.least, rules.slots) - len(colony.members))):
        founder = make_founder(rules.fitness, rng, colony.next_number, colony.generation)
        placed = _place(colony, founder, time, rules, rng)
        if placed is None:
            break
        colony, event = placed
        events.append(event)
    return replace(colony, pending_births=tuple(waiting)), events


def _place(
    colony: Colony,
    individual: Individual,
    time: float,
    rules: Rules,
    rng: np.random.Generator,
    everywhere: bool = False,
) -> tuple[Colony, Event] | None:
    """The colony with a new robot in the clinic, or anywhere; None: no free position was found."""
    birth, energy = rules.colony.birth, rules.colony.energy
    radius = _radius(individual, rules)
    others = [(m.position, _radius(m.individual, rules)) for m in colony.members.values()]
    for _ in range(birth.attempts):
        x, y = rng.uniform(-1, 1, 2) * rules.colony.arena.size / 2
        if not everywhere:
            angle, away = rng.uniform(0, 2 * np.pi), birth.radius * np.sqrt(rng.uniform())
            x, y = away * np.cos(angle), away * np.sin(angle)
        position = np.array([x, y, rules.birth_height])
        yaw = rng.uniform(0, 2 * np.pi)
        if all(
            np.linalg.norm(position - other) > _CLEARANCE * (radius + own) for other, own in others
        ):
            break
    else:
        return None
    slots = {member.slot for member in colony.members.values()}
    member = Member(
        individual=_express(individual, rules.fitness),
        slot=next(slot for slot in range(rules.slots) if slot not in slots),
        born=time,
        track=position[None],
        offset=np.zeros(3),
        charge=energy.start if energy else float("inf"),
        quat=(np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)),
    )
    event = _event(
        time, "birth", individual.number, position,
        parents=list(individual.parents), origin=individual.origin,
    )  # fmt: skip
    colony = replace(
        colony,
        members={**colony.members, individual.number: member},
        born=(*colony.born, member.individual),
        next_number=individual.number + 1,
    )
    return colony, event


def _express(individual: Individual, fitness: BodyFitness) -> Individual:
    """A new individual with the genes of its brain; a colony has no learning."""
    layout, brains = fitness.layout(individual.body), fitness.brains
    genes = brains.express(brains.to_vector(individual.brain, layout), layout)[layout.columns]
    return replace(
        individual,
        learnt=individual.brain,
        genes=tuple(map(float, genes)),
        measures={"age": 0.0, "children": 0.0},
    )


def _radius(individual: Individual, rules: Rules) -> float:
    """The largest distance of a robot's corners from its core at rest [m]."""
    corners = rules.fitness.build(individual.body).assembly.layout.core_corners()
    return float(np.linalg.norm(corners, axis=-1).max())
