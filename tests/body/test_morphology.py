"""Robots from files: rest pose, masses, round trips, wild and wrong files, descriptors."""

import math
import pickle
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from laboratory import OURS, ROOT, WILD, body, check_refused, refusal, world, write
from mjx_revolve.body.catalogue import MODULES, THESIS_MODULES, LiftDrag, load_modules
from mjx_revolve.body.coefficients import read_morphology_files
from mjx_revolve.body.exposure import exposure
from mjx_revolve.body.morphology import (
    MAX_MODULES,
    Morphology,
    load_morphology,
    make_morphology,
    save_morphology,
    trim_neutral,
)
from mjx_revolve.body.table import summary
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.inputs.errors import InputError

WATER = 999.1026  # kg/m³, the thesis's


def read(folder: Path, text: str, **options) -> Morphology:
    return load_morphology(write(folder, text), **options)


# Read off Revolve's own SDF of the spider: metres along a leg from the core's centre.
FIRST_FRAME, FIRST_AXIS, FIRST_SERVO, FIRST_PLATE = 0.0555, 0.06015, 0.071025, 0.082775
FIRST_BRICK, SECOND_FRAME, SECOND_AXIS, SECOND_BRICK = 0.102275, 0.132275, 0.136925, 0.17905
LEGS = {0: (0, -1, 0), 1: (0, 1, 0), 2: (1, 0, 0), 3: (-1, 0, 0)}


@pytest.fixture(params=["ours", "Revolve's"])
def spider(request) -> Morphology:
    if request.param == "ours":
        return body("spider")
    for path in WILD:
        if path.stem == "spider":
            return load_morphology(path)
    pytest.skip("Revolve's own robots (../shared/revolve_robots) are not on this machine")


def leg(morphology: Morphology, slot: int) -> list:
    """Modules of one leg from the core outwards."""
    index = next(i for i, m in enumerate(morphology.modules) if m.parent == 0 and m.slot == slot)
    return list(morphology.modules[index : index + 4])


@pytest.mark.parametrize("slot", LEGS)
def test_spider_lies_where_revolve_puts_it(spider, slot):
    along = np.array(LEGS[slot], float)
    hip, thigh, knee, foot = leg(spider, slot)

    def at(distance):
        return pytest.approx(distance * along, abs=1e-6)

    assert hip.position == at(FIRST_FRAME)
    assert thigh.position == at(FIRST_BRICK)
    assert knee.position == at(SECOND_FRAME)
    assert foot.position == at(SECOND_BRICK)
    assert hip.position + hip.rotation @ hip.kind.hinge.anchor == at(FIRST_AXIS)
    assert knee.position + knee.rotation @ knee.kind.hinge.anchor == at(SECOND_AXIS)
    servo = hip.position + hip.rotation @ hip.kind.parts[1].position
    assert servo == at(FIRST_SERVO)
    plate = servo + hip.rotation @ hip.kind.parts[1].boxes[1].position
    assert plate @ along == pytest.approx(FIRST_PLATE, abs=1e-6)


@pytest.mark.parametrize("slot", LEGS)
def test_spider_hips_are_vertical_and_knees_across_the_leg(spider, slot):
    along = np.array(LEGS[slot], float)
    hip, thigh, knee, foot = leg(spider, slot)
    assert hip.rotation @ hip.kind.hinge.axis == pytest.approx([0, 0, 1])
    across = knee.rotation @ knee.kind.hinge.axis
    assert across[2] == pytest.approx(0) and across @ along == pytest.approx(0)
    for module, forward in ((hip, 0), (thigh, 1), (knee, 0), (foot, 1)):
        assert module.rotation[:, forward] == pytest.approx(along)
        assert np.linalg.det(module.rotation) == pytest.approx(1.0)
    assert thigh.rotation[:, 2] == pytest.approx([0, 0, 1])


def test_thesis_masses_move_between_links_only():
    path = ROOT / "morphologies" / "spider.yaml"
    thesis = load_morphology(path, modules=THESIS_MODULES)
    assert thesis.mass == pytest.approx(0.2572, abs=1e-12)
    assert thesis.volume == body("spider").volume
    masses = [0.0119] * 4 + [0.0209] * 4 + [0.126]
    assert sorted(build_robot(thesis, world()).assembly.mass[1:]) == pytest.approx(masses)
    assert thesis != body("spider")


