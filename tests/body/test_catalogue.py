"""The catalogue against the tabulated values; box geometry; users' own types; refusals."""

import math
from dataclasses import replace

import numpy as np
import pytest

from laboratory import check_refused, write
from mjx_revolve.body.boxes import boxes_overlap, quarter_turn, union_measure
from mjx_revolve.body.catalogue import (
    MODULES,
    THESIS_MODULES,
    Box,
    Hinge,
    ModuleType,
    Mount,
    Part,
    Slot,
    load_modules,
)
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.inputs.errors import InputError

# type, part, box [m], box volume [m³] as printed, mesh volume [m³], mass [kg]
TABLE = [
    ("Core", 0, (0.089, 0.089, 0.045), 3.564e-4, 5.054e-5, 0.0900),
    ("FixedBrick", 0, (0.041, 0.041, 0.0355), 5.968e-5, 1.070e-5, 0.0102),
    ("ActiveHinge", 0, (0.022, 0.03575, 0.010), 7.865e-6, 3.032e-6, 0.0017),
    ("ActiveHinge", 1, (0.0245, 0.02575, 0.015), 1.062e-5, 1.014e-5, 0.0090),
    ("TouchSensor", 0, (0.0041, 0.031, 0.0155), 1.970e-6, 2.735e-6, 0.0030),
]


@pytest.mark.parametrize("kind, index, size, box_volume, volume, mass", TABLE)
def test_values_are_those_of_the_table(kind, index, size, box_volume, volume, mass):
    part = MODULES[kind].parts[index]
    assert part.boxes[0].size == size
    assert part.box_volume == pytest.approx(box_volume, rel=5e-4)  # the table's four digits
    assert part.volume == part.total_volume == volume
    assert part.mass == mass
    assert part.drag_coefficient == 1.05


def test_aliases_name_the_same_type():
    assert MODULES["CoreComponent"] is MODULES["Core"]
    assert MODULES["FixedBrickSensor"] is MODULES["TouchSensor"]
    assert set(MODULES) == set(THESIS_MODULES)


def test_hinge_limits_are_those_of_the_servo():
    hinge = MODULES["ActiveHinge"].hinge
    assert hinge.range == (-math.pi / 4, math.pi / 4)
    assert (hinge.effort, hinge.speed) == (0.17658, 5.235988)
    assert hinge.axis == (0.0, 1.0, 0.0)


@pytest.mark.parametrize("name, axis", [("Thruster", 0), ("LiftThruster", 2)])
def test_thrusters_push_half_a_newton_through_their_length(name, axis):
    kind = MODULES[name]
    (duct,) = kind.parts
    thruster = duct.thruster
    assert kind.is_thruster and not kind.is_fin and not kind.slots
    assert thruster.axis == tuple(np.eye(3)[axis])
    assert duct.boxes[0].size[axis] == max(duct.boxes[0].size)
    assert (thruster.thrust_at(-2.0), thruster.thrust_at(0.5)) == (-0.5, 0.125)
    # It is attached by the face of its box that looks along -x.
    assert kind.mount.position == (-duct.boxes[0].size[0] / 2, 0.0, 0.0)
    # The pieces that the comment counts: a duct with a wall of 2 mm and a motor.
    ring = math.pi * (0.015**2 - 0.013**2) * 0.040
    assert duct.volume == pytest.approx(ring + math.pi * 0.006**2 * 0.035, rel=0.01)


def test_the_fin_is_a_plate_of_abs_with_lift():
    (plate,) = MODULES["Fin"].parts
    length, width, thickness = plate.boxes[0].size
    corners = (4 - math.pi) * 0.01**2
    assert plate.volume == pytest.approx((length * width - corners) * thickness, rel=1e-3)
    assert plate.mass / plate.volume == pytest.approx(1050, rel=0.005)
    p, aspect = plate.lift_drag, width / length
    assert p.cla == pytest.approx(2 * math.pi * aspect / (2 + math.sqrt(aspect**2 + 4)))
    stall, across = p.alpha_stall, math.pi / 2 - p.alpha_stall
    assert p.cla * stall + p.cla_stall * across == pytest.approx(0.0)
    assert p.cda * stall + p.cda_stall * across == pytest.approx(1.17)
    # Before the stall the mean drag is that of a force normal to the plate.
    angle = (np.arange(1000) + 0.5) / 1000 * stall
    assert (p.cda * angle).mean() == pytest.approx((p.cla * angle * np.tan(angle)).mean(), rel=0.01)


