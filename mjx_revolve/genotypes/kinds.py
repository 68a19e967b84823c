"""The genotypes by name, and users' own."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mjx_revolve.body.tree import Morphology
from mjx_revolve.genotypes.genotype import Genotype, Space
from mjx_revolve.genotypes.tree import make_tree
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.own_code import call_own, load_own, parse_own, short_name

# By the name that a configuration gives; each takes (space, params, place for messages).
GENOTYPES: dict[str, Callable[[Space, Mapping[str, Any], str], Genotype]] = {
    "tree": make_tree,
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
    _check_own(name, made, space)
    return made


def _check_own(name: str, genotype: Any, space: Space) -> None:
    """Refuses what is no genotype of this space, as far as one child can tell."""
    own = parse_own(name)
    place = f"{own.path}: {own.function}" if own else name
    if not isinstance(genotype, Genotype):
        raise InputError(f"{place}: expected a Genotype; found {type(genotype).__name__}")

    def run() -> tuple[Any, Any]:
        rng = np.random.default_rng(0)
        one, other = genotype.random(rng), genotype.random(rng)
        child = genotype.mutate(rng, genotype.cross(rng, one, other))
        again = genotype.from_plain(json.loads(json.dumps(genotype.to_plain(child))))
        return genotype.develop(child), genotype.develop(again)

    body, again = call_own(name, f"{short_name(name)} to grow, vary and save bodies", run)
    if not isinstance(body, Morphology):
        raise InputError(f"{place}: develop: expected a Morphology; found {type(body).__name__}")
    reason = space.refuses(body)
    if reason is not None:
        raise InputError(f"{place}: develop: {reason}")
    if body != again:
        raise InputError(
            f"{place}: to_plain, from_plain: expected a genome that JSON gives back; found one "
            "that grows another body"
        )