def test_spider_hinges_share_links(spider):
    hinges, pairs = spider.hinges, spider.hinge_neighbours()
    assert [spider.modules[i].kind.hinge is not None for i in hinges] == [True] * 8
    # Order along the file: hip, knee, hip, knee ...
    hips = [(i, j) for i in (0, 2, 4, 6) for j in (0, 2, 4, 6) if i < j]
    assert pairs == tuple(sorted([*hips, (0, 1), (2, 3), (4, 5), (6, 7)]))
    assert len(pairs) == 10


def test_hinge_neighbours_of_a_chain_and_of_none():
    assert body("core").hinge_neighbours() == ()
    snake = body("snake")
    assert len(snake.hinge_neighbours()) == 7  # eight in a row, the core's link in the middle


@pytest.mark.parametrize("path", OURS, ids=lambda p: p.stem)
def test_our_robots_load_save_and_have_colours_and_names(path, tmp_path):
    robot = load_morphology(path)
    check_round_trip(robot, tmp_path)
    assert make_morphology(yaml.safe_load(path.read_text())) == robot
    assert robot.name == path.stem
    assert robot.overlaps == ()
    assert all(m.rgb is not None for m in robot.modules)
    assert not any(m.name.startswith(m.type) for m in robot.modules)


LOOSE = """---
id: 7
body:
  id: 1
  type: CoreComponent
  orientation: null
  params: {red: 0.04, green: 1;, blue: "0.707;"}
  children:
    '1':
      slot: 0
      type: ActiveHinge
      orientation: 90.0
      children:
        1: {type: FixedBrick, id: Leg, orientation: -90, params: null}
    3:
      slot: 3
      id: Leg
      type: FixedBrick
      params: {mass: "0.02,", note: kept;, "lift;": 3}
    0: {type: FixedBrickSensor, id: world}
brain: [neurons, 1e-3]
"""


def test_loose_spellings_are_understood(tmp_path, caplog):
    robot = read(tmp_path, LOOSE)
    assert caplog.messages[0].endswith(
        ": ids that repeat, or that MuJoCo needs, are changed: Leg is now Leg_2, world is now "
        "world_2"
    )
    assert robot.name == "7"
    assert [m.name for m in robot.modules] == ["1", "ActiveHinge1", "Leg", "Leg_2", "world_2"]
    assert [m.slot for m in robot.modules] == [-1, 1, 1, 3, 0]
    assert [m.parent for m in robot.modules] == [-1, 0, 1, 0, 0]
    assert [m.orientation for m in robot.modules] == [0.0, 90.0, -90.0, 0.0, 0.0]
    assert robot.modules[0].rgb == (0.04, 1.0, 0.707)
    assert robot.modules[1].rgb is None
    assert robot.modules[3].kind.mass == 0.02
    assert robot.modules[3].params == {"mass": 0.02, "note": "kept;", "lift;": 3}
    assert robot.modules[4].type == "TouchSensor"
    assert robot.brain == ["neurons", 1e-3]


def test_overrides_change_a_module(tmp_path):
    text = """
body:
  type: Core
  params: {mass: 0.2, volume: 1e-4, electronics_volume: 2e-5, ballast: 0.05}
  children:
    1:
      type: ActiveHinge
      params: {mass: 0.0214, volume: 2.6344e-5, electronics_volume: 1e-6, ballast: 0.001}
      children: {1: {type: FixedBrick, params: {mass: 0}}}
"""
    core, hinge, brick = read(tmp_path, text).modules
    assert core.kind.mass == pytest.approx(0.25)
    assert core.kind.volume == pytest.approx(1.2e-4)
    frame, servo = hinge.kind.parts  # doubled, in the catalogue's proportion
    assert (frame.mass, servo.mass) == pytest.approx((2 * 0.0017 + 0.001, 2 * 0.0090))
    assert (frame.volume, servo.volume) == pytest.approx((2 * 3.032e-6, 2 * 1.014e-5))
    assert (frame.electronics_volume, servo.electronics_volume) == (0.0, 1e-6)
    assert brick.kind.mass == 0.0
    assert MODULES["Core"].mass == 0.09


