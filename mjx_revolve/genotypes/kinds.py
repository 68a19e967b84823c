"""The genotype that a configuration names: one of the package's, or a user's own."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import numpy as np

from mjx_revolve.body.tree import Morphology
from mjx_revolve.genotypes.genotype import Genotype, Origins, Space
from mjx_revolve.genotypes.table import GENOTYPES
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.user_code import (
    call_user_function,
    function_place,
    load_user_function,
    parse_user_function,
    short_name,
)


def find_genotype(
    name: str, space: Space, params: Mapping[str, object], source: str = "config"
) -> Genotype:
    """The genotype that a configuration names.

    Args:
        name: one in `GENOTYPES`, or FILE.py:FUNCTION for a user's function, which takes the space
            and the params and returns a `Genotype`.
        space: of the bodies.
        params: the genotype's settings.
        source: the configuration, in messages.

    Raises:
        InputError: there is no such genotype, a setting is wrong, or a user's genotype makes bodies
            that are not in the space.
    """
    if name in GENOTYPES:
        module, function = GENOTYPES[name].split(".")
        make = getattr(import_module(f"mjx_revolve.genotypes.{module}"), function)
        return make(space, params, f"{source}: bodies")
    if parse_user_function(name) is None:
        known = f"one of {', '.join(GENOTYPES)}, or FILE.py:FUNCTION"
        raise InputError(f"{source}: bodies.genotype", known, repr(name))
    function = load_user_function(name, f"{source}: bodies.genotype")
    expected = f"{short_name(name)} to make a genotype"
    made = call_user_function(name, expected, function, space, dict(params))
    genotype = _guard(name, made, space)
    _try(name, genotype)
    return genotype


def _guard(name: str, genotype: object, space: Space) -> Genotype:
    """A user's genotype, with each error in its functions turned into one line."""
    place = function_place(name)
    if not isinstance(genotype, Genotype):
        raise InputError(place, "a Genotype", type(genotype).__name__)

    def guarded(what: str) -> Callable[..., Any]:
        function, expected = getattr(genotype, what), f"{short_name(name)} to {what}"
        return lambda *given: call_user_function(name, expected, function, *given)

    functions: dict[str, Any] = {what: guarded(what) for what in genotype._fields if what != "name"}
    if genotype.adopt is None:
        functions["adopt"] = None

    def develop(genome: object) -> Morphology:
        body = functions["develop"](genome)
        reason: str | None = f"expected a Morphology; found {type(body).__name__}"
        if isinstance(body, Morphology):
            reason = space.refuses(body)
        if reason is not None:
            raise InputError(f"{place}: develop: {reason}")
        return body

    def settle(genome: object) -> tuple[object, Origins]:
        found = functions["settle"](genome)
        if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], Mapping)):
            raise InputError(f"{place}: settle", "(genome, mapping of origins)", show(found))
        return found

    return genotype._replace(**functions | {"develop": develop, "settle": settle})


def _try(name: str, genotype: Genotype) -> None:
    """Makes, develops and saves one child, so that errors show before a run begins."""
    rng, place = np.random.default_rng(0), function_place(name)
    one, other = genotype.random(rng), genotype.random(rng)
    child, _ = genotype.settle(genotype.mutate(rng, genotype.cross(rng, one, other)))
    body, plain = genotype.develop(child), genotype.to_plain(child)
    try:
        text = json.dumps(plain)
    except (TypeError, ValueError) as error:
        found = str(error).splitlines()[0]
        raise InputError(
            f"{place}: to_plain: expected what JSON can hold; found: {found}"
        ) from None
    if genotype.develop(genotype.from_plain(json.loads(text))) != body:
        same = "a genome that JSON gives back"
        raise InputError(f"{place}: to_plain, from_plain", same, "one that grows another body")