def test_ballast_moves_the_centres_of_mass_and_volume():
    part = Part(
        "p", (Box((0.1, 0.1, 0.1)),), mass=0.3, volume=2e-4, electronics_volume=1e-4,
        center_of_volume=(0.0, 0.01, 0.02), ballast_mass=0.1, ballast_volume=1e-4,
        ballast_position=(0.04, 0.0, -0.04),
    )  # fmt: skip
    assert part.total_mass == pytest.approx(0.4)
    assert part.total_volume == pytest.approx(4e-4)
    assert part.free_volume == pytest.approx(6e-4)
    assert part.center_of_mass == pytest.approx((0.01, 0.0, -0.01))
    assert part.displaced_center == pytest.approx((0.01, 0.0075, 0.005))
    bare = replace(part, ballast_mass=0.0, ballast_volume=0.0)
    assert bare.center_of_mass == (0.0, 0.0, 0.0)
    assert bare.displaced_center == part.center_of_volume
    kind = ModuleType("M", (part,))
    assert (kind.mass, kind.volume) == pytest.approx((0.4, 4e-4))


def test_faces_count_shared_silhouettes_once():
    # Two unit cubes: the second half a unit to the right and 2 up.
    part = Part("p", (Box((1, 1, 1)), Box((1, 1, 1), (0.5, 0.0, 2.0))), 1.0, 1.0)
    assert part.face_areas == pytest.approx([2.0, 2.0, 1.5])
    assert part.box_volume == pytest.approx(2.0)


def test_union_of_many_random_boxes_agrees_with_sampling():
    rng = np.random.default_rng(0)
    low = rng.uniform(0, 0.7, (12, 2))
    high = low + rng.uniform(0.05, 0.3, (12, 2))
    points = rng.uniform(0, 1, (200_000, 1, 2))
    inside = ((points > low) & (points < high)).all(-1).any(-1).mean()
    assert union_measure(low, high) == pytest.approx(inside, abs=0.005)


def test_quarter_turns_are_exact():
    for axis in np.eye(3):
        turned = quarter_turn(axis, 1)
        assert set(np.unique(np.abs(turned))) == {0.0, 1.0}
        assert turned @ np.roll(axis, 1) == pytest.approx(np.roll(axis, 2))  # x to y about z
        assert np.array_equal(quarter_turn(axis, 2), turned @ turned)
        assert np.array_equal(quarter_turn(axis, 3), turned.T)


def _turn_z(angle: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    "angle, distance",
    [(0.0, 1.0), (math.pi / 4, (1 + math.sqrt(2)) / 2)],
    ids=["aligned", "corner first"],
)
def test_unit_cubes_part_where_they_should(angle, distance):
    half, turn = np.full(3, 0.5), _turn_z(angle)
    for gap, expected in ((-1e-6, True), (1e-6, False)):
        center = np.array([[distance + gap, 0.0, 0.0]])
        hit = boxes_overlap(np.zeros(3), np.eye(3), half, center, turn[None], half[None])
        assert hit.tolist() == [expected]


def test_edge_against_edge_needs_the_cross_products():
    # Two long rods, crossed and each turned 45 degrees about its own length: only the cross product
    # of their edges sees that they are apart.
    half = np.array([2.0, 0.5, 0.5])
    c = math.sqrt(0.5)
    lying = np.array([[1.0, 0.0, 0.0], [0.0, c, -c], [0.0, c, c]])
    crossed = _turn_z(math.pi / 2) @ lying
    for gap, expected in ((-1e-6, True), (1e-6, False)):
        center = np.array([[0.0, 0.0, 2 * 0.5 * math.sqrt(2) + gap]])
        hit = boxes_overlap(np.zeros(3), lying, half, center, crossed[None], half[None])
        assert hit.tolist() == [expected]


PART = Part("p", (Box((1, 1, 1)),), 1.0, 1.0)
HINGE = Hinge((0, 1, 0), (0, 0, 0), (-1, 1), 1.0, 1.0)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: Box((1, 0, 1)), "box: size.1: expected a number > 0 [m]; found 0"),
        (lambda: replace(PART, name="a/b"), "_ or -, beginning with a letter; found 'a/b'"),
        (lambda: replace(HINGE, range=(0.5, 1)), "hinge: range: expected [lowest, highest] around"),
        (lambda: ModuleType("M", (replace(PART, mass=0),)), "expected a core heavier than 0 kg"),
    ],
)
def test_wrong_values_are_refused(make, message):
    check_refused(message, make)