def test_fitted_coefficients_count_once_and_come_back_from_a_file(tmp_path):
    entries = "modules: {all: {ballast: 0.01}, Core: {ballast: 0.02, factors: {mass: 1.2}}}"
    (tmp_path / "fits").mkdir()
    (tmp_path / "fits" / "fit.yaml").write_text(entries)
    text = "coefficients: %s\nbody: {type: CoreComponent, id: %s, params: {ballast: 0.05}}"
    (tmp_path / "robots").mkdir()
    for name in ("Core", "c"):
        path = tmp_path / "robots" / f"{name}.yaml"
        path.write_text(text % ("../fits/fit.yaml", name))
        robot = load_morphology(path)
        assert robot.mass == pytest.approx((0.09 + 0.05 + 0.01 + 0.02) * 1.2)
        assert make_morphology(robot.to_mapping()).mass == pytest.approx(robot.mass)
        for place, content in read_morphology_files(path).items():
            assert ".." not in place
            (tmp_path / place).write_bytes(content)
        assert load_morphology(tmp_path / path.name).mass == robot.mass
    # Whatever of its mass a module has of its own, the saved robot is the one that was read.
    for own, entry in (("factors: {mass: 2}", "ballast: 0.01"), ("ballast: 0.02", "mass: 0.05"),
                       ("factors: {mass: 2}", "factors: {drag: 2, added_mass: 3}")):  # fmt: skip
        (tmp_path / "own.yaml").write_text(f"modules: {{all: {{{entry}}}}}")
        text = f"coefficients: own.yaml\nbody: {{type: Core, params: {{{own}}}}}"
        robot = read(tmp_path, text)
        again = pickle.loads(pickle.dumps(robot))
        assert robot == make_morphology(robot.to_mapping() | {"id": robot.name})
        assert again.modules[0].base == MODULES["Core"] and again == robot


def test_ballast_without_a_place_is_spread_and_with_one_is_a_point(tmp_path):
    text = "body: {type: Core, params: {mass: 0.1, volume: 1e-4, ballast: 0.1%s}}"
    (spread,) = read(tmp_path, text % "").modules[0].kind.parts
    assert (spread.mass, spread.ballast_mass) == (0.2, 0.0)
    (placed,) = read(tmp_path, text % ", ballast_position: [0, 0, -0.02]").modules[0].kind.parts
    assert (placed.mass, placed.ballast_mass, placed.ballast_volume) == (0.1, 0.1, 0.0)
    robot = read(tmp_path, text % ", ballast_position: [0, '.01;', -0.02], ballast_volume: 1e-4")
    (part,) = robot.modules[0].kind.parts
    assert part.ballast_position == (0.0, 0.01, -0.02)
    assert robot.mass == part.total_mass == pytest.approx(0.2)
    assert robot.volume == part.total_volume == pytest.approx(2e-4)
    assert robot.center_of_mass == pytest.approx([0.0, 0.005, -0.01])
    assert robot.center_of_volume == pytest.approx([0.0, 0.005, -0.01])


def test_centres_are_those_of_all_parts_at_rest(tmp_path):
    text = """
body:
  type: Core
  params: {electronics_volume: 2e-5, center_of_volume: [0.01, 0, 0.002]}
  children:
    2:
      type: ActiveHinge
      orientation: 90
      params: {ballast: 0.01, ballast_position: [0, 0.01, 0.002], center_of_volume: [0, 0, 0.001]}
"""
    robot = read(tmp_path, text)
    # Along +x, turned by 90 degrees: the hinge's y is up and its z is -y.
    x, servo = 0.0555, 0.0555 + 0.015525
    mass = [(0.09, [0, 0, 0]), (0.0017, [x, 0, 0]), (0.01, [x, -0.002, 0.01])]
    mass.append((0.009, [servo, 0, 0]))
    volume = [(7.054e-5, [0.01, 0, 0.002]), (3.032e-6, [x, 0, 0]), (1.014e-5, [servo, -0.001, 0])]
    for found, rows in ((robot.center_of_mass, mass), (robot.center_of_volume, volume)):
        weight = np.array([w for w, _ in rows])
        assert found == pytest.approx(weight @ np.array([at for _, at in rows]) / weight.sum())
    assert robot.mass == pytest.approx(sum(w for w, _ in mass))
    assert robot.volume == pytest.approx(sum(w for w, _ in volume))


