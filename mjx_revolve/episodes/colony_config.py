"""Settings of a colony, robots that evolve in one world: `colony` in a configuration.

After Revolve's online evolution (the "triangle of life": Eiben et al. 2013, ECAL), with defaults of
the same order of magnitude: 10 to 75 robots, mating within 1 m, 2 to 6 children for each pair,
birth clinics 2 to 4 m across.
"""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Le, Unit
from pydantic import model_validator

from mjx_revolve.episodes.settings import Settings
from mjx_revolve.inputs.errors import note
from mjx_revolve.inputs.schema import (
    ConstraintError,
    Integer,
    NonNegative,
    Positive,
    Share,
    TupleOf,
    Vector,
)


class ArenaConfig(Settings):
    """The arena: a square of water around the world's origin."""

    size: Annotated[Positive, Unit("m")] = 16.0
    """Edge of the square [m]."""
    depth: Annotated[Positive, Unit("m")] = 6.0
    """A robot with its core below this depth is lost [m]."""
    edge: Literal["wrap", "lost"] = "wrap"
    """A robot that leaves the square comes back in on the other side (`wrap`), or is lost."""


class BirthConfig(Settings):
    """Where and when robots are born."""

    radius: Annotated[NonNegative, Unit("m")] = 2.0
    """Of the clinic, a disc around the world's origin, at the task's depth [m]."""
    attempts: Annotated[Integer, Ge(1)] = 5
    """Places that are tried for a new robot; where all are taken it waits for the next interval."""
    gestation: Annotated[NonNegative, Unit("s")] = 60.0
    """From mating to birth, while neither parent mates again [s]."""
    initial: Annotated[Integer, Ge(1)] = 16
    """Robots at the beginning, all over the arena."""
    least: Annotated[Integer, Ge(0)] = 8
    """If fewer robots are alive, random ones without parents are born."""


class MatingConfig(Settings):
    """Conditions for mating."""

    distance: Annotated[Positive, Unit("m")] = 1.0
    """Between cores, at which two robots meet [m]."""
    likeness: Share = 0.5
    """Least fitness of the less fit robot, as a share of the other's [-]."""
    adult: Annotated[NonNegative, Unit("s")] = 60.0
    """Age from which robots mate [s]."""
    children: Annotated[Integer, Ge(1)] = 4
    """Most children of one pair."""


class LifeConfig(Settings):
    """Fitness, and how long robots live."""

    window: Annotated[Positive, Unit("s")] = 60.0
    """Fitness is measured over the last so many seconds, or since birth [s]."""
    net: NonNegative = 5.0
    """Weight of the net displacement's speed [s/m]."""
    path: NonNegative = 1.0
    """Weight of the path's speed [s/m]."""
    limit: Annotated[Positive, Unit("m/s")] = 1.0
    """A robot that is faster along its path is thrown by contacts, not swimming: fitness 0
    [m/s]."""
    max_age: Annotated[Positive, Unit("s")] = 1800.0
    """Age at which a robot of full fitness dies [s]."""
    full_fitness: Annotated[Positive, Unit("-")] = 0.1
    """Fitness c from which robots reach that age; with a fitness f below it, f/c of it [-]."""
    childhood: Annotated[NonNegative, Unit("s")] = 120.0
    """Age before which no robot dies of age [s]."""


class EnergyConfig(Settings):
    """Batteries of the robots, and chargers in the water."""

    start: Annotated[Positive, Unit("J")] = 20.0
    """Charge at birth [J]."""
    capacity: Annotated[Positive, Unit("J")] = 40.0
    """Of a battery [J]."""
    idle: Annotated[NonNegative, Unit("W")] = 0.01
    """Power of a robot beside the work of its motors [W]."""
    chargers: TupleOf[Vector] = ()
    """Their positions, world frame [m]; the nearest is the target of the robot's sensors."""
    power: Annotated[NonNegative, Unit("W")] = 2.0
    """Of a charger, shared by all robots near it [W]."""
    most: Annotated[NonNegative, Unit("W")] = 0.2
    """Most power that a robot gets [W]."""
    reach: Annotated[Positive, Unit("m")] = 1.0
    """Distance r beyond which the power falls as (r/d)² [m]."""


class ColonyConfig(Settings):
    """Settings of a colony.

    `evolution.population_size` is the most robots at a time, and `evolution.generations` the number
    of intervals.
    """

    interval: Annotated[Positive, Le(600), Unit("s")] = 10.0
    """Time between the moments at which births, deaths and matings take effect [s]."""
    look: Annotated[Positive, Unit("s")] = 0.5
    """Time between samples of the robots' positions, by which they meet [s]."""
    touch: bool = True
    """Whether robots are in contact with each other, or pass through."""
    arena: ArenaConfig = ArenaConfig()
    birth: BirthConfig = BirthConfig()
    mating: MatingConfig = MatingConfig()
    life: LifeConfig = LifeConfig()
    energy: EnergyConfig | None = None
    """Batteries and chargers; without it robots need no energy."""

    @model_validator(mode="after")
    def _check(self) -> ColonyConfig:
        if self.look > self.interval:
            most = f"at most the interval ({self.interval:g} s)"
            raise ConstraintError("look", most, f"{self.look:g}")
        looks = self.interval / self.look
        if abs(looks - round(looks)) > 1e-6 * looks:
            whole = f"a whole part of the interval ({self.interval:g} s)"
            raise ConstraintError("look", whole, f"{self.look:g}")
        if 2 * self.birth.radius > self.arena.size:
            wide = f"at most half of the arena's size ({self.arena.size / 2:g} m)"
            raise ConstraintError("birth.radius", wide, f"{self.birth.radius:g}")
        if self.life.window > self.life.max_age:
            most = f"at most life.max_age ({self.life.max_age:g} s), or fitness is never measured"
            raise ConstraintError("life.window", most, f"{self.life.window:g}")
        if self.life.childhood >= self.life.max_age:
            note(
                f"colony.life: all robots live for childhood ({self.life.childhood:g} s), however "
                f"fit they are, as max_age ({self.life.max_age:g} s) is no longer"
            )
        if self.energy is not None:
            self._check_energy(self.energy)
        return self

    def _check_energy(self, energy: EnergyConfig) -> None:
        if energy.start > energy.capacity:
            most = f"at most the capacity ({energy.capacity:g} J)"
            raise ConstraintError("energy.start", most, f"{energy.start:g}")
        usual = type(energy).model_fields
        own = [x for x in ("power", "most", "reach") if getattr(energy, x) != usual[x].default]
        if own and not energy.chargers:
            note(f"colony.energy: {', '.join(own)} without effect, as there are no chargers")
        for k, (x, y, _) in enumerate(energy.chargers):
            if max(abs(x), abs(y)) > self.arena.size / 2:
                inside = f"a place in the arena (x and y within {self.arena.size / 2:g} m)"
                raise ConstraintError(f"energy.chargers[{k}]", inside, f"{x:g}, {y:g}")
