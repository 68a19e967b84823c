"""CPPN: a network says for each place around the core which module is there, and how it is turned.

As in revolve2's `modular_robot_body_cppn`: bodies grow outward from the core, nearest places first,
up to the most modules that there may be. The network is asked for every free slot: 1, where a
module there would be (x, y, z, in steps of one module along the slots' directions, core frame) and
how many modules lead to it. Its outputs are a score for no module and for each type, of which the
highest counts, and the turn in quarters, rounded. What overlaps or exceeds a bound is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_revolve.body.tree import Morphology
from mjx_revolve.genotypes.genotype import (
    Genotype,
    Space,
    check_within,
    draw_within,
    remember,
    vary_within,
)
from mjx_revolve.genotypes.growth import Growth
from mjx_revolve.genotypes.network import (
    Network,
    NetworkSettings,
    cross_networks,
    draw_network,
    mutate_network,
    read_network,
)
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.schema import read

# 1, x, y, z and the number of modules from the core: how the network numbers them.
_INPUTS = 5
_ONE, _DEPTH = -1, -5
# In a random network the score of no module rises by so much more with each module from the core,
# and comes to lead at a random distance. A choice: without it, nine in ten bodies fill all the room
# that there is, as some way out of the core hardly ever ends.
_SLOPE = 3.0
_DISTANCES = 1.0, 4.0


def make_cppn(space: Space, params: Mapping[str, Any], place: str) -> Genotype:
    """The genotype of networks over the places of modules.

    Args:
        space: the bodies that there may be.
        params: fields of `NetworkSettings`.
        place: where they were given, for messages.

    Returns:
        The genotype; its genomes are networks. It can adopt no body.

    Raises:
        InputError: a parameter is wrong.
    """
    settings = read(NetworkSettings, dict(params), f"{place}.params")
    outputs = 2 + len(space.modules)

    develop = remember(lambda network: grow(network, space))

    def from_plain(plain: Any) -> Network:
        network = read_network(plain, "genome")
        found = (network.num_inputs, network.num_outputs)
        if found != (_INPUTS, outputs):
            raise InputError(
                f"genome: expected {_INPUTS} inputs and {outputs} outputs, for {outputs - 2} types "
                f"of modules; found {found[0]} and {found[1]}"
            )
        check_within(space, develop(network))
        return network

    return Genotype(
        name="cppn",
        random=lambda rng: draw_within(
            space, develop, lambda: _draw(rng, outputs, settings), place
        ),
        mutate=lambda rng, network: vary_within(
            space, develop, lambda: mutate_network(rng, network, settings), network
        ),
        cross=lambda rng, a, b: vary_within(
            space, develop, lambda: cross_networks(rng, a, b, settings), a
        ),
        develop=develop,
        adopt=None,
        to_plain=Network.to_plain,
        from_plain=from_plain,
    )


def _draw(rng: np.random.Generator, outputs: int, settings: NetworkSettings) -> Network:
    """A random network whose bodies end somewhere."""
    network = draw_network(rng, _INPUTS, outputs, settings)
    more = {_ONE: -_SLOPE * float(rng.uniform(*_DISTANCES)), _DEPTH: _SLOPE}
    links = [
        link._replace(weight=link.weight + more.get(link.source, 0.0)) if link.target == 0 else link
        for link in network.links
    ]
    return network._replace(links=tuple(links))


def grow(network: Network, space: Space) -> Morphology:
    """The body that a network describes.

    Args:
        network: with 5 inputs and, for n types of modules, 2 + n outputs.
        space: whose upper bounds are kept.

    Returns:
        The body.
    """
    growth = Growth(space)
    places = [[0.0, 0.0, 0.0]]
    wave = [(0, slot) for slot in growth.modules[0].kind.slots]
    depth = 1.0
    while wave and not growth.is_full:
        asked = []
        for parent, slot in wave:
            step = growth.direction(parent, slot)
            asked.append([a + b for a, b in zip(places[parent], step, strict=True)])
        found = network.evaluate(np.array([[1.0, *place, depth] for place in asked]))
        best = found[:, :-1].argmax(axis=1).tolist()
        turns = np.rint(found[:, -1]).tolist()
        after = []
        for (parent, slot), place, which, turn in zip(wave, asked, best, turns, strict=True):
            if which == 0:
                continue
            kind = space.kinds[which - 1]
            index = growth.attach(parent, slot, kind, 90.0 * (turn % 4.0))
            if index is not None:
                places.append(place)
                after += [(index, number) for number in kind.slots]
        wave, depth = after, depth + 1.0
    return growth.finish("robot")
