"""Settings of evolving bodies and brains: `bodies` in a configuration."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from annotated_types import Ge, MinLen, Unit
from pydantic import Field, model_validator

from mjx_revolve.episodes.settings import File, Settings, one_of
from mjx_revolve.genotypes.table import GENOTYPES
from mjx_revolve.inputs.errors import note
from mjx_revolve.inputs.schema import (
    ConstraintError,
    Integer,
    NonNegative,
    Number,
    Positive,
    Share,
    TupleOf,
    words,
)
from mjx_revolve.inputs.user_code import short_name

Scheme = Literal["plus", "comma", "generational", "steady", "nsga2", "map_elites", "random"]
"""How survivors are chosen; `evolution.selection.SCHEMES` has the functions."""
# From which share of real individuals on a block is better filled up than shared: a body by itself
# takes three quarters of the time, or less.
_WORTH = 0.75
_MOST_CELLS = 10_000_000  # of a grid, 80 MB for a number of each: a choice


class BrainsConfig(Settings):
    """Inheritance and encoding of brains."""

    type: Literal["joints", "cppn"] = "joints"
    """`joints`: genes of the controller, inherited by the joint's name and completed where the body
    has grown. `cppn`: weights of a network from a joint's place to its genes."""
    inheritance: Literal["lamarckian", "darwinian", "none"] = "lamarckian"
    """A child's brain is inherited from the brains that its parents have learnt (`lamarckian`), or
    from those of their birth (`darwinian`), or is drawn anew (`none`)."""
    mutation: Annotated[NonNegative, Unit("-")] = 0.2
    """Standard deviation of the noise on inherited genes [-]."""
    std_init: Annotated[Positive, Unit("-")] = 0.5
    """Standard deviation of genes that are drawn anew [-]."""


