"""The genotypes by name, and users' own."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mjx_revolve.body.tree import Morphology
from mjx_revolve.genotypes.cppn import make_cppn
from mjx_revolve.genotypes.genotype import Genotype, Space
from mjx_revolve.genotypes.plasticoding import make_plasticoding
from mjx_revolve.genotypes.tree import make_tree
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.own_code import call_own, load_own, parse_own, short_name

# By the name that a configuration gives; each takes (space, params, place for messages).
GENOTYPES: dict[str, Callable[[Space, Mapping[str, Any], str], Genotype]] = {
    "tree": make_tree,
    "plasticoding": make_plasticoding,
    "cppn": make_cppn,
}


def make_genotype(
    name: str, space: Space, params: Mapping[str, Any], source: str = "config"
) -> Genotype:
    """The genotype that a configuration names.

    Args:
        name: one in `GENOTYPES`, or FILE.py:FUNCTION for a function of the user's own, which takes
            the space and the params and returns a `Genotype`.
        space: the bodies that there may be.
        params: the genotype's settings.
        source: what messages call the configuration.

    Returns:
        The genotype.

    Raises:
        InputError: there is no such genotype, a setting is wrong, or a user's own makes bodies that
            are not in the space; one line says where.
    """
    if name in GENOTYPES:
        return GENOTYPES[name](space, params, f"{source}: bodies")
    if parse_own(name) is None:
        known = ", ".join(GENOTYPES)
        raise InputError(
            f"{source}: bodies.genotype: expected one of {known}, or FILE.py:FUNCTION; "
            f"found {name!r}"
        )
    function = load_own(name, f"{source}: bodies.genotype")
    made = call_own(name, f"{short_name(name)} to make a genotype", function, space, dict(params))
    genotype = _guard(name, made, space)
    _try(name, genotype)
    return genotype


def _place(name: str) -> str:
    """The user's function, for messages."""
    own = parse_own(name)
    return f"{own.path}: {own.function}" if own else name


def _guard(name: str, genotype: Any, space: Space) -> Genotype:
    """A user's genotype whose mistakes are one line, whenever they show."""
    if not isinstance(genotype, Genotype):
        found = type(genotype).__name__
        raise InputError(f"{_place(name)}: expected a Genotype; found {found}")

    def guarded(what: str) -> Callable[..., Any]:
        function = getattr(genotype, what)
        return lambda *given: call_own(name, f"{short_name(name)} to {what}", function, *given)

    grow = guarded("develop")

    def develop(genome: Any) -> Morphology:
        body = grow(genome)
        reason: str | None = f"expected a Morphology; found {type(body).__name__}"
        if isinstance(body, Morphology):
            reason = space.refuses(body)
        if reason is not None:
            raise InputError(f"{_place(name)}: develop: {reason}")
        return body

    return Genotype(
        name=genotype.name,
        random=guarded("random"),
        mutate=guarded("mutate"),
        cross=guarded("cross"),
        develop=develop,
        adopt=None if genotype.adopt is None else guarded("adopt"),
        to_plain=guarded("to_plain"),
        from_plain=guarded("from_plain"),
    )


def _try(name: str, genotype: Genotype) -> None:
    """Makes, grows and saves one child, so that mistakes show before a run begins."""
    rng = np.random.default_rng(0)
    one, other = genotype.random(rng), genotype.random(rng)
    child = genotype.mutate(rng, genotype.cross(rng, one, other))
    body, plain = genotype.develop(child), genotype.to_plain(child)
    try:
        text = json.dumps(plain)
    except (TypeError, ValueError) as error:
        found = str(error).splitlines()[0]
        raise InputError(
            f"{_place(name)}: to_plain: expected what JSON can hold; found: {found}"
        ) from None
    if genotype.develop(genotype.from_plain(json.loads(text))) != body:
        raise InputError(
            f"{_place(name)}: to_plain, from_plain: expected a genome that JSON gives back; found "
            "one that grows another body"
        )