def test_laws_and_coefficients_of_a_module(tmp_path):
    text = """
body:
  type: Core
  params: {buoyancy: mask, drag: off, added_mass: off, entrained_water: "0.5;"}
  children:
    1:
      type: ActiveHinge
      params: {drag: ellipsoid, drag_coefficient: 2, added_mass_coefficient: 3}
    2: {type: FixedBrick, params: {lift_drag: {cla: 2.0}, coefficients: {friction: 0.02}}}
    3: {type: Fin, params: {lift_drag: {cla: 2.0}, drag: faces}}
"""
    robot = read(tmp_path, text)
    core, hinge, brick, fin = (module.kind.parts for module in robot.modules)
    (core,), (brick,), (fin,) = core, brick, fin
    assert (core.buoyancy, core.drag, core.added_mass) == ("mask", "off", False)
    assert core.entrained_water == 0.5
    for part in hinge:
        assert (part.drag, part.drag_coefficient) == ("ellipsoid", 2)
        assert part.added_mass_coefficient == 3
    assert (brick.lift_drag, brick.coefficients) == (LiftDrag(cla=2.0), (("friction", 0.02),))
    assert fin.lift_drag == replace(MODULES["Fin"].parts[0].lift_drag, cla=2.0)
    assert fin.drag == "faces"
    assert robot.num_fins == 2 and robot.descriptors["num_bricks"] == 0
    check_round_trip(robot, tmp_path)


def test_numbers_of_a_thruster(tmp_path):
    text = """
body:
  type: Core
  children:
    1:
      type: Thruster
      id: jet
      params: {thrust: 0.8, thruster: {axis: [0, 0, 2], range: [-1, 0.5]}}
    2: {type: LiftThruster, id: lift, params: {thruster: {torque_ratio: -0.002, time_constant: 0}}}
    3:
      type: Thruster
      id: line
      params:
        thrust: 3
        thruster:
          {curve: interpolated, gain: 1, commands: [-1, 0, 1], thrusts: [-0.5, 0, 1]}
"""
    robot = read(tmp_path, text)
    assert robot.thrusters == ((1, 0), (2, 0), (3, 0))
    assert (robot.num_thrusters, robot.num_hinges) == (3, 0)
    jet, lift, line = (robot.modules[i].kind.parts[k].thruster for i, k in robot.thrusters)
    assert jet.axis == (0.0, 0.0, 1.0) and jet.thrust_at(1.0) == pytest.approx(0.8)
    assert jet.gain == pytest.approx(3.2)  # full ahead is command .5
    assert (lift.torque_ratio, lift.time_constant, lift.gain) == (-0.002, 0.0, 0.5)
    assert line.thrusts == pytest.approx((-1.5, 0.0, 3.0))
    check_round_trip(robot, tmp_path)


def test_a_dead_band_is_scaled_on_both_sides(tmp_path):
    thruster = "{curve: dead_band, gain: 2, gain_backward: 1, dead_band: [-0.5, 0.5]}"
    text = "body: {type: Core, children: {1: {type: Thruster, params: {thrust: 4, thruster: %s}}}}"
    (part,) = read(tmp_path, text % thruster).modules[1].kind.parts
    assert (part.thruster.gain, part.thruster.gain_backward) == (8.0, 4.0)
    assert [part.thruster.thrust_at(x) for x in (-1, 0.7, 1)] == [-2.0, 0.0, 4.0]


@pytest.mark.parametrize("name", ["auv", "fish"])
def test_swimmers_with_ballast_are_neutral_level_and_upright(name):
    robot = body(name)
    assert robot.volume * WATER == pytest.approx(robot.mass, rel=1e-9)
    apart = robot.center_of_volume - robot.center_of_mass
    assert apart[:2] == pytest.approx([0, 0], abs=1e-7)
    assert apart[2] > 0.004


def test_trim_neutral(tmp_path):
    robot = body("spider")
    trimmed = trim_neutral(robot, WATER)
    assert trimmed.volume * WATER == pytest.approx(trimmed.mass, rel=1e-12)
    assert trimmed.mass == robot.mass and trimmed.modules[1:] == robot.modules[1:]
    added = trimmed.modules[0].kind.parts[0].electronics_volume
    assert added == pytest.approx(0.2572 / WATER - 2.41516e-4)
    assert trim_neutral(trimmed, WATER).volume == pytest.approx(trimmed.volume)
    # What the water does not lift is weight.
    brick = "{type: FixedBrick, params: {buoyancy: 'off'}}"
    dead = trim_neutral(read(tmp_path, f"body: {{type: Core, children: {{1: {brick}}}}}"), WATER)
    assert (dead.volume - dead.modules[1].kind.volume) * WATER == pytest.approx(dead.mass)
    assert "N (neutral)" in "\n".join(summary(dead, WATER, 9.81))
    # Salt water carries more: the electronics shrink.
    salt = trim_neutral(trimmed, 1025.0)
    assert salt.volume * 1025.0 == pytest.approx(salt.mass)
    trimmed.save(tmp_path / "trimmed.yaml")
    assert load_morphology(tmp_path / "trimmed.yaml") == trimmed != robot


