"""The configuration of a run: a small YAML file, checked before anything expensive starts.

A file names robot, world, controller, task and settings of evolution. `load_config` reads it,
applies overrides, checks every value and resolves the paths; `dump_config` writes the resolved
values, so that a run folder documents itself.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le, Lt, MinLen, Unit
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PrivateAttr,
    ValidationError,
    model_validator,
)

from mjx_revolve.body.sensors import SensorRow
from mjx_revolve.control.table import CONTROLLERS
from mjx_revolve.episodes.bodies_config import BodiesConfig, LearningConfig, SelectionConfig
from mjx_revolve.episodes.colony_config import ColonyConfig
from mjx_revolve.episodes.measure_table import MEASURES
from mjx_revolve.episodes.settings import (
    File,
    NamedFile,
    Section,
    Settings,
    find_copies,
    locate_files,
    map_files,
    one_of,
)
from mjx_revolve.inputs.errors import InputError, note, reading
from mjx_revolve.inputs.files import check_path, short_path
from mjx_revolve.inputs.overrides import copy_plain, merge_override, read_overrides, sets
from mjx_revolve.inputs.schema import (
    OFF,
    ConstraintError,
    Integer,
    NonNegative,
    Number,
    Positive,
    TupleOf,
    Vector,
    also,
    is_off,
    show,
    words,
)
from mjx_revolve.inputs.shipped import find_shipped
from mjx_revolve.inputs.trust import is_run_config
from mjx_revolve.inputs.validation_messages import describe, find_problems, refuse
from mjx_revolve.inputs.yaml_reader import dump_yaml, load_yaml
from mjx_revolve.water.world import World, is_left_out

# Required settings of each task; `tasks.TASKS` has the tasks themselves.
TASKS: dict[str, tuple[str, ...]] = {
    "directed_swim": (),
    "speed": (),
    "reach_target": (),
    "hold_depth": (),
    "hold_heading": (),
    "follow_course": ("course_spread",),
    "search": ("sight",),
    "escape": ("target_turn",),
    "follow_bed": ("height",),
    "crawl": (),
}
# Values in effect in runs of versions without these settings: a command at every step, positions of
# robots at their cores, and lengths at rest.
OLDER_TASK = {"point": "core", "length": "rest"}
OLDER: dict[str, dict[str, Any]] = {
    "task": OLDER_TASK,
    "controller": {"rate": None, "between": "hold"},
}
OLDER_WORLD = {"drag": "faces", "self_contact": False}
"""Values of worlds in run folders that do not state them; newer folders do (`state_world`)."""
# Tasks with a target.
TO_TARGETS = ("reach_target", "search", "escape")
# Tasks that count less away from a depth, and those that look along `direction`.
_AT_DEPTH = ("directed_swim", "speed", "follow_course", "escape", "follow_bed", "crawl")
_DIRECTED = ("directed_swim", "hold_heading", "follow_bed", "crawl")
# Of episodes, which a colony does not have while its robots live.
_OF_EPISODES = (
    "robust",
    "current_std",
    "energy_weight",
    "start_attitude",
    "start_tilt",
    "target",
    "target_distance",
    "course_spread",
)


def _check_measure(name: str) -> str:
    if name not in MEASURES:
        near = difflib.get_close_matches(name, MEASURES, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ConstraintError("", f"one of {', '.join(MEASURES)}", show(name) + hint)
    return name


def _check_world(value: str | dict[str, Any]) -> str | dict[str, Any]:
    if value == "":
        raise ConstraintError("", "a name or a path", "an empty text")
    for key in value if isinstance(value, dict) else ():
        if not isinstance(key, str):
            raise ConstraintError(show(key), "the name of a setting", "a key that is no text")
    if isinstance(value, dict) and (not isinstance(value.get("name"), str) or not value["name"]):
        named = "a `name` (a world's name or path) beside the overrides"
        raise ConstraintError("", named, "none")
    return value


_World = Annotated[
    str | dict[str, Any],
    AfterValidator(_check_world),
    words("a world's name or path, or a mapping of name and overrides"),
]
_Morphology = Annotated[str, MinLen(1), words("the path of a morphology YAML")]
_Modules = Annotated[str, MinLen(1), words("the path of a YAML, or nothing")]


class ControllerConfig(Section):
    """Settings of the controller, which maps genes to joint targets."""

    type: Annotated[str, one_of(CONTROLLERS), File("code")] = "cpg"
    """`cpg`, `sine`, `feedback`, `mlp`, `rnn`, `sensory_cpg`, `splines`, `brain` (what the
    robot's YAML has under `brain`), or FILE.py:FUNCTION, a function of a plant and this section."""
    rate: Annotated[Positive, Le(1000), Unit("Hz")] | None = 20.0
    """Commands in a second, as with real servos and in Revolve; null: a new one at each of the
    world's steps, as in runs of older versions [Hz]."""
    between: Literal["hold", "ramp"] = "ramp"
    """Targets between commands: `ramp`: they go linearly from the command before to the last one, a
    period late and without jerks, as from boards that interpolate; `hold`: they are held. Held
    targets jerk the servos, and steps of 5 ms are too long to resolve the jerks."""
    max_frequency: Annotated[Positive, Le(20), Unit("Hz")] = 2.0
    """Upper end of the gene for frequency, half of `rate` at most: of `sine` and `splines` the
    common frequency, of `cpg` that of an uncoupled oscillator (coupled ones may be faster), of
    `sensory_cpg` that before feedback adds to it, of `mlp` and `rnn` that of the clock among their
    inputs [Hz]."""
    amplitude: Annotated[Positive, Le(1), Unit("-")] = 1.0
    """Largest amplitude of each sine, as a share of half the hinge's range: 1 swings from end to
    end; the range clips their sum [-]."""
    harmonics: Annotated[Integer, Ge(1), Le(8)] = 1
    """Number of sines that are added at each hinge; `type: sine` only [-]."""
    gain: Annotated[Positive, Unit("-")] = 2.0
    """Largest response to an error of normal size, or to a sensor at the end of its range, as a
    share of half the hinge's range; `type: feedback` and `sensory_cpg` [-]."""
    depth: Annotated[NonNegative, Unit("m")] | None = None
    """Depth that `type: feedback` holds; by default that of the task's start [m]."""
    hidden: Annotated[Integer, Ge(1), Le(64)] = 8
    """Units of the network that all joints share; `type: mlp` and `rnn` [-]."""
    messages: Annotated[Integer, Ge(0), Le(8)] = 2
    """Number of values that a joint sends to its neighbours; `type: mlp` and `rnn` [-]."""
    points: Annotated[Integer, Ge(3), Le(100)] = 8
    """Points of each joint's curve; `type: splines`, and `brain` if it has such curves [-]."""
    sensors: SensorRow | None = None
    """The sensors of controllers, kinds' names or mappings with fields of `Sensor`; by default the
    robot's own `sensors`, or else `sensors.DEFAULT_SENSORS`."""
    params: Annotated[dict[str, Any], File("data")] = Field({})
    """Settings of a function of the user's own, which reads them as `settings.params`."""

    @property
    def fastest(self) -> float:
        """The highest frequency of waves that are to be sampled, 0 where there are none [Hz]."""
        if self.type in ("feedback", "brain") or self.is_user_code:
            return 0.0
        return self.max_frequency * (self.harmonics if self.type == "sine" else 1)

    @model_validator(mode="after")
    def _check(self) -> ControllerConfig:
        self.refuse_params(self.params)
        if self.rate is not None and self.fastest > self.rate / 2:
            most = f"at most half of controller.rate ({self.rate:g} Hz), to be sampled by it"
            times = round(self.fastest / self.max_frequency)
            most += f", of the last of {times} harmonics" if times > 1 else ""
            raise ConstraintError("max_frequency", most, f"{self.max_frequency:g}")
        for name in dict.fromkeys(x for kind in CONTROLLERS.values() for x in kind.settings):
            kinds = [key for key, kind in CONTROLLERS.items() if name in kind.settings]
            usual, found = type(self).model_fields[name].default, getattr(self, name)
            if found == usual or self.type in kinds or self.is_user_code:
                continue
            usual = "null" if usual is None else f"{usual:g}"
            have = f"type {kinds[0]} has" if len(kinds) == 1 else f"types {', '.join(kinds)} have"
            only = f"as only {have} it (--set controller.{name}={usual})"
            shown = f"{len(found)} of them" if isinstance(found, tuple) else f"{found:g}"
            raise ConstraintError(name, f"{usual}, {only}", shown)
        return self


class RobustConfig(Settings):
    """Largest factors by which coefficients are multiplied or divided, drawn anew for each trial.

    Uniform in the factor's logarithm, one trial in each part of its range, the same for all
    individuals.
    """

    drag: Annotated[Number, Ge(1), Le(10), Unit("-")] = 1.5
    """On drag, and on drag and lift of fins. Hoerner (1965, Fluid-Dynamic Drag) has .80 for a cube
    edge on, 1.17 for a plate, 2.05 for a long square rod; ours are 1.05, 1.17 and 1.75 [-]."""
    added_mass: Annotated[Number, Ge(1), Le(10), Unit("-")] = 1.35
    """On the water that is carried along. Of a cube .64 to .68 of its volume are measured, where
    Lamb's ellipsoid has .50 [-]."""
    density: Annotated[Number, Ge(1), Le(2), Unit("-")] = 1.003
    """Of the water: fresh water differs by so much between 0 and 30 °C. Robots keep the trim that
    they have [-]."""
    motor: Annotated[Number, Ge(1), Le(10), Unit("-")] = 1.1
    """On the servos' top speed, which differs by about so much between 4.8 and 6 V, and on the
    thrusters' thrust [-]."""


@also(OFF, {"const": True})
def _read_robust(value: object) -> object:
    """`true` as the default range of each coefficient."""
    if isinstance(value, str | int | float) and value is not True and not is_off(value):
        raise ConstraintError("", "true, false or a mapping, such as {drag: 1.3}", show(value))
    return {} if value is True else None if is_off(value) else value


class TaskConfig(Section):
    """Settings of the task: its score and how its episodes start."""

    type: Annotated[str, one_of(TASKS), File("code")]
    """A task of the table above, or FILE.py:FUNCTION, a function like those."""
    unit: Literal["body_lengths", "m"] = "body_lengths"
    """Unit of lengths in scores that are in body lengths. If bodies evolve, so does their length:
    `m` compares them by the distance in metres."""
    point: Literal["center_of_mass", "core"] = "center_of_mass"
    """The point of scores and measures: the robot's centre of mass, without the water that it
    holds or carries, or the core's centre, which gains by being shaken. Sensors stay the core's."""
    length: Literal["stretched", "rest"] = "stretched"
    """The body length: `stretched`: the longest way through the body with its hinges straightened
    (no fold makes that shorter); `rest`: the longest edge of its bounding box at rest."""
    duration: Annotated[Positive, Le(86_400), Unit("s")] = 10.0
    """Length of an episode, a day at most, rounded to rows of the track, 0.1 s or so [s]."""
    settle: Annotated[NonNegative, Unit("s")] = 1.0
    """Time at the start of an episode that does not count; scoring begins with the next row, 0.1 s
    later at most. The last two rows always count [s]."""
    trials: Annotated[Integer, Ge(1)] = 2
    """Episodes averaged per individual, each from its own start [-]."""
    direction: Annotated[Vector, Unit("-")] = (1.0, 0.0, 0.0)
    """Direction to swim in, world frame; its length does not matter [-]."""
    target: Annotated[Vector, Unit("m")] | None = None
    """Position of the target, world frame; `reach_target`, `search` and `escape` require it, or
    `target_distance` [m]."""
    target_distance: Annotated[Positive, Unit("m")] | None = None
    """Distance of the target from the start, at the same depth, in a direction drawn for each
    episode; in place of `target` [m]."""
    target_spread: Annotated[Positive, Le(math.pi), Unit("rad")] = math.pi
    """Largest angle between that direction and the world's x axis, to both sides [rad]."""
    target_speed: Annotated[NonNegative, Unit("m/s")] = 0.0
    """Speed of the target, horizontal, in a direction drawn for each episode [m/s]."""
    target_turn: Annotated[Positive, Le(100), Unit("rad/s")] | None = None
    """Makes the target a pursuer, which heads for the robot at `target_speed` and turns at this
    rate at most; `escape` requires it [rad/s]."""
    sight: Annotated[Positive, Unit("m")] | None = None
    """The distance up to which the target is sensed, by default any; `search` requires it [m]."""
    touch: Annotated[Positive, Unit("m")] = 0.1
    """Distance of the target from the robot's `point` at which they touch, for `search` and
    `escape` [m]."""
    course_spread: Annotated[Positive, Le(math.pi), Unit("rad")] | None = None
    """Largest angle between each episode's course and `direction`, seen from above, to both sides;
    `follow_course` requires it [rad]."""
    course_changes: Annotated[Integer, Ge(0), Le(16)] = 0
    """Number of sudden turns of the course in an episode, at times drawn between `settle` and
    `duration` [-]."""
    course_turn: Annotated[Positive, Le(math.pi), Unit("rad")] = math.pi
    """Largest angle of such a turn, to either side [rad]."""
    course_rate: Annotated[NonNegative, Le(10), Unit("rad/s")] = 0.0
    """Largest constant turning rate of the course; rate and side are drawn for each episode
    [rad/s]."""
    horizon: Annotated[Positive, Le(3600), Unit("s")] | None = None
    """Time over which `speed` and `directed_swim` are extrapolated, if the robot continues to turn
    and to rise as from the first half of the episode to the second; none: the episode itself is
    scored [s]."""
    depth: Annotated[NonNegative, Unit("m")] = 2.0
    """Depth of the start below the surface; `crawl` starts on the bed instead, and `follow_bed`
    at `height` above it [m]."""
    height: Annotated[Positive, Unit("m")] | None = None
    """Height above the bed: of the core at the start, then of the robot's `point`; `follow_bed`
    requires it [m]."""
    depth_tolerance: Annotated[Positive, Unit("m")] = 0.25
    """Distance from the start depth, from `height` or, of `crawl`, from the bed, up to which
    progress counts in full; beyond, it counts less and less, from twice the distance on not at
    all [m]."""
    energy_weight: Annotated[NonNegative, Unit("1/J")] = 0.0
    """Score lost per joule of work of servos and propellers, summed without sign [1/J]."""
    start_tilt: Annotated[NonNegative, Le(math.pi), Unit("rad")] = 0.1
    """Standard deviation of the start's roll and pitch [rad]."""
    start_attitude: Literal["level", "righted"] = "level"
    """Attitude of the core before the tilt: `level`, or `righted`, the body's equilibrium in deep
    water, with its centre of mass below that of its volume."""
    start_yaw: Annotated[NonNegative, Unit("rad")] = 0.0
    """Standard deviation of the start's heading [rad]."""
    start_position: Annotated[NonNegative, Unit("m")] = 0.0
    """Standard deviation of the start's place, along each axis [m]."""
    current_std: Annotated[NonNegative, Unit("m/s")] = 0.0
    """Standard deviation of an extra horizontal current, drawn for each episode [m/s]."""
    robust: Annotated[RobustConfig | None, BeforeValidator(_read_robust)] = None
    """`true`, or ranges: coefficients of water and motors are drawn anew in each generation, for
    each trial, the same for all individuals, so that champions do not live on one number."""
    measures: TupleOf[Annotated[str, AfterValidator(_check_measure)]] = ()
    """Names of further measures, of `measure_table.MEASURES`."""
    params: Annotated[dict[str, Any], File("data")] = Field({})
    """Settings of a function of the user's own, which reads them as `settings.params`."""

    def energy_weight_over(self, seconds: float) -> float:
        """`energy_weight` by which a rate loses as much in an episode of so many seconds [1/J].

        Work grows with time, a rate does not.
        """
        return self.energy_weight * self.duration / seconds

    @model_validator(mode="after")
    def _check(self) -> TaskConfig:
        self.refuse_params(self.params)
        if self.settle >= self.duration:
            below = f"a time below task.duration ({self.duration:g} s)"
            raise ConstraintError("settle", below, f"{self.settle:g}")
        for name in TASKS.get(self.type, ()):
            if getattr(self, name) is None:
                field = type(self).model_fields[name]
                what = describe(Annotated[(field.annotation, field)]).removesuffix(", or nothing")
                raise ConstraintError(name, f"{what}, because task.type is {self.type}", "none")
        if self.horizon is not None and self.type not in ("speed", "directed_swim"):
            what = f"none, as task.type is {self.type}; speed and directed_swim have one"
            raise ConstraintError("horizon", what, f"{self.horizon:g}")
        if self.horizon is not None and self.horizon < self.duration:
            least = f"a time >= task.duration ({self.duration:g} s)"
            raise ConstraintError("horizon", least, f"{self.horizon:g}")
        found = [name for name in ("target", "target_distance") if getattr(self, name) is not None]
        if len(found) > 1:
            raise ConstraintError("target", "none, as there is a target_distance", "one")
        if not found and self.type in TO_TARGETS:
            what = f"three numbers [m], or target_distance, because task.type is {self.type}"
            raise ConstraintError("target", what, "none")
        if self.target_turn is not None and self.target_speed == 0:
            what = "a speed > 0 [m/s], as with target_turn the target is a pursuer"
            raise ConstraintError("target_speed", what, "0")
        if self.target_turn is not None and not found:
            what = "three numbers [m], or target_distance, as there is a target_turn"
            raise ConstraintError("target", what, "none")
        own = self.is_user_code
        needed = {
            "target_speed": ("target or target_distance", found),
            "target_spread": ("target_distance", self.target_distance),
            "sight": ("target or target_distance", found),
            "course_changes": ("course_spread", self.course_spread),
            "course_rate": ("course_spread", self.course_spread),
            "course_turn": ("course_changes", self.course_changes),
            "touch": ("search or escape", own or self.type in ("search", "escape")),
            "height": ("follow_bed", own or self.type == "follow_bed"),
            "depth_tolerance": (_one_of(_AT_DEPTH), own or self.type in _AT_DEPTH),
            "direction": (
                f"course_spread, nor {_one_of(_DIRECTED)}",
                own or self.course_spread is not None or self.type in _DIRECTED,
            ),
        }
        for name, (other, given) in needed.items():
            usual, value = type(self).model_fields[name].default, getattr(self, name)
            if not given and value != usual:
                what = f"{'none' if usual is None else _plain(usual)}, as there is no {other}"
                raise ConstraintError(name, what, _plain(value))
        level = {
            "a course_spread": self.course_spread is not None,
            "a horizon": self.horizon is not None and self.type == "directed_swim",
            f"task.type {self.type}": self.type == "hold_heading",
        }
        upright = math.hypot(*self.direction[:2]) < 1e-9
        for name in (name for name, needs in level.items() if needs and upright):
            what = f"one that is not upright, as there is {name}, which is level"
            raise ConstraintError("direction", what, _plain(self.direction))
        if level["a horizon"] and self.direction[2] != 0 and not upright:
            note("task.horizon: the way that is foretold is level, direction's z does not count")
        if math.hypot(*self.direction) < 1e-9:
            raise ConstraintError("direction", "a vector of some length", _plain(self.direction))
        return self


def _one_of(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"


def _plain(value: Any) -> str:
    return show(list(value)) if isinstance(value, tuple) else f"{value:g}"


class EvolutionConfig(Settings):
    """Settings of the search over genes."""

    strategy: Annotated[str, MinLen(1)] = "CMA_ES"
    """Name of an evosax strategy; `mjx_revolve.evolution.STRATEGIES` lists them."""
    population_size: Annotated[Integer, Ge(4)] = 64
    generations: Annotated[Integer, Ge(1)] = 60
    seed: Annotated[Integer, Ge(0), Lt(2**32)] = 0
    std_init: Annotated[Positive, Unit("-")] = 0.5
    """Standard deviation of the first population's genes [-]; evosax's xNES takes its square,
    iAMaLGaM_Full adds that to a variance of 1, iAMaLGaM_Univariate adds 1 to it, and GuidedES,
    ASEBO and GradientlessDescent take a part."""
    checkpoint_every: Annotated[Integer, Ge(1)] = 5
    """Generations between checkpoints."""
    keep_checkpoints: Annotated[Integer, Ge(1)] = 3
    """Number of newest checkpoints that are kept."""
    tensorboard: bool = False
    """Whether the metrics go to RUN/tensorboard/ as well; needs tensorboardX."""
    passport: Literal["required"] | bool = True
    """Whether the champion's passport is made at the end, in half a minute or a whole one.
    `required`: of the few best candidates, the first that passes becomes the champion, or the best
    where none does; where bodies evolve, `bodies.selection.passport` asks for that."""
    strategy_params: dict[str, Any] = Field({})
    """Settings of the strategy itself, by evosax's names."""


@dataclass(frozen=True)
class _Overrides:
    """Overrides from the command line, for messages; they do not count in comparisons.

    Attributes:
        settings: values by dotted key.
        label: of messages about them.
    """

    settings: Mapping[str, object] = field(default_factory=dict, compare=False)
    label: str = field(default="", compare=False)


class Config(Settings):
    """A whole run. Paths are absolute once it went through `make_config` or `load_config`."""

    morphology: Annotated[_Morphology | None, File("morphology")] = None
    """The robot: a morphology YAML; none where bodies evolve."""
    modules: Annotated[_Modules | None, File("modules")] = None
    """The user's own module types: a YAML, or None."""
    coefficients: Annotated[_Modules | None, File("modules")] = None
    """Coefficients fitted to a real robot, by types of modules: a YAML, or None."""
    allow_overlap: bool = False
    """Whether modules may overlap."""
    trim: Literal["neutral", "none"] = "none"
    """`neutral` adds to the core the electronics volume that lets it hover."""
    world: Annotated[_World, File("world")]
    """A world's name or path, or a mapping of `name` and overrides for `load_world`."""
    engine: Literal["population", "mjx"] = "population"
    """`population` steps the whole population at once; `mjx` is MJX's own step, the reference."""
    controller: ControllerConfig = ControllerConfig()
    task: TaskConfig
    bodies: BodiesConfig | None = None
    """How bodies evolve; without it only the controller of the one `morphology` does."""
    colony: ColonyConfig | None = None
    """How they live together in one world, without generations; without it each is tried alone."""
    evolution: EvolutionConfig = EvolutionConfig()

    @model_validator(mode="after")
    def _check(self) -> Config:
        if self.colony is not None:
            self._check_colony(self.colony)
        if self.bodies is None:
            if self.morphology is None:
                what = "the path of a morphology YAML, or bodies: how they evolve"
                raise ConstraintError("morphology", what, "nothing")
            return self
        if self.morphology is not None:
            what = "none, as bodies evolve (bodies.seeds names robots to begin with)"
            raise ConstraintError("morphology", what, self.morphology)
        if self.controller.type == "brain":
            what = "another one, as bodies evolve, and no brain of a file fits them"
            raise ConstraintError("controller.type", what, "brain")
        if self.engine != "population":
            raise ConstraintError("engine", "population, as bodies evolve", self.engine)
        if self.allow_overlap:
            note("allow_overlap has no effect, as bodies evolve: those that overlap are refused")
        if self.evolution.passport == "required":
            what = "true or false, as bodies evolve (bodies.selection.passport asks for it)"
            raise ConstraintError("evolution.passport", what, "required")
        for name in ("strategy", "strategy_params", "std_init"):
            usual, found = EvolutionConfig.model_fields[name].default, getattr(self.evolution, name)
            if found != usual:
                what = f"{usual!r}, as bodies evolve (see bodies.selection, .learning and .brains)"
                raise ConstraintError(f"evolution.{name}", what, repr(found))
        return self

    def _check_colony(self, colony: ColonyConfig) -> None:
        """Refuses settings that a colony does not use."""
        if self.bodies is None:
            raise ConstraintError("bodies", "how bodies evolve, as there is a colony", "nothing")
        # How robots are chosen is the colony's; whether a champion needs a passport is not.
        selection = SelectionConfig(passport=self.bodies.selection.passport)
        for name, usual in (("learning", LearningConfig()), ("selection", selection)):
            if getattr(self.bodies, name) != usual:
                what = "nothing, as in a colony robots that meet have children, and learn nothing"
                raise ConstraintError(f"bodies.{name}", what, "some settings")
        if self.bodies.archive is not None:
            raise ConstraintError("bodies.archive", "none, as there is a colony", "one")
        initial, seeds = colony.birth.initial, len(self.bodies.seeds)
        if initial > self.evolution.population_size:
            most = f"at most evolution.population_size ({self.evolution.population_size})"
            raise ConstraintError("colony.birth.initial", most, initial)
        if initial < seeds:
            least = f"at least as many as bodies.seeds ({seeds})"
            raise ConstraintError("colony.birth.initial", least, initial)
        if colony.arena.depth <= self.task.depth:
            least = f"more than task.depth ({self.task.depth:g} m), at which robots are born"
            raise ConstraintError("colony.arena.depth", least, f"{colony.arena.depth:g}")
        defaults = type(self.task).model_fields
        own = [x for x in _OF_EPISODES if getattr(self.task, x) != defaults[x].default]
        if own:
            names = ", ".join(f"task.{name}" for name in own)
            note(f"{names}: of the episodes by which the champion is chosen; no robot lives by it")

    _source: str = PrivateAttr("config")
    _overrides: _Overrides = PrivateAttr(_Overrides())

    @property
    def source(self) -> str:
        """The file this came from, for messages; `config` when made in code."""
        return self._source

    def origin(self, place: str) -> str:
        """The beginning of a message about a setting: the option that set it, or the file."""
        typed = sets(self._overrides.settings, place)
        return f"{self._overrides.label} " if typed else f"{self._source}: "

    def blame(self, error: InputError) -> InputError:
        """The same error, its message prefixed by the option that set the value, or by the file."""
        label, text = self._overrides.label, str(error).removeprefix(f"{self._source}: ")
        if label and text.startswith(f"{label} "):
            return error
        return InputError(self.origin(text.partition(":")[0]) + text)

    def misfit(self, place: str, expected: str, found: object) -> InputError:
        """The error of a setting that does not fit others, or the files that they name."""
        return InputError(f"{self.origin(place)}{place}", expected, found)

    def require_population(self, why: str) -> None:
        """Raises `InputError` where the engine is another one."""
        if self.engine != "population":
            raise InputError(f"{self._source}: engine", f"population, {why}", self.engine)

    @property
    def name(self) -> str:
        """A short name: the file's name without its suffix."""
        return Path(self._source).stem

    @property
    def unit(self) -> str:
        """The word for its generations: "interval" for a colony."""
        return "generation" if self.colony is None else "interval"

    @property
    def has_user_code(self) -> bool:
        """Whether the task or the controller is a function in a user's own file."""
        return self.task.is_user_code or self.controller.is_user_code

    @property
    def files(self) -> tuple[NamedFile, ...]:
        """The files that the settings name."""
        found: list[NamedFile] = []
        map_files(self.model_dump(), found.append, Config)
        return tuple(found)

    def for_body(self, morphology: str | Path) -> Config:
        """The configuration for the evolution of one body's brain, given a morphology's path."""
        none = {"bodies": None, "colony": None}
        return self.model_copy(update={"morphology": str(morphology)} | none)

    @property
    def world_name(self) -> str:
        """The world's name, or the absolute path of its YAML."""
        return self.world if isinstance(self.world, str) else self.world["name"]

    @property
    def subject(self) -> str:
        """Task and world in words: `directed_swim in lake`."""
        return f"{self.task.name} in {Path(self.world_name).stem}"

    @property
    def world_overrides(self) -> dict[str, object]:
        """Keyword arguments for `load_world(config.world_name, **config.world_overrides)`."""
        if isinstance(self.world, str):
            return {}
        return {key: value for key, value in self.world.items() if key != "name"}


def make_config(
    data: Mapping[str, object],
    folder: str | Path = ".",
    overrides: Mapping[str, object] | Sequence[str] = (),
    source: str = "config",
) -> Config:
    """Checks a mapping of settings.

    Args:
        data: the settings, nested like the YAML file.
        folder: base of relative paths in `data`. Those in overrides are relative to the current
            folder, as on the command line.
        overrides: see `load_config`.
        source: name of the settings in messages.

    Returns:
        The checked configuration, its paths absolute.

    Raises:
        InputError: a key is unknown or missing, a value is out of bounds, or a file is missing.
    """
    if not isinstance(data, Mapping):
        raise InputError(source, "a mapping", show(data))
    settings, label = read_overrides(overrides)
    merged = copy_plain(data)
    for key, value in settings.items():
        merge_override(merged, key, value, label, named=("world",))

    def origin(place: str) -> tuple[Path, str]:
        typed = sets(settings, place)
        return (Path.cwd(), f"{label} ") if typed else (Path(folder), f"{source}: ")

    merged = map_files(merged, lambda file: _resolve(file, *origin(file.place)), Config)
    try:
        config = Config.model_validate(merged)
    except ValidationError as error:
        problems = find_problems(error, Config, merged)
        at = f"{label} {', '.join(settings)}: "
        blamed = bool(settings) and _is_valid(data, folder)  # valid without the overrides

        def before(place: str) -> str:
            return at if blamed and not sets(settings, place) else origin(place)[1]

        raise refuse(problems, before) from None
    config._source, config._overrides = source, _Overrides(settings, label)
    return config


def _is_valid(data: Mapping[str, object], folder: str | Path) -> bool:
    try:
        make_config(data, folder)
    except InputError:
        return False
    return True


def _resolve(file: NamedFile, folder: Path, before: str) -> str:
    """The setting with an absolute path; `before` stands before its place in messages."""
    if file.kind == "data":
        return file.text
    place = before + file.place
    named = Path(os.path.expanduser(file.path))
    found = folder / named
    if file.kind == "morphology":
        found = find_shipped(named, "morphologies", folder, place)
    with reading(place):
        path = check_path(os.path.abspath(found))
    if not path.is_file():
        what = "a folder" if path.is_dir() else "none"
        raise InputError(place, "a file", f"{what} at {short_path(path)}")
    return file.at(path)


def load_config(path: str | Path, overrides: Mapping[str, object] | Sequence[str] = ()) -> Config:
    """Reads a configuration file.

    Args:
        path: the YAML file, or a shipped configuration's name. Relative paths in it start from its
            folder.
        overrides: values that replace the file's: a mapping of dotted keys or nested mappings
            (`{"task.duration": 5.0}`), or texts as on the command line (`["task.duration=5"]`).
            `world.current=[...]` works on a world given by name, too.

    Returns:
        The checked configuration, its paths absolute.

    Raises:
        InputError: the file is missing or no YAML, a key is unknown or missing, a value is out of
            bounds, or a file it names is missing.
    """
    path = find_shipped(path, "configs")
    data = load_yaml(path)
    if not isinstance(data, dict):
        found = "an empty file" if data is None else show(data)
        raise InputError(short_path(path), "a mapping of settings", found)
    if "body" in data and "task" not in data:
        raise InputError(short_path(path), "a configuration", "a robot")
    if data and set(data) <= {field.name for field in dataclasses.fields(World)}:
        raise InputError(short_path(path), "a configuration", "a world")
    if is_run_config(path):
        data = locate_files(data, find_copies(Path(os.path.abspath(path.parent))))
        data = with_older_values(data, path.parent)
    return make_config(data, path.parent, overrides, short_path(path))


def with_older_values(data: Mapping[str, object], folder: str | Path) -> dict[str, object]:
    """A run folder's settings with the values that older versions had where they lack a setting."""
    own = {name: data.get(name) for name in OLDER}
    found = {**data} | {k: {**OLDER[k], **x} for k, x in own.items() if isinstance(x, Mapping)}
    if "world" in found:
        found["world"] = with_stated(found["world"], OLDER_WORLD, folder)
    return found


def with_stated(world: object, fields: Mapping[str, object], folder: str | Path = "") -> Any:
    """A world's settings with those fields that neither they nor the world's file state."""
    given = {"name": world} if isinstance(world, str) else world
    if not isinstance(given, Mapping) or not isinstance(given.get("name"), str):
        return world
    beside = Path(folder) / given["name"]
    file = beside if beside.is_file() else given["name"]
    added = {k: x for k, x in fields.items() if k not in given and is_left_out(file, k)}
    return {**given, **added} if added else world


def state_world(world: object) -> Any:
    """A world's settings with today's values of what older versions had otherwise."""
    return with_stated(world, {name: getattr(World, name) for name in OLDER_WORLD})


def override_config(config: Config, overrides: Mapping[str, object] | Sequence[str]) -> Config:
    """Applies overrides to a configuration that was already checked.

    Args:
        config: the configuration; it stays as it is.
        overrides: see `load_config`.

    Returns:
        The new configuration.

    Raises:
        InputError: see `load_config`.
    """
    return make_config(config.model_dump(), "/", overrides, config.source)


def dump_config(config: Config, folder: str | Path | None = None) -> str:
    """Writes a configuration as YAML with every value spelled out.

    Args:
        config: the configuration.
        folder: where the text will be saved, or None. Paths inside this folder are written
            relative to it, so that the folder can be moved; all others stay absolute.

    Returns:
        The YAML text; `load_config` reads it back equal.
    """

    def shorten(file: NamedFile) -> str:
        path, root = Path(file.path), Path(os.path.abspath(folder or ""))
        if folder is None or not path.is_relative_to(root):
            return file.text
        return file.at(path.relative_to(root).as_posix())

    data = map_files(copy_plain(config.model_dump()), shorten, Config)
    return dump_yaml(data, default_flow_style=None)
