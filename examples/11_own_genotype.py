"""A genotype of one's own: worms with one bit for each joint, evolved with their brains."""

import sys

from mjx_revolve import make_morphology
from mjx_revolve.genotypes import Genotype


def worm(space, params):
    """Bit k says whether joint k bends sideways."""
    shortest = max(1, space.min_hinges, space.min_modules - 1)
    longest = min(space.max_hinges, space.max_modules - 1)

    def random(rng):  # a numpy.random.Generator
        return rng.integers(2, size=int(rng.integers(shortest, longest + 1))).tolist()

    def mutate(rng, bits):
        k = int(rng.integers(len(bits)))
        return [*bits[:k], 1 - bits[k], *bits[k + 1 :]]

    def cross(rng, a, b):
        k = int(rng.integers(min(len(a), len(b))))
        return [*a[:k], *b[k:]]

    def develop(bits):
        tail = {}
        for k in reversed(range(len(bits))):
            joint = {"id": f"joint{k}", "type": "ActiveHinge", "orientation": 90 * bits[k]}
            tail = {1: joint | {"children": tail}}
        core = {"id": "head", "type": space.core, "children": tail}
        return make_morphology({"id": "worm", "body": core}, space.catalogue)

    return Genotype("worm", random, mutate, cross, develop, None, to_plain=list, from_plain=list)


if __name__ == "__main__":
    from mjx_revolve.evolve import main

    settings = {
        "bodies.genotype": f"{__file__}:worm",
        "bodies.modules": "[ActiveHinge]",
        "bodies.max_hinges": 4,
        "evolution.population_size": 4,
        "evolution.generations": 2,
        "task.duration": 3,
        "task.horizon": "null",
        "task.settle": 1,
        "task.trials": 1,
        "evolution.passport": "false",  # so short a run finds nothing to judge
        "bodies.selection.passport": "made",
    }
    arguments = [f"--set={key}={value}" for key, value in settings.items()]
    sys.exit(main(["lake_coevolve", "--out", "worms", *arguments]))