def test_trim_neutral_refuses_what_floats(tmp_path):
    robot = read(tmp_path, "body: {type: Core, params: {mass: 0.01}}")
    with pytest.raises(InputError, match=r"found one that floats.*ballast of 0\.04049 kg would do"):
        trim_neutral(robot, WATER)
    check_refused("density: expected a number > 0", trim_neutral, robot, 0.0)


def check_round_trip(robot: Morphology, folder: Path, **options) -> None:
    save_morphology(robot, folder / "saved.yaml")
    again = load_morphology(folder / "saved.yaml", **options)
    assert again == robot
    assert again.path != robot.path
    again.save(folder / "twice.yaml")
    assert (folder / "twice.yaml").read_text() == (folder / "saved.yaml").read_text()


def test_odd_values_round_trip(tmp_path):
    text = """
id: "1e-3"
body:
  id: "12e4"
  type: Core
  params: {electronics_volume: 1e-05, text: "1e-3", nothing: null, list: [1, [2.5, .nan]]}
  children: {1: {id: "naïve: #\\n☃", type: FixedBrick}, 2: {id: "no", type: FixedBrick}}
brain: {a: "0x10", b: "1e5", c: 1.0e+20, d: .inf, e: "yes", f: 2001-01-01}
"""
    robot = read(tmp_path, text)
    assert [robot.name, *(m.name for m in robot.modules)] == ["1e-3", "12e4", "naïve: #\n☃", "no"]
    check_round_trip(robot, tmp_path)


def random_tree(rng: random.Random, size: int) -> dict:
    """A body of random modules; it may overlap with itself."""

    def module(kind):
        item = {"type": kind, "orientation": rng.choice([0, 90, 180, 270, -90])}
        if rng.random() < 0.7:
            item["id"] = rng.choice(["a", "b", f"m{rng.randrange(1000)}", rng.randrange(100)])
        params = {}
        if rng.random() < 0.5:
            params |= {c: round(rng.random(), rng.randrange(1, 17)) for c in ("red", "green")}
            params["blue"] = 1
        for key in ("mass", "volume", "electronics_volume", "ballast", "entrained_water"):
            if rng.random() < 0.2:
                params[key] = rng.uniform(1e-9, 0.1)
        if rng.random() < 0.2:
            params["ballast_position"] = [rng.uniform(-0.1, 0.1), 0, 1]
        if rng.random() < 0.2:
            params |= {"drag": rng.choice(["faces", False]), "added_mass": rng.random() < 0.5}
        return item | ({"params": params} if params else {})

    root = module("Core") | {"orientation": 0}
    free = [(root, slot) for slot in MODULES["Core"].slots]
    for _ in range(size - 1):
        if not free:
            break
        parent, slot = free.pop(rng.randrange(len(free)))
        kind = rng.choice(["FixedBrick", "ActiveHinge", "TouchSensor", "Thruster", "Fin"])
        child = module(kind)
        key = str(slot) if rng.random() < 0.5 else slot
        parent.setdefault("children", {})[key] = child
        free += [(child, s) for s in MODULES[kind].slots]
    return root


@pytest.mark.parametrize("seed", range(12))
def test_random_trees_round_trip(seed, tmp_path):
    rng = random.Random(seed)
    tree = random_tree(rng, 30)
    robot = read(tmp_path, yaml.safe_dump({"body": tree}, sort_keys=False), allow_overlap=True)
    check_round_trip(robot, tmp_path, allow_overlap=True)
    again = make_morphology(robot.to_mapping(), allow_overlap=True)
    assert again == robot and again.overlaps == robot.overlaps
    assert len({m.name for m in robot.modules}) == robot.num_modules
    for index, module in enumerate(robot.modules[1:], start=1):
        assert 0 <= module.parent < index  # depth first
        assert module.rotation.T @ module.rotation == pytest.approx(np.eye(3))
        parent = robot.modules[module.parent]
        slot, mount = parent.kind.slots[module.slot], module.kind.mount
        # Slot and mount meet, and look the same way.
        assert module.position + module.rotation @ mount.position == pytest.approx(
            parent.position + parent.rotation @ slot.position
        )
        assert module.rotation @ mount.outward == pytest.approx(parent.rotation @ slot.direction)
    assert all(math.isfinite(x) for x in robot.descriptors.values())


