"""What all genotypes promise: bodies that are valid, within bounds, and that files give back."""

import json
from dataclasses import replace
from itertools import pairwise
from statistics import median

import numpy as np
import pytest
import yaml

from laboratory import OURS, ROOT, WILD, refusal, tree
from mjx_revolve.body.catalogue import MODULES, load_modules
from mjx_revolve.body.morphology import load_morphology, make_morphology
from mjx_revolve.body.placement import find_overlaps
from mjx_revolve.episodes import bodies_config
from mjx_revolve.genotypes.genotype import TRIES, Space, accept_all, make_space
from mjx_revolve.genotypes.kinds import find_genotype
from mjx_revolve.genotypes.table import GENOTYPES
from mjx_revolve.inputs.errors import InputError

ROBOTS = [*OURS, *WILD]
ALL = ("FixedBrick", "ActiveHinge", "TouchSensor", "Fin", "Thruster", "LiftThruster")
SPACES = {
    "bricks and hinges": make_space(bodies_config.BodiesConfig(), MODULES),
    "all modules": make_space(
        bodies_config.BodiesConfig(modules=ALL, max_modules=12, max_hinges=5), MODULES
    ),
    "tight": make_space(
        bodies_config.BodiesConfig(
            modules=ALL, min_modules=4, max_modules=9, min_hinges=2, max_hinges=3, max_length=0.3,
            max_mass=0.18, max_of={"Thruster": 1},
        ),
        MODULES,
        accepts=lambda body: sum(m.type == "Fin" for m in body.modules) <= 1,
    ),
}  # fmt: skip
# Genomes of each kind in each space; with mutants and children three times as many bodies.
COUNT = 120

pairs = pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
kinds = pytest.mark.parametrize("name", GENOTYPES)


def make(name, space, **params):
    return find_genotype(name, space, params, "test.yaml")


@pytest.fixture(scope="module")
def families():
    """For each kind and space: the genotype, parents, mutants, and children of neighbours."""
    found = {}

    def family(name, space):
        key = (name, id(space))
        if key not in found:
            genotype, rng = make(name, space), np.random.default_rng(7)
            parents = [genotype.random(rng) for _ in range(COUNT)]
            mutants = [genotype.mutate(rng, parent) for parent in parents]
            others = parents[1:] + parents[:1]
            children = [genotype.cross(rng, *two) for two in zip(parents, others, strict=True)]
            found[key] = genotype, parents, mutants, children
        return found[key]

    return family


def places(body):
    """Type and turn of each module by its slots from the core."""
    core = ((), body.modules[0].type, body.modules[0].orientation)
    return {path: (kind, turn % 360) for path, kind, turn in (core, *tree(body))}


def distance(a, b):
    """At how many places two bodies differ."""
    one, other = places(a), places(b)
    return sum(one.get(path) != other.get(path) for path in one.keys() | other.keys())


@pytest.mark.slow
@kinds
@pairs
def test_bodies_are_valid_and_in_the_space(families, name, space):
    genotype, *generations = families(name, space)
    for genome in (genome for generation in generations for genome in generation):
        body = genotype.develop(genome)
        assert space.refuses(body) is None
        assert find_overlaps(body.modules) == () == body.overlaps
        assert space.min_modules <= body.num_modules <= space.max_modules
        assert space.min_hinges <= body.num_hinges <= space.max_hinges
        assert body.length <= (space.max_length or np.inf) + 1e-9
        assert body.mass <= (space.max_mass or np.inf) + 1e-9
        assert {m.type for m in body.modules[1:]} <= {*space.modules}
        types = [m.type for m in body.modules]
        assert all(types.count(name) <= most for name, most in space.max_of.items())
        assert len({m.name for m in body.modules}) == body.num_modules
        # Laid out as a file's would be, in the same order.
        assert make_morphology(body.to_mapping()) == body


@pytest.mark.slow
@kinds
@pairs
def test_genomes_come_back_from_json(families, name, space):
    genotype, *generations = families(name, space)
    for genome in (genome for generation in generations for genome in generation[::2]):
        again = genotype.from_plain(json.loads(json.dumps(genotype.to_plain(genome))))
        assert again == genome
        assert genotype.develop(again) == genotype.develop(genome)


@kinds
def test_same_generator_same_children(name):
    genotype = make(name, SPACES["all modules"])

    def lives(seed):
        rng = np.random.default_rng(seed)
        a, b = genotype.random(rng), genotype.random(rng)
        return a, b, genotype.mutate(rng, a), genotype.cross(rng, a, b), rng.random()

    assert lives(3) == lives(3)
    assert lives(3) != lives(4)


@kinds
def test_mutation_is_local_and_does_something(families, name):
    """Half of the mutants differ by two modules at most, in number and in place."""
    genotype, parents, mutants, _ = families(name, SPACES["bricks and hinges"])
    lines = [*zip(parents, mutants, strict=True)]
    pairs = [(genotype.develop(a), genotype.develop(b)) for a, b in lines]
    assert median(abs(a.num_modules - b.num_modules) for a, b in pairs) <= 2
    changes = [distance(a, b) for a, b in pairs]
    assert median(changes) <= 2
    assert np.mean([change > 0 for change in changes]) > 0.2
    assert sum(a != b for a, b in lines) > 0.9 * COUNT