FIN = """
modules:
  Fin:
    mount: -x
    hinge: {axis: [0, 2, 0], anchor: [.00465, 0, 0], range: [-0.6, 0.6]}
    parts:
      - {name: holder, size: [.022, .036, .010], mass: 2e-3}
      - {name: blade, position: [.04, 0, 0], mass: .006, drag_coefficient: 1.9, boxes: [
          {size: [.06, .04, .002]}, {size: [.002, .04, .01], position: [.03, 0, 0]}]}
    slots: {1: +x}
  Ring:
    mount: {position: [0, -0.02, 0], outward: [0, 1, 0]}
    parts: [{size: [.04, .04, .04], mass: .01, volume: 3e-5, contact: false}]
    slots:
      1: +y
      5: {position: [0, 0, .02], direction: [0, 0, 1], up: [0, -1, 0]}
    aliases: [Hoop]
"""


def test_own_types_are_read(tmp_path):
    kinds = load_modules(write(tmp_path, FIN, "mine.yaml"))
    assert set(kinds) == {"Fin", "Ring", "Hoop"}
    fin, ring = kinds["Fin"], kinds["Ring"]
    assert fin.mount == Mount((-0.011, 0.0, 0.0), (1.0, 0.0, 0.0))
    assert fin.slots == {1: Slot((0.07, 0.0, 0.0), (1.0, 0.0, 0.0))}
    assert fin.hinge.axis == (0.0, 1.0, 0.0)
    assert fin.hinge.effort == MODULES["ActiveHinge"].hinge.effort
    holder, blade = fin.parts
    assert holder.volume == pytest.approx(0.022 * 0.036 * 0.010)
    # The end plate reaches from .029 to .031: half of it is inside the blade.
    assert blade.volume == pytest.approx(0.04 * (0.06 * 0.002 + 0.002 * 0.01 - 0.001 * 0.002))
    assert (blade.drag_coefficient, blade.contact) == (1.9, True)
    assert ring.parts[0].name == "part0"
    assert (ring.parts[0].volume, ring.parts[0].contact) == (3e-5, False)
    assert kinds["Hoop"] is ring


def test_own_types_make_a_robot(tmp_path):
    mine = MODULES | load_modules(write(tmp_path, FIN, "mine.yaml"))
    robot = """
body:
  type: Core
  children:
    1: {type: Ring, children: {
      1: {type: Fin, orientation: 90, id: tail}, 5: {type: FixedBrick, id: top}}}
    2: {type: Hoop}
"""
    morphology = load_morphology(write(tmp_path, robot), modules=mine)
    places = {m.name: m for m in morphology.modules}
    assert places["Ring1"].position == pytest.approx([0, 0.0445 + 0.02, 0])
    assert places["tail"].position == pytest.approx([0, 0.0445 + 0.04 + 0.011, 0])
    assert places["tail"].rotation[:, 0] == pytest.approx([0, 1, 0])
    # The slot on top: the brick looks up, and its z points back towards the core.
    assert places["top"].position == pytest.approx([0, 0.0645, 0.02 + 0.019])
    assert places["top"].rotation[:, 1] == pytest.approx([0, 0, 1])
    assert places["top"].rotation[:, 2] == pytest.approx([0, -1, 0])
    morphology.save(tmp_path / "again.yaml")
    again = load_morphology(tmp_path / "again.yaml", modules=mine)
    assert again.modules == morphology.modules
    with pytest.raises(InputError, match=r"expected one of ActiveHinge, Fin, FixedBr.*'Ring'"):
        load_morphology(tmp_path / "again.yaml")


def test_own_core_replaces_the_catalogues_under_all_its_names(tmp_path):
    text = "modules: {Core: {mount: null, parts: [{size: [.1, .1, .1], mass: .5}], slots: {1: +y}}}"
    mine = MODULES | load_modules(write(tmp_path, text, "mine.yaml"))
    assert mine["CoreComponent"] is mine["Core"]
    assert load_morphology(write(tmp_path, "body: {type: CoreComponent}"), modules=mine).mass == 0.5


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "mine.yaml: expected a mapping with modules; found None"),
        (
            FIN.replace("name: blade,", "name: blade, size: [1, 1, 1],"),
            "modules.Fin.parts.1: expected one of size and boxes; found both or neither",
        ),
    ],
)
def test_wrong_files_are_refused(tmp_path, text, message):
    path = write(tmp_path, text, "mine.yaml")
    check_refused(message, load_modules, path, start=str(path))