# A brick on each side of the core's front, and from one of them a chain that turns back into it.
RING = """
body: {type: Core, children: {1: {id: a, type: FixedBrick, children: {
  2: {id: b, type: FixedBrick, children: {
    2: {id: c, type: FixedBrick, children: {1: {id: d, type: FixedBrick}}}}}}}}}
"""


def test_overlapping_modules_are_named(tmp_path):
    assert refusal(read, tmp_path, RING) == (
        f"{tmp_path / 'robot.yaml'}: body: expected modules that do not overlap at rest; found "
        "overlapping: Core0 and c, Core0 and d (allow_overlap loads them all the same)"
    )
    assert read(tmp_path, RING, allow_overlap=True).overlaps == (("Core0", "c"), ("Core0", "d"))


def test_descriptors_of_the_spider(spider):
    found = spider.descriptors
    expected = {
        "num_modules": 17,
        "num_bricks": 8,
        "num_hinges": 8,
        "num_sensors": 0,
        "num_limbs": 4,
        "chain_length": 4,
        "limbs": 4 / (2 * 3 + 2 + 4),  # Miras et al.: 2 floor((m - 6)/3) + (m - 6) mod 3 + 4
        "length_of_limbs": 12 / 15,
        "branching": 1 / 5,  # the core alone; floor((17 - 2)/3)
        "joints": 8 / 15,
        "sensors": 0,
        "symmetry": 1,
        "proportion": 1,
    }
    assert {key: found[key] for key in expected} == pytest.approx(expected)
    assert found["mass"] == spider.mass
    assert found["coverage"] == pytest.approx(spider.box_volume / np.prod(spider.extent))


# Bodies by their children, and what counting by hand says of them.
COUNTED = {
    # Core, hinge, brick, hinge: m = 4.
    "a chain": (
        "1: {type: ActiveHinge, children: {1: {type: FixedBrick, children: "
        "{1: {type: ActiveHinge}}}}}",
        {"absolute_size": 4, "extensiveness": 2, "length_of_limbs": 2 / 2, "num_limbs": 1,
         "limbs": 1 / 3, "active_hinges_count": 1, "joints": 1 / 2, "branching_modules_count": 0,
         "branching": 0, "width": 1, "height": 4, "z_depth": 1, "base_density": 3 / 4,
         "height_base_ratio": 1 / 2, "bottom_layer": 0, "vertical_symmetry": 0},
    ),
    # A brick with bricks on all of its slots: a T in front of the core, m = 5.
    "a branching brick": (
        "1: {type: FixedBrick, children: {1: {type: FixedBrick}, 2: {type: FixedBrick}, "
        "3: {type: FixedBrick}}}",
        {"absolute_size": 5, "branching_modules_count": 1, "branching": 1 / 1, "num_limbs": 3,
         "limbs": 3 / 4, "extensiveness": 0, "length_of_limbs": 0, "width": 3, "height": 3,
         "z_depth": 1, "base_density": 4 / 9, "height_base_ratio": 1 / 3, "symmetry": 1},
    ),
    # Of three modules off the xy plane, two have an image: the third is a hinge on one of them.
    "more below": (
        "1: {type: FixedBrick, orientation: 90, children: {2: {type: FixedBrick, children: "
        "{1: {type: ActiveHinge}}}, 3: {type: FixedBrick}}}",
        {"vertical_symmetry": 2 / 3, "z_depth": 4, "extensiveness": 1},
    ),
    # Sensors: no size, no cells, and no burden for a hinge.
    "sensors": (
        "1: {type: ActiveHinge, children: {1: {type: TouchSensor}}}, 2: {type: TouchSensor}",
        {"num_modules": 4, "num_sensors": 2, "absolute_size": 2, "active_hinges_count": 0,
         "joints": 0, "extensiveness": 0, "num_limbs": 1, "width": 1, "height": 2,
         "base_density": 1 / 2, "sensors": 2 / 4},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", COUNTED)
def test_descriptors_counted_by_hand(tmp_path, name):
    children, expected = COUNTED[name]
    found = read(tmp_path, f"body: {{type: Core, children: {{{children}}}}}").descriptors
    assert {key: found[key] for key in expected} == pytest.approx(expected)


HINGE_ON = "body: {type: Core, children: {1: {type: ActiveHinge, %s}}}"
JET_ON = "body: {type: Core, children: {1: {type: Thruster, params: {%s}}}}"


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "expected a mapping with id, body and brain; found an empty file"),
        ("task: {type: speed}", "expected a robot; found a configuration"),
        ("body: {type: Bric}", "body.type: expected one of BlueROV2, Core, CoreComponent; found"),
        (
            "body: {type: Core, children: {1: {type: Core}}}",
            "body.children.1.type: expected one of ActiveHinge, Fin, FixedBrick, FixedBrickSensor, "
            "LiftThruster, T200, Thruster, TouchSensor (a core is always the root); found",
        ),
        (
            "body: {type: Core, children: {4: {type: FixedBrick}}}",
            "body.children: expected one of the slots 0, 1, 2, 3 of type Core; found 4",
        ),
        (HINGE_ON % "orientation: 45", "expected 0, 90, 180, 270 or -90 [deg]; found 45"),
        (HINGE_ON % "params: {mass: 2 g}", "params.mass: expected a number >= 0 [kg]; found '2 g'"),
        (JET_ON % "factors: {drag_coefficient: [1.2]}", "expected a number >= 0, or three, one"),
        (
            JET_ON % "thrust: 1, thruster: {range: [-1, 0]}",
            "thrust: expected a thruster that pushes at its highest command 0; found 0 N there",
        ),
    ],
)
def test_wrong_files_are_refused(tmp_path, text, message):
    check_refused(message, read, tmp_path, text, start=f"{tmp_path / 'robot.yaml'}: ")


