"""The interface of genotypes, the space of bodies, and what all genotypes are made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.tree import Morphology
from mjx_revolve.inputs.errors import InputError, show

T = TypeVar("T")
G = TypeVar("G")  # a genome
Origins: TypeAlias = Mapping[str, tuple[int, str]]
"""Modules that were copied: of which parent, and their names there, by name."""

# Bounds on length and mass are kept up to rounding.
SLACK = 1 + 1e-9
# Variations of a parent that are tried before it is returned unchanged, and random genomes before
# an error. Choices: with most bounds every second or third is in the space.
TRIES = 50
_RANDOM_TRIES = 300
# How many results `cached` keeps: a choice, those of some generations.
_CACHED = 1000


class Genotype(NamedTuple, Generic[G]):
    """A representation of bodies: plain functions of genomes, which are plain values.

    All genomes that they return develop into bodies in the space, and all randomness comes from the
    generator argument. `make_genotype` makes one from functions that may leave the space.

    Attributes:
        name: in a configuration.
        random: generator → genome. Raises `InputError` if none of many draws is in the space.
        mutate: (generator, genome) → mutant; the genome itself if none of `TRIES` mutants is in the
            space.
        cross: (generator, genome, genome) → one child; the first genome itself if none of `TRIES`
            children is in the space.
        develop: genome → valid body in the space, without a brain. A module that keeps its position
            in the tree keeps its name.
        adopt: body → genome that develops into it, but for its brain and path. Raises `InputError`
            if the body is not in the space. None if bodies cannot be converted.
        to_plain: genome → plain values for JSON, exactly.
        from_plain: the inverse of `to_plain`. Raises `InputError` for anything else.
        settle: genome that variation has just made → the genome as it is kept, and the origins of
            modules that were copied, by name (see `Module.origin`).
    """

    name: str
    random: Callable[[np.random.Generator], G]
    mutate: Callable[[np.random.Generator, G], G]
    cross: Callable[[np.random.Generator, G, G], G]
    develop: Callable[[G], Morphology]
    adopt: Callable[[Morphology], G | None] | None
    to_plain: Callable[[G], object]
    from_plain: Callable[[Any], G]
    settle: Callable[[G], tuple[G, Origins]] = lambda genome: (genome, {})


def accept_all(body: Morphology) -> bool:
    """No further limits."""
    return True


@dataclass(frozen=True)
class Space:
    """The space of bodies that a genotype keeps to.

    Attributes:
        catalogue: all types of modules by name and alias.
        modules: names of the types that bodies are grown of, beside the core.
        core: name of the core's type.
        min_modules: fewest modules, the core included.
        max_modules: most of them.
        min_hinges: fewest hinges.
        max_hinges: most of them.
        max_length: longest edge of the bounding box at rest [m]; None: any.
        max_mass: [kg]; None: any.
        max_of: most modules of a type, by its name; of others, any number.
        accepts: body → whether it is accepted: whether it can be trimmed, where it must be.
    """

    catalogue: Mapping[str, ModuleType]
    modules: tuple[str, ...]
    core: str
    min_modules: int
    max_modules: int
    min_hinges: int
    max_hinges: int
    max_length: float | None = None
    max_mass: float | None = None
    max_of: Mapping[str, int] = field(default_factory=dict)
    accepts: Callable[[Morphology], bool] = accept_all

    @cached_property
    def kinds(self) -> tuple[ModuleType, ...]:
        """The types that bodies are grown of."""
        return tuple(self.catalogue[name] for name in self.modules)

    def refuses(self, body: Morphology) -> str | None:
        """Why a body is not in the space, "expected X; found Y"; None if it is."""
        strange = next((m.type for m in body.modules if m.type not in self.catalogue), None)
        if strange is not None:
            return f"expected types of modules of the catalogue; found {show(strange)}"
        if body.overlaps:
            return f"expected modules that do not overlap; found {' and '.join(body.overlaps[0])}"
        counts = {"modules": body.num_modules, "hinges": body.num_hinges}
        for what, count in counts.items():
            least, most = getattr(self, f"min_{what}"), getattr(self, f"max_{what}")
            if not least <= count <= most:
                return f"expected {least} to {most} {what}; found {count}"
        for name, most in self.max_of.items():
            count = sum(module.kind.name == name for module in body.modules)
            if count > most:
                return f"expected at most {most} {name} (max_of); found {count}"
        if self.max_mass is not None and body.mass > self.max_mass * SLACK:
            return f"expected at most {self.max_mass:g} kg (max_mass); found {body.mass:g}"
        if self.max_length is not None and body.length > self.max_length * SLACK:
            return f"expected at most {self.max_length:g} m (max_length); found {body.length:g}"
        if not self.accepts(body):
            return "expected a body that can be trimmed (trim: neutral); found one that floats"
        return None


def make_space(
    bodies: Any,
    catalogue: Mapping[str, ModuleType],
    accepts: Callable[[Morphology], bool] = accept_all,
) -> Space:
    """The space of bodies of a configuration.

    Args:
        bodies: settings like `episodes.bodies_config.BodiesConfig`.
        catalogue: all types of modules by name and alias.
        accepts: as in `Space`.

    Returns:
        The space; its types go by their names, not by their aliases.

    Raises:
        InputError: there is no such type, one is named twice, or bodies need a hinge and none of
            the types has one.
    """

    def find(place: str, name: str, core: bool) -> str:
        kind = catalogue.get(name)
        if kind is None or (kind.mount is None) != core:
            known = sorted(n for n, k in catalogue.items() if (k.mount is None) == core)
            raise InputError(f"bodies.{place}", f"one of {', '.join(known)}", repr(name))
        return kind.name

    names = [find(f"modules.{i}", name, False) for i, name in enumerate(bodies.modules)]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InputError(f"bodies.modules.{i}", "each type once", f"{name!r} again")
    max_of = {find("max_of", name, False): most for name, most in bodies.max_of.items()}
    if len(max_of) < len(bodies.max_of):
        raise InputError("bodies.max_of", "each type once", ", ".join(bodies.max_of))
    for name in max_of:
        if name not in names:
            known = ", ".join(names)
            raise InputError("bodies.max_of", f"any of bodies.modules, {known}", name)
    if bodies.min_hinges > 0 and all(catalogue[name].hinge is None for name in names):
        hinged = f"a type with a hinge, since min_hinges is {bodies.min_hinges}"
        raise InputError("bodies.modules", hinged, ", ".join(names))
    bounds = ("min_modules", "max_modules", "min_hinges", "max_hinges", "max_length", "max_mass")
    return Space(
        catalogue=catalogue,
        modules=tuple(names),
        core=find("core", bodies.core, True),
        max_of=max_of,
        accepts=accepts,
        **{name: getattr(bodies, name) for name in bounds},
    )


# ------------------------------------------------------------------------- making one


def make_genotype(
    space: Space,
    name: str,
    place: str,
    *,
    draw: Callable[[np.random.Generator], G],
    mutate: Callable[[np.random.Generator, G], G | None],
    cross: Callable[[np.random.Generator, G, G], G | None],
    develop: Callable[[G], Morphology],
    to_plain: Callable[[G], object],
    from_plain: Callable[[Any], G],
    adopt: Callable[[Morphology], G | None] | None = None,
    settle: Callable[[G], tuple[G, Origins]] = lambda genome: (genome, {}),
) -> Genotype[G]:
    """A genotype that keeps to the space, from functions that may leave it.

    Args:
        space: of the bodies.
        name: in a configuration.
        place: where the bounds were given, for messages.
        draw: generator → any genome.
        mutate: (generator, genome) → mutant; None if the drawn mutation is impossible.
        cross: (generator, genome, genome) → child; None if impossible.
        develop: genome → body.
        to_plain: genome → plain values for JSON.
        from_plain: the inverse of `to_plain`; raises `InputError`.
        adopt: body in the space → genome that develops into it; None if there is none.
        settle: see `Genotype`; by default nothing is copied.
    """
    develop = cached(develop)

    def random(rng: np.random.Generator) -> G:
        reason: str | None = None
        for _ in range(_RANDOM_TRIES):
            genome = draw(rng)
            reason = space.refuses(develop(genome))
            if reason is None:
                return genome
        found = f"none of {_RANDOM_TRIES} that does (the last: {reason})"
        raise InputError(place, "bounds that random bodies can keep", found)

    def within(vary: Callable[..., G | None]) -> Callable[..., G]:
        """The first variation that is in the space, or the first parent."""

        def varied(rng: np.random.Generator, *parents: G) -> G:
            for _ in range(TRIES):
                child = vary(rng, *parents)
                if child is not None and space.refuses(develop(child)) is None:
                    return child
            return parents[0]

        return varied

    def check(body: Morphology) -> None:
        reason = space.refuses(body)
        if reason is not None:
            raise InputError(f"{body.path or body.name}: {reason}")

    def read(plain: object) -> G:
        genome = from_plain(plain)
        check(develop(genome))
        return genome

    def adopted(body: Morphology) -> G | None:
        assert adopt is not None
        check(body)
        return adopt(replace(body, brain=None, path=None))

    return Genotype(
        name=name,
        random=random,
        mutate=within(mutate),
        cross=within(cross),
        develop=develop,
        adopt=None if adopt is None else adopted,
        to_plain=to_plain,
        from_plain=read,
        settle=settle,
    )


def pick(rng: np.random.Generator, things: Sequence[T]) -> T:
    """A random one of several things; raises `InputError` if there is none."""
    if not things:
        raise InputError("variation", "anything to choose from", "nothing")
    return things[int(rng.integers(len(things)))]


def cached(function: Callable[[G], T]) -> Callable[[G], T]:
    """The same function with its last results cached by the identity of its argument.

    Variation develops a genome to see whether it is in the space; evaluation develops it again.
    Genomes need no hash. They are kept with the result, so that their id is not reused.
    """
    known: dict[int, tuple[G, T]] = {}

    def look_up(value: G) -> T:
        if id(value) not in known:
            if len(known) >= _CACHED:
                known.clear()
            known[id(value)] = value, function(value)
        return known[id(value)][1]

    return look_up