@kinds
def test_children_have_something_of_both(families, name):
    """Most children are near their parents, and many are neither of them."""
    genotype, parents, _, children = families(name, SPACES["bricks and hinges"])
    bodies = [genotype.develop(genome) for genome in parents]
    near, new = 0, 0
    for k, child in enumerate(map(genotype.develop, children)):
        a, b = bodies[k], bodies[(k + 1) % COUNT]
        near += min(distance(child, a), distance(child, b)) < distance(a, b)
        new += child.modules not in (a.modules, b.modules)
    assert near > 0.6 * COUNT and new > 0.2 * COUNT


@kinds
def test_modules_that_stay_in_their_place_keep_their_names(families, name):
    genotype, parents, mutants, _ = families(name, SPACES["bricks and hinges"])
    kept = lost = 0
    for parent, mutant in zip(parents, mutants, strict=True):
        before, after = genotype.develop(parent), genotype.develop(mutant)
        names = dict(zip(places(before), (m.name for m in before.modules), strict=True))
        for path, module in zip(places(after), after.modules, strict=True):
            if path in names and places(before)[path] == places(after)[path]:
                kept += names[path] == module.name
                lost += names[path] != module.name
    assert kept > 500 and lost < 0.02 * kept


@kinds
def test_variation_that_never_fits_gives_the_parent_back(name):
    open_space = SPACES["bricks and hinges"]
    rng = np.random.default_rng(0)
    a, b = (make(name, open_space).random(rng) for _ in range(2))
    looks = []
    closed = make(name, replace(open_space, accepts=lambda body: bool(looks.append(body))))
    assert closed.mutate(rng, a) is a and 0 < len(looks) <= TRIES
    assert closed.cross(rng, a, b) is a


def test_the_space_says_what_it_refuses():
    space = SPACES["tight"]
    spider = load_morphology("spider")
    assert space.refuses(spider) == "expected 4 to 9 modules; found 17"
    loose = replace(space, max_modules=20, accepts=accept_all)
    assert loose.refuses(spider) == "expected 2 to 3 hinges; found 8"
    loose = replace(loose, max_hinges=8)
    assert loose.refuses(spider) == "expected at most 0.18 kg (max_mass); found 0.2572"
    loose = replace(loose, max_mass=0.2572)
    assert loose.refuses(spider) == "expected at most 0.3 m (max_length); found 0.3991"
    loose = replace(loose, max_length=0.3991)
    assert loose.refuses(spider) is None
    few = replace(loose, max_of={"FixedBrick": 7})
    assert few.refuses(spider) == "expected at most 7 FixedBrick (max_of); found 8"
    assert replace(loose, accepts=lambda body: False).refuses(spider) is not None
    bare = replace(loose, catalogue={"Core": MODULES["Core"]})
    assert "found 'ActiveHinge'" in bare.refuses(spider)


def test_spaces_are_made_of_types_that_there_are():
    config = bodies_config.BodiesConfig

    def refused(**settings):
        return refusal(make_space, config(**settings), MODULES)

    assert refused(modules=("FixedBrick", "Brick")).startswith(
        "bodies.modules.1: expected one of ActiveHinge, Fin, FixedBrick, "
    )
    assert refused(modules=("Core", "ActiveHinge")).endswith("found 'Core'")
    assert refused(core="FixedBrick") == (
        "bodies.core: expected one of BlueROV2, Core, CoreComponent; found 'FixedBrick'"
    )
    assert refused(modules=("TouchSensor", "ActiveHinge", "FixedBrickSensor")) == (
        "bodies.modules.2: expected each type once; found 'TouchSensor' again"
    )
    assert refused(modules=("FixedBrick",)).startswith("bodies.modules: expected a type with a hin")
    assert refused(max_of={"Fin": 1}) == (
        "bodies.max_of: expected any of bodies.modules, FixedBrick, ActiveHinge; found Fin"
    )
    aliased = make_space(config(modules=ALL, max_of={"FixedBrickSensor": 1}), MODULES)
    assert aliased.max_of == {"TouchSensor": 1}
    bricks = make_space(config(modules=("FixedBrick",), min_hinges=0), MODULES)
    assert bricks.modules == ("FixedBrick",)


# A type whose slots look in directions that are not the core's axes, so that boxes stand askew.
FORK = """
modules:
  Fork:
    mount: -x
    parts:
      - {size: [0.03, 0.03, 0.02], mass: 0.01}
    slots:
      1: {position: [0.015, 0.01, 0], direction: [1, 0.7, 0]}
      2: {position: [0.015, -0.01, 0], direction: [1, -0.7, 0]}
      4: {position: [0.0, 0.0, 0.01], direction: [0, 0, 1], up: [1, 0, 0]}
"""