@pytest.mark.parametrize("path", OURS, ids=lambda p: p.stem)
def test_the_layout_is_that_of_the_modules(path):
    robot = load_morphology(path)
    here = robot.layout
    parts = [(i, part) for i, m in enumerate(robot.modules) for part in m.kind.parts]
    boxes = [box for module in robot.modules for box in module.boxes()]
    assert list(here.module) == [i for i, _ in parts]
    assert here.box_centers() == pytest.approx(np.array([center for center, _ in boxes]))
    assert here.box_half == pytest.approx(np.array([half for _, half in boxes]))
    assert list(here.box_part[here.main]) == list(range(len(parts)))
    corners = []
    for i, part in parts:
        module = robot.modules[i]
        for corner in np.ndindex(2, 2, 2):
            local = np.add(part.position, np.where(corner, part.bounds[1], part.bounds[0]))
            corners.append(module.position + module.rotation @ local)
    corners = np.array(corners)
    assert robot.layout.core_corners().reshape(-1, 3) == pytest.approx(corners)
    assert robot.bounds[0] == pytest.approx(corners.min(axis=0))
    exposed = exposure(robot.layout).shares
    assert exposed.shape == (len(parts), 3)
    assert (exposed >= 0).all() and (exposed <= 1).all()


def test_exposed_shares_of_a_chain_counted_by_hand(tmp_path):
    text = (
        "body: {type: Core, children: {2: {type: FixedBrick, children: {1: {type: FixedBrick}}}}}"
    )
    core, first, last = exposure(read(tmp_path, text).layout).shares
    # The brick hides as much of the core's front as it is smaller than it.
    size = np.array(MODULES["Core"].parts[0].boxes[0].size)
    brick = np.array(MODULES["FixedBrick"].parts[0].boxes[0].size)
    ticks = (np.arange(24) + 0.5) / 24 - 0.5
    hidden = np.prod([(np.abs(ticks * size[k]) <= brick[k] / 2).mean() for k in (1, 2)])
    assert core == pytest.approx([1 - hidden / 2, 1, 1])
    assert (first.min(), last.min()) == (0.0, 0.5)  # joined on both sides, on one
    # So is a sheet of 1 mm on a brick, close to which lies its free face.
    sheet = (
        "modules: {Sheet: {mount: {position: [0, -0.002, 0], outward: [0, 1, 0]}, parts: [{name: "
        "a, boxes: [{size: [0.034, 0.001, 0.034]}], mass: 0.002, volume: 1.0e-6}]}}"
    )
    (tmp_path / "sheet.yaml").write_text(sheet)
    kinds = MODULES | load_modules(tmp_path / "sheet.yaml")
    robot = read(tmp_path, text.replace("{type: FixedBrick}", "{type: Sheet}"), modules=kinds)
    assert exposure(robot.layout).shares[2].tolist() == [1.0, 0.5, 1.0]