class LearningConfig(Settings):
    """Learning of each body: a search of its own, around the brain of its birth.

    All bodies learn at once. With one generation of one individual nothing is learnt: the brain is
    tried as it is.
    """

    strategy: Annotated[str, MinLen(1)] = "SNES"
    """Name of an evosax strategy. With one generation there is nothing for it to follow: brains are
    drawn around the one of birth."""
    population_size: Annotated[Integer, Ge(1)] = 1
    """Brains that are tried at a time; the first of them is the one of its birth."""
    generations: Annotated[Integer, Ge(1)] = 1
    std_init: Annotated[Positive, Unit("-")] = 0.3
    """Standard deviation of the first brains that are tried [-]."""
    strategy_params: dict[str, Any] = Field({})
    """Settings of the strategy itself, by evosax's names."""

    @property
    def trials(self) -> int:
        """Brains that one body tries."""
        return self.population_size * self.generations

    def blocks_of_body(self, block: int) -> int:
        """Blocks of so many individuals that one body's brains fill; 0: bodies share blocks."""
        blocks = -(-self.population_size // block)
        return blocks if self.population_size >= _WORTH * block * blocks else 0


class SelectionConfig(Settings):
    """Selection of parents and survivors."""

    type: Scheme = "plus"
    """`plus` (μ+λ): the best of parents and children stay; `comma` (μ,λ): of the children;
    `generational`: the children, and `elites` of the parents; `steady`: each child takes the place
    of the worst, if it is better; `nsga2`: by dominance and crowding; `map_elites`: the best of
    each cell of the archive; `random`: nothing is inherited, for comparison."""
    offspring: Annotated[Integer, Ge(1)] | None = None
    """Children in a generation, λ; by default `evolution.population_size`, μ."""
    tournament: Annotated[Integer, Ge(1)] = 2
    """The best of so many drawn individuals becomes a parent."""
    elites: Annotated[Integer, Ge(0)] = 1
    """Parents that stay; `generational` only."""
    max_age: Annotated[Integer, Ge(1)] | None = None
    """Generations after which an individual is removed, however good it is."""
    reevaluate: bool = False
    """Whether parents and children are evaluated in each generation on starts that no brain was
    chosen on; scores and measures are means over all of these evaluations."""
    objectives: Annotated[TupleOf[str], MinLen(1)] = ("score",)
    """Maximised, or with a minus before it minimised: `score`, `novelty`, or a measure or
    descriptor by name. `nsga2` takes several, all others one."""
    novelty: TupleOf[str] = ()
    """Descriptors and measures: `novelty` is the mean distance to neighbours in their space."""
    neighbours: Annotated[Integer, Ge(1)] = 15
    """Number of neighbours."""
    passport: Literal["required", "made"] = "made"
    """`required`: of the few best, the first that passes its passport (see `docs/evolution.md`)
    becomes the champion, or the best where none does; `made`: the best, whatever it does, with
    a passport unless `evolution.passport` is false."""


class Axis(Settings):
    """An axis of an archive."""

    low: Number
    high: Number
    cells: Annotated[Integer, Ge(1)] = 10

    @model_validator(mode="after")
    def _check(self) -> Axis:
        if self.low >= self.high:
            raise ConstraintError("high", f"a number > low ({self.low:g})", f"{self.high:g}")
        return self


class ArchiveConfig(Settings):
    """The best of each kind: cells over descriptors and measures by name."""

    type: Literal["grid", "cvt"] = "grid"
    """`grid`: the product of the axes' cells; `cvt`: centroidal Voronoi cells, `cells` of them."""
    axes: dict[str, Axis]
    cells: Annotated[Integer, Ge(2)] = 256
    """Of a `cvt` archive."""

    @model_validator(mode="after")
    def _check(self) -> ArchiveConfig:
        if len(self.axes) < 2:
            raise ConstraintError("axes", "at least two descriptors or measures", len(self.axes))
        cells = math.prod(axis.cells for axis in self.axes.values())
        if self.type == "grid" and cells > _MOST_CELLS:
            raise ConstraintError("axes", f"at most {_MOST_CELLS:,} cells", f"{cells:,}")
        if self.type == "grid" and self.cells != type(self).model_fields["cells"].default:
            note(f"bodies.archive.cells is of cvt: the grid has {cells:,} by its axes")
        usual = Axis.model_fields["cells"].default
        if self.type == "cvt" and any(axis.cells != usual for axis in self.axes.values()):
            note(f"cells of bodies.archive.axes are of a grid: the cvt archive has {self.cells:,}")
        return self


class BodiesConfig(Settings):
    """Settings of evolving bodies."""

    genotype: Annotated[str, one_of(GENOTYPES), File("code")] = "tree"
    """Representation of bodies: a genotype of `docs/evolution.md`, or FILE.py:FUNCTION."""
    modules: Annotated[TupleOf[str], MinLen(1), words("a list of at least one type")] = (
        "FixedBrick",
        "ActiveHinge",
    )
    """Types of modules that bodies are grown of, beside the core."""
    core: Annotated[str, MinLen(1)] = "Core"
    """Type of the core."""
    min_modules: Annotated[Integer, Ge(1)] = 2
    """Fewest modules, the core included."""
    max_modules: Annotated[Integer, Ge(2)] = 16
    min_hinges: Annotated[Integer, Ge(0)] = 1
    max_hinges: Annotated[Integer, Ge(1)] = 8
    max_of: dict[str, Annotated[Integer, Ge(0)]] = Field({})
    """Most modules of a type by its name, such as `{Thruster: 4}`; of others, any number."""
    max_length: Annotated[Positive, Unit("m")] | None = None
    """Longest edge of the bounding box at rest [m]."""
    max_mass: Annotated[Positive, Unit("kg")] | None = None
    """Mass [kg]."""
    mutation: Share = 0.8
    """Share of the crossed children that are mutated; those that are not crossed always are [-]."""
    crossover: Share = 0.5
    """Share of the children that have two parents, of those that are no clones; in a colony all
    have two, and so many cross their bodies [-]."""
    cloning: Share = 0.0
    """Share of the children that have their first parent's body as it is: only their brains are
    mutated, and learn [-]."""
    seeds: Annotated[TupleOf[str], File("morphology")] = ()
    """Morphologies that begin the population, beside random bodies: paths or shipped names."""
    random: Share = 1.0
    """Share of the first population that is random, where there are seeds; the others are seeds and
    mutants of them [-]."""
    params: Annotated[dict[str, Any], File("data")] = Field({})
    """Settings of the genotype."""
    brains: BrainsConfig = BrainsConfig()
    learning: LearningConfig = LearningConfig()
    selection: SelectionConfig = SelectionConfig()
    archive: ArchiveConfig | None = None

    @property
    def name(self) -> str:
        """The genotype's name in titles."""
        return short_name(self.genotype)

    @model_validator(mode="after")
    def _check(self) -> BodiesConfig:
        for low, high in (("min_modules", "max_modules"), ("min_hinges", "max_hinges")):
            least, most = getattr(self, low), getattr(self, high)
            if most < least:
                raise ConstraintError(high, f"at least {low} ({least})", most)
        if self.max_hinges >= self.max_modules:
            most = f"less than max_modules ({self.max_modules}), of which the core is one"
            raise ConstraintError("max_hinges", most, self.max_hinges)
        selection = self.selection
        if selection.type == "map_elites" and self.archive is None:
            raise ConstraintError("archive", "axes, because selection.type is map_elites", "none")
        if selection.reevaluate and (self.archive or selection.type == "random"):
            keeper = "an archive" if self.archive else "random"
            off = f"false, as {keeper} keeps individuals by one evaluation"
            raise ConstraintError("selection.reevaluate", off, "true")
        if selection.elites != 1 and selection.type != "generational":
            what = f"1, as only generational has elites (selection.type is {selection.type})"
            raise ConstraintError("selection.elites", what, selection.elites)
        if len(selection.objectives) > 1 and selection.type != "nsga2":
            one = f"one, as only nsga2 takes several (selection.type is {selection.type})"
            raise ConstraintError("selection.objectives", one, ", ".join(selection.objectives))
        if selection.type == "map_elites" and selection.objectives != ("score",):
            best = "score, as the cells of map_elites keep the best by it"
            raise ConstraintError("selection.objectives", best, ", ".join(selection.objectives))
        wants = any(name.removeprefix("-") == "novelty" for name in selection.objectives)
        if wants and not selection.novelty:
            named = "descriptors or measures, because novelty is an objective"
            raise ConstraintError("selection.novelty", named, "none")
        if selection.novelty and not wants:
            none = "none, as novelty is no objective"
            raise ConstraintError("selection.novelty", none, ", ".join(selection.novelty))
        usual = type(selection).model_fields
        if selection.neighbours != usual["neighbours"].default and not wants:
            note("bodies.selection.neighbours has no effect, as novelty is no objective")
        drawn = selection.type in ("map_elites", "random")
        if selection.tournament != usual["tournament"].default and drawn:
            note(f"bodies.selection.tournament has no effect: {selection.type} holds none")
        if selection.max_age is not None and drawn:
            note(f"bodies.selection.max_age has no effect: {selection.type} removes none by age")
        own = BrainsConfig.model_fields["mutation"].default
        if self.brains.inheritance == "none" and self.brains.mutation != own:
            note("bodies.brains.mutation has no effect, as no brain is inherited")
        learning, usual = self.learning, LearningConfig.model_fields
        if learning.strategy != usual["strategy"].default and learning.generations == 1:
            drawn_only = "with one generation brains are drawn around that of birth"
            note(f"bodies.learning.strategy has no effect: {drawn_only}")
        if learning.std_init != usual["std_init"].default and learning.trials == 1:
            note("bodies.learning.std_init has no effect: one brain is tried, that of birth")
        if self.learning.strategy_params and self.learning.generations == 1:
            none = "none, as with one generation no strategy learns"
            raise ConstraintError("learning.strategy_params", none, "some")
        return self