@kinds
def test_users_own_types_grow_too(tmp_path, name):
    (tmp_path / "fork.yaml").write_text(FORK)
    catalogue = MODULES | load_modules(tmp_path / "fork.yaml")
    settings = bodies_config.BodiesConfig(modules=("Fork", "ActiveHinge"), max_modules=20)
    space = make_space(settings, catalogue)
    genotype, rng = make(name, space), np.random.default_rng(2)
    askew = 0
    for _ in range(40):
        genome = genotype.mutate(rng, genotype.random(rng))
        body = genotype.develop(genome)
        assert find_overlaps(body.modules) == ()
        assert make_morphology(body.to_mapping(), catalogue) == body
        assert genotype.from_plain(json.loads(json.dumps(genotype.to_plain(genome)))) == genome
        slots = {m.slot for m in body.modules if body.modules[m.parent].type == "Fork"}
        askew += bool(slots & {1, 2}) and 4 in slots
    assert askew > 5


def adopters():
    return [name for name in GENOTYPES if make(name, SPACES["tight"]).adopt is not None]


def wide():
    return Space(MODULES, ALL, "Core", 1, 40, 0, 30)


@pytest.mark.parametrize("name", adopters())
@pytest.mark.parametrize("path", ROBOTS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_any_robot_can_be_adopted(name, path):
    """Exactly as it is, and it varies."""
    genotype, body = make(name, wide()), load_morphology(path)
    genome = genotype.adopt(body)
    grown = genotype.develop(genome)
    assert grown == replace(body, brain=None) and grown.overlaps == ()
    assert genotype.adopt(grown) == genome
    again = genotype.from_plain(json.loads(json.dumps(genotype.to_plain(genome))))
    assert again == genome and genotype.develop(again) == grown
    rng = np.random.default_rng(5)
    mutants = [genotype.develop(genotype.mutate(rng, genome)) for _ in range(30)]
    assert {m.name for m in mutants} == {body.name}
    assert median(distance(mutant, body) for mutant in mutants) <= 4
    heirs = [genome]
    while genotype.develop(heirs[-1]).modules == body.modules and len(heirs) < 200:
        heirs.append(genotype.mutate(rng, heirs[-1]))
    assert len(heirs) < 200
    # Most joints are still known by their names.
    joints = {body.modules[i].name for i in body.hinges}
    shares = [len(joints & {m.name for m in mutant.modules}) for mutant in mutants]
    assert median(shares) >= 0.7 * len(joints)
    child = genotype.develop(genotype.cross(rng, genome, genotype.random(rng)))
    assert wide().refuses(child) is None and child.name == body.name


@kinds
def test_settings_are_checked(name):
    with pytest.raises(InputError, match=r"test.yaml: bodies.params.colour: expected one of"):
        make(name, SPACES["tight"], colour="red")


@kinds
@pytest.mark.parametrize("plain", [None, [], {}, "C", {"body": 3}, {"rules": {"C": ["C", "X"]}}])
def test_damaged_genomes_are_refused(name, plain):
    with pytest.raises(InputError, match="genome"):
        make(name, SPACES["tight"]).from_plain(plain)


@kinds
def test_genomes_of_another_space_are_refused(families, name):
    genotype, parents, *_ = families(name, SPACES["bricks and hinges"])
    large = next(g for g in parents if genotype.develop(g).num_hinges > 3)
    narrow = make(name, replace(SPACES["bricks and hinges"], min_modules=2, max_hinges=3))
    rebuilt = None
    try:
        rebuilt = narrow.from_plain(genotype.to_plain(large))
    except InputError as error:
        assert "genome" in str(error) or "hinges" in str(error)
    if rebuilt is not None:  # it grows less where there is less room
        assert narrow.develop(rebuilt).num_hinges <= 3


PAGE = (ROOT / "docs" / "evolution.md").read_text(encoding="utf-8")
PAGE = PAGE.split("\n## Genotypes\n")[1].split("\n## Selection\n")[0]


def block(language):
    """The page's first block of a language."""
    return PAGE.split(f"```{language}\n", 1)[1].split("```", 1)[0]


@pytest.fixture
def worms(tmp_path):
    (tmp_path / "worms.py").write_text(block("python"))
    return f"{tmp_path}/worms.py:worm"


def test_the_pages_own_genotype_works(worms):
    space = SPACES["bricks and hinges"]
    genotype = find_genotype(worms, space, {"name": "wurm"}, "test.yaml")
    rng = np.random.default_rng(0)
    genomes = [genotype.random(rng) for _ in range(50)]
    for a, b in pairwise(genomes):
        body = genotype.develop(genotype.mutate(rng, genotype.cross(rng, a, b)))
        assert space.refuses(body) is None
        assert (body.name, body.num_hinges + 1) == ("wurm", body.num_modules)


def test_the_pages_configuration_is_one():
    settings = bodies_config.BodiesConfig.model_validate(yaml.safe_load(block("yaml")))
    space = make_space(settings, MODULES)
    assert space.modules == ("FixedBrick", "ActiveHinge", "TouchSensor", "Fin")
    for name in GENOTYPES:
        body = make(name, space).develop(make(name, space).random(np.random.default_rng(0)))
        assert space.refuses(body) is None