def chain(depth: int) -> str:
    """A snake of bricks that goes up through `depth` modules, in YAML's flow style."""
    return (
        "body: {type: Core, children: {1: "
        + "{type: FixedBrick, children: {1: " * depth
        + "{type: FixedBrick}"
        + "}}" * depth
        + "}}"
    )


def test_long_chains_load_and_endless_ones_are_refused(tmp_path):
    robot = read(tmp_path, chain(60))
    assert robot.descriptors["chain_length"] == 61
    check_round_trip(robot, tmp_path)
    for depth in (120, 10_000):
        check_refused("levels", read, tmp_path, chain(depth))


def test_too_many_modules_are_refused(tmp_path):
    def bush(depth):
        child = {"type": "FixedBrick"}
        if depth > 0:
            child["children"] = {slot: bush(depth - 1) for slot in (1, 2, 3)}
        return child

    tree = {"body": {"type": "Core", "children": {1: bush(6)}}}  # 1 + (3⁷ - 1)/2 = 1094
    with pytest.raises(InputError, match=f"expected at most {MAX_MODULES} modules; found more"):
        read(tmp_path, yaml.safe_dump(tree))


def test_a_body_is_sent_small_and_whole(tmp_path):
    """The catalogue's types go by name, others as they are; what was worked out stays here."""
    flipper = replace(MODULES["FixedBrick"], name="Flipper", aliases=())
    text = (
        "brain: {kind: none}\n"
        "body: {type: Core, params: {mass: 0.1, own: 1}, children: {1: {type: Flipper, params: "
        "{red: 1, green: 0, blue: 0}, children: {2: {type: ActiveHinge, orientation: 90}}}}}"
    )
    robot = read(tmp_path, text, modules=MODULES | {"Flipper": flipper})
    small = len(pickle.dumps(robot))
    _ = robot.layout, robot.bounds, robot.descriptors, robot.volume
    assert len(pickle.dumps(robot)) == small < 4000
    again = pickle.loads(pickle.dumps(robot))
    assert again == robot and again.path == robot.path
    assert again.modules[2].kind is MODULES["ActiveHinge"]
    assert again.modules[1].kind == flipper and again.modules[0].kind.mass == 0.1
    assert "volume" not in vars(again.modules[0].kind)
    assert not again.modules[2].position.flags.writeable


def test_equality_sees_every_field(tmp_path):
    base = (
        "id: a\nbody: {type: Core, id: c, params: {ballast: 1}, children: {1: {type: FixedBrick}}}"
    )
    robot = read(tmp_path, base)
    assert robot == read(tmp_path, base)
    assert robot != 1
    for old, new in (("id: a", "id: b"), ("id: c", "id: d"), ("ballast: 1", "ballast: 2"),
                     ("FixedBrick", "ActiveHinge"), ("\nbody", "\nbrain: {}\nbody")):  # fmt: skip
        assert robot != read(tmp_path, base.replace(old, new))


# Modules and hinges, counted in revolve2-standards 1.2.4.
STANDARD = {
    "ant": (17, 8), "babya": (16, 8), "babyb": (21, 10), "blokky": (15, 5), "garrix": (15, 10),
    "gecko": (13, 6), "insect": (12, 9), "linkin": (15, 12), "longleg": (15, 12), "park": (15, 8),
    "penguin": (19, 12), "pentapod": (15, 10), "queen": (14, 9), "revolve_snake": (16, 8),
    "salamander": (25, 14), "spider": (17, 8), "squarish": (13, 6), "stingray": (15, 9),
    "tinlicker": (15, 8), "turtle": (20, 13), "ww": (15, 10), "zappa": (15, 11),
}  # fmt: skip


@pytest.mark.parametrize("name", STANDARD)
def test_a_robot_of_revolve2_has_its_modules(name):
    robot = body(name)
    assert (robot.num_modules, robot.num_hinges) == STANDARD[name]
