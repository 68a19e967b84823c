"""Bodies from a CPPN: the network gives the type and the orientation of the module at each slot.

As in revolve2's modular_robot_body_cppn: bodies grow outward from the core, nearest slots first, up
to the largest number of modules. The network is evaluated at every free slot. Its inputs are 1, the
position of a module there (x, y, z, in steps of one module along the slots' directions, core frame)
and its distance from the core in modules. Its outputs are one score for no module and one for each
type, of which the highest wins, and the orientation in quarter turns, rounded. Modules that overlap
or exceed a bound are left out.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mjx_revolve.body.tree import Morphology
from mjx_revolve.genotypes.cppn import (
    CPPN,
    Connection,
    CPPNSettings,
    cross_cppns,
    draw_cppn,
    mutate_cppn,
    read_cppn,
)
from mjx_revolve.genotypes.genotype import Genotype, Space, make_genotype
from mjx_revolve.genotypes.growth import Growth
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.schema import read

# 1, x, y, z and the number of modules from the core: how the network numbers them.
_INPUTS = 5
_ONE, _DEPTH = -1, -5
# In a random network the score of "no module" rises by so much with each module from the core, so
# that limbs end at a random distance. A choice: without it, nine in ten bodies have the largest
# number of modules, as some limb hardly ever ends.
_SLOPE = 3.0
_DISTANCES = 1.0, 4.0


def make_cppn(space: Space, params: Mapping[str, object], place: str) -> Genotype[CPPN]:
    """CPPNs over the positions of modules; no body can be converted to a genome.

    Args:
        space: of the bodies.
        params: fields of `CPPNSettings`.
        place: where they were given, for messages.

    Raises:
        InputError: a parameter is wrong.
    """
    settings = read(CPPNSettings, dict(params), f"{place}.params")
    outputs = 2 + len(space.modules)

    def from_plain(plain: object) -> CPPN:
        network = read_cppn(plain)
        found = (network.num_inputs, network.num_outputs)
        if found != (_INPUTS, outputs):
            ends = f"{_INPUTS} inputs and {outputs} outputs, for {outputs - 2} types of modules"
            raise InputError("genome", ends, f"{found[0]} and {found[1]}")
        return network

    return make_genotype(
        space,
        "cppn",
        place,
        draw=lambda rng: _draw(rng, outputs, settings),
        mutate=lambda rng, network: mutate_cppn(rng, network, settings),
        cross=lambda rng, a, b: cross_cppns(rng, a, b, settings),
        develop=lambda network: grow(network, space),
        to_plain=CPPN.to_plain,
        from_plain=from_plain,
    )


def _draw(rng: np.random.Generator, outputs: int, settings: CPPNSettings) -> CPPN:
    """A random network, biased so that limbs end."""
    network = draw_cppn(rng, _INPUTS, outputs, settings)
    more = {_ONE: -_SLOPE * float(rng.uniform(*_DISTANCES)), _DEPTH: _SLOPE}
    wanted = [(source, 0) for source in more]
    links = [
        link._replace(weight=link.weight + more.pop(link.source)) if link[:2] in wanted else link
        for link in network.links
    ]
    # A node may have split one of them.
    links += [Connection(source, 0, weight) for source, weight in more.items()]
    return network._replace(links=tuple(links))


def grow(network: CPPN, space: Space) -> Morphology:
    """The body that a network of 5 inputs and 2 + n outputs, for n types of modules, describes."""
    growth = Growth(space)
    places = [[0.0, 0.0, 0.0]]
    wave = [(0, slot) for slot in growth.modules[0].kind.slots]
    depth = 1.0
    while wave and not growth.is_full:
        slots_at = []
        for parent, slot in wave:
            step = growth.direction(parent, slot)
            slots_at.append([a + b for a, b in zip(places[parent], step, strict=True)])
        # Of weights near the largest number, outputs may be infinite.
        inputs = np.array([[1.0, *place, depth] for place in slots_at])
        found = np.nan_to_num(network.evaluate(inputs))
        best = found[:, :-1].argmax(axis=1).tolist()
        turns = np.rint(found[:, -1]).tolist()
        after = []
        # The surest first, so that where two overlap, no side is preferred by the slots' numbers.
        margin = found[:, :-1].max(axis=1) - found[:, 0]
        for k in np.argsort(-margin, kind="stable").tolist():
            if best[k] == 0:
                continue
            (parent, slot), kind = wave[k], space.kinds[best[k] - 1]
            index = growth.attach(parent, slot, kind, 90.0 * (turns[k] % 4.0))
            if index is not None:
                places.append(slots_at[k])
                after += [(index, number) for number in kind.slots]
        wave, depth = after, depth + 1.0
    return growth.finish("robot")
