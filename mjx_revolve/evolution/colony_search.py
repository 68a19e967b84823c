"""A colony as a search: its tank, the loop over its intervals, and its checkpoints."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mjx_revolve.engine.interaction import ContactParameters
from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.individual_log import EVENTS, GENERATIONS, INDIVIDUALS
from mjx_revolve.episodes.run_reader import arrays_of
from mjx_revolve.episodes.tank import TankTrajectory, make_tank
from mjx_revolve.evolution.colony import (
    CAUSES,
    Colony,
    Member,
    PendingBirth,
    age_members,
    found_colony,
    give_birth,
    make_rules,
    mate,
    remove_dead,
    wrap_edges,
)
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.generations import Evolution, Generation
from mjx_revolve.evolution.individual_search import (
    IndividualEvolution,
    finite_mean,
    living_line,
    mean_descriptors,
)
from mjx_revolve.evolution.individuals import (
    best_individuals,
    from_records,
    pack_json,
    reading_state,
    state_to_arrays,
    to_records,
    to_text,
    unpack_json,
)

_COUNTERS = ("generation", "next_number", "seconds")


class ColonyInterval(NamedTuple):
    """An interval that is about to begin.

    Attributes:
        colony: with its members in the tank; the founders are among them.
        rng: of the interval.
    """

    colony: Colony
    rng: np.random.Generator


class ColonyEvolution(IndividualEvolution, Evolution[Colony, ColonyInterval, TankTrajectory]):
    """A colony as a search; see `generations.Evolution`.

    All randomness follows from the seed and the interval's number.
    """

    def __init__(self, config: Config, executor: Executor) -> None:
        """Prepares a colony with an empty tank.

        Args:
            config: the configuration.
            executor: an executor over a `BodyFitness`.

        Raises:
            InputError: the world is gusty, or robots would be born in its bed.
        """
        super().__init__(config, executor)
        self.rules = make_rules(self.fitness)
        self._empty_tank()

    def _empty_tank(self) -> None:
        contact = ContactParameters() if self.rules.colony.touch else None
        self.tank = make_tank(self.fitness.mixed, self.rules.slots, touch=contact)
        # The `tank` of the colony that is loaded into the tank; None: another state.
        self._held: Mapping[str, np.ndarray] | None = {}

    def start(self) -> Colony:
        """The colony before its first interval: nothing lives yet."""
        return Colony()

    # --- ask, evaluate, tell

    def ask(self, search: Colony) -> ColonyInterval:
        """The next interval: the tank as it was, founders in the first one, and signals."""
        if search.tank is not self._held:
            self._load(search)
        generation = search.generation + 1
        rng = np.random.default_rng([self.config.evolution.seed, generation])
        colony = replace(search, generation=generation, born=(), died=(), events=())
        if generation == 1:
            colony, births = found_colony(colony, self.tank.time, self.rules, rng)
            colony = replace(colony, events=tuple(births))
            self._synchronize(search, colony)
        self._set_signals(colony)
        return ColonyInterval(colony, rng)

    def evaluate(self, proposal: ColonyInterval, rows: int = 1) -> TankTrajectory:
        """The robots' motion in the interval; `rows`: rows of it for each of `Rules.looks`."""
        self._held = None
        return self.tank.advance(self.rules.interval, self.rules.look / rows)

    def tell(self, proposal: ColonyInterval, results: TankTrajectory) -> Generation[Colony]:
        """The colony with the rules applied.

        Columns: failed, living, living_mean, time [s], births, matings, deaths by cause, expected
        (children to come), mean_age [s], mean_charge [J] where there is energy, the living's mean
        of `MEAN_DESCRIPTORS`. Scores are the fitness of the living, see `Rules.measured`.
        """
        rules, rng = self.rules, proposal.rng
        trajectory = _thin(results, len(results.time) // rules.looks)
        now = float(trajectory.time[-1])
        colony = age_members(proposal.colony, trajectory, rules)
        colony, deaths = remove_dead(colony, trajectory, rules)
        colony, shift = wrap_edges(colony, rules)
        colony, matings = mate(colony, trajectory, rules)
        colony, births = give_birth(colony, now, rules, rng)
        self._synchronize(proposal.colony, colony, shift)
        self._held = self.tank.to_arrays()
        living = [rules.measured(member) for member in colony.members.values()]
        elites = best_individuals([*colony.elites, *colony.died, *living])
        events = (*colony.events, *deaths, *matings, *births)
        colony = replace(colony, elites=elites, tank=self._held, events=events)
        scores = np.array([individual.score for individual in living])
        champion = colony.elites[0].score if colony.elites else float("nan")
        return Generation(
            colony, scores, champion, self._columns(colony, scores, now), len(colony.born),
            colony.next_number, rules.interval,
        )  # fmt: skip

    def _load(self, search: Colony) -> None:
        """Restores the tank of a colony."""
        if self._held != {}:
            self._empty_tank()
        if search.tank:
            members = search.members.values()
            robots = {m.slot: self.fitness.build(m.individual.body) for m in members}
            self.tank.from_arrays(search.tank, robots)

    def _synchronize(self, before: Colony, after: Colony, shift: np.ndarray | None = None) -> None:
        """Brings the tank's robots from one state of the colony to the next."""
        for number, member in before.members.items():
            if number not in after.members:
                self.tank.remove(member.slot)
        if shift is not None and np.any(shift):
            self.tank.move(shift)
        for number, member in after.members.items():
            if number not in before.members:
                slot = self.tank.add(
                    self.fitness.build(member.individual.body), member.individual.genes,
                    member.position.tolist(), member.quat, noise=self._noise(number),
                )  # fmt: skip
                assert slot == member.slot

    def _noise(self, number: int) -> int:
        """Seed of the noise of an individual's sensors: another one in each run."""
        both = np.random.SeedSequence([self.config.evolution.seed, number])
        return int(both.generate_state(1)[0])

    def _set_signals(self, colony: Colony) -> None:
        """Each robot's tag is its share of full fitness, its target the nearest charger."""
        full, energy = self.rules.colony.life.full_fitness, self.rules.colony.energy
        for member in colony.members.values():
            score = member.individual.score
            self.tank.tag[member.slot] = 0.0 if np.isnan(score) else min(score / full, 1.0)
        if energy is None or not energy.chargers:
            return
        chargers = np.array(energy.chargers)
        target = np.zeros((3, self.rules.slots))
        for member in colony.members.values():
            distance = np.linalg.norm(chargers - member.position, axis=1)
            target[:, member.slot] = chargers[int(np.argmin(distance))]
        self.tank.set_targets(target)

    def _columns(self, colony: Colony, scores: np.ndarray, now: float) -> dict[str, float]:
        count = Counter(event["event"] for event in colony.events)
        causes = Counter(event.get("cause") for event in colony.events)
        members = colony.members.values()
        columns: dict[str, float] = {
            "failed": causes["failed"],
            "living": len(members),
            "living_mean": finite_mean(scores),
            "time": now,
            "births": count["birth"],
            "matings": count["mating"],
            **{f"died_of_{name}": causes[name] for name in CAUSES},
            "expected": len(colony.pending_births),
            "mean_age": finite_mean([now - member.born for member in members]),
        }
        if self.rules.colony.energy is not None:
            columns["mean_charge"] = finite_mean([member.charge for member in members])
        return columns | mean_descriptors(colony.living)

    # --- files of the run folder

    def logs(self, search: Colony) -> Mapping[str, Sequence[str]]:
        """Individuals at birth, and at death or the end (the later counts); living; events."""
        logged = [*search.born, *search.died]
        if search.generation == self.config.evolution.generations:
            now = self.rules.time(search)
            logged += [self.rules.aged(member, now) for member in search.members.values()]
        return {
            INDIVIDUALS: [to_text(individual, self.fitness.genotype) for individual in logged],
            GENERATIONS: [living_line(search)],
            EVENTS: [json.dumps(event, separators=(",", ":")) for event in search.events],
        }

    # --- to and from a checkpoint

    def to_arrays(self, search: Colony) -> dict[str, np.ndarray]:
        """A colony as named arrays."""
        # Parents as they were when they mated; of several matings, their bodies and brains are one.
        parents = [parent for pending in search.pending_births for parent in pending.parents]
        members = search.members.items()
        plain = {
            "citizens": [
                {
                    "id": number,
                    "place": member.slot,
                    "born": member.born,
                    "charge": None if member.charge == float("inf") else member.charge,
                    "children": [[other, count] for other, count in member.children.items()],
                    "busy": member.busy_until,
                    "offset": member.offset.tolist(),
                    "length": len(member.track),
                }
                for number, member in members
            ],
            "expected": [(p.due, *(i.number for i in p.parents)) for p in search.pending_births],
            "elites": [[i.number, i.score] for i in search.elites],
            "individuals": to_records(
                (*parents, *search.elites, *search.living), self.fitness.genotype
            ),
        }
        found = state_to_arrays(search, _COUNTERS, self.config.evolution.seed)
        found["plain"] = pack_json(plain)
        found["tracks"] = np.concatenate([*(m.track for _, m in members), np.zeros((0, 3))])
        return found | {f"tank.{name}": value for name, value in search.tank.items()}

    def from_arrays(self, arrays: Mapping[str, np.ndarray]) -> Colony:
        """The inverse of `to_arrays`.

        Raises:
            InputError: the arrays are damaged, or those of another run.
        """
        with reading_state("a colony", _COUNTERS, self.config.evolution.seed, arrays) as counters:
            plain = unpack_json(arrays["plain"])
            known = from_records(plain["individuals"], self.fitness)
            rows = plain["citizens"]
            ends = np.cumsum([0, *(int(row["length"]) for row in rows)])
            members = {
                int(row["id"]): Member(
                    individual=known[int(row["id"])],
                    slot=int(row["place"]),
                    born=float(row["born"]),
                    track=arrays["tracks"][start:end],
                    offset=np.array(row["offset"], float),
                    charge=float("inf") if row["charge"] is None else float(row["charge"]),
                    children={int(other): int(count) for other, count in row["children"]},
                    busy_until=float(row["busy"]),
                )
                for row, start, end in zip(rows, ends, ends[1:], strict=False)
            }
            pending = tuple(
                PendingBirth(float(due), (known[int(a)], known[int(b)]))
                for due, a, b in plain["expected"]
            )
            return Colony(
                members=members,
                pending_births=pending,
                elites=tuple(
                    replace(known[int(number)], score=float(score))
                    for number, score in plain["elites"]
                ),
                tank=arrays_of("tank.", arrays),
                **counters,
            )


def _thin(trajectory: TankTrajectory, stride: int) -> TankTrajectory:
    """Every so many rows of a trajectory, with all of its energy."""
    if stride == 1:
        return trajectory
    energy = trajectory.energy.reshape(-1, stride, trajectory.energy.shape[1]).sum(1)
    k = slice(stride - 1, None, stride)
    return trajectory._replace(time=trajectory.time[k], qpos=trajectory.qpos[k], energy=energy)
