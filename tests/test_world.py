"""Worlds: the two that ship, users' own, overrides, every wrong input, and the lake's shape."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from mjx_revolve.errors import InputError
from mjx_revolve.terrain import Bed, bed_height, bed_slope, sample_bed
from mjx_revolve.world import LiftDrag, World, load_world, make_world

FIELDS = ", ".join(field.name for field in dataclasses.fields(World))
BED_FIELDS = ", ".join(field.name for field in dataclasses.fields(Bed))
LAKE = load_world("lake").bed


# ------------------------------------------------------------------------- reading


@pytest.mark.parametrize("name", ["empty_underwater", "lake"])
def test_the_thesis_worlds(name):
    water = load_world(name)
    assert water.name == name
    assert water.density == 999.1026
    assert water.gravity == 9.81
    assert water.surface_height == 0.0
    assert water.current == (0.0, 0.0, 0.0)
    assert (water.buoyancy, water.drag, water.added_mass) == ("partial", "faces", True)
    if name == "lake":
        assert (water.bed.kind, water.bed.height, water.bed.highest) == ("lake", -112.8, 36.7)
    else:
        assert (water.bed.kind, water.bed.height, water.bed.extent) == ("flat", -100.0, 2000.0)


def test_a_world_of_ones_own(tmp_path):
    path = tmp_path / "mars.yaml"
    path.write_text("""
density: 1.025e3
gravity: [0, 0, -3.71]
current: [0.1, 0, -.05]
drag: off
buoyancy: mask
added_mass: no
bed: {kind: lake, height: -4, highest: 1.5, extent: 40}
lift_drag: {cla: 4.7}
timestep: 2e-3
""")
    water = load_world(path)
    assert water == World(
        name="mars",
        density=1025.0,
        gravity=3.71,
        current=(0.1, 0.0, -0.05),
        drag="off",
        buoyancy="mask",
        added_mass=False,
        bed=Bed(kind="lake", height=-4, highest=1.5, extent=40),
        lift_drag=LiftDrag(cla=4.7),
        timestep=0.002,
    )
    assert load_world(str(path)) == water


@pytest.mark.parametrize(
    ("override", "field", "expected"),
    [
        ({"density": 1025}, "density", 1025),
        ({"density": np.float32(1000)}, "density", 1000.0),
        ({"gravity": 1.62}, "gravity", 1.62),
        ({"gravity": (0, 0, -9.81)}, "gravity", 9.81),
        ({"gravity": np.array([0.0, 0.0, -9.81])}, "gravity", 9.81),
        ({"gravity": [0, 0, 0]}, "gravity", 0.0),
        ({"surface_height": -2.5}, "surface_height", -2.5),
        ({"current": (0.1, 0, 0)}, "current", (0.1, 0.0, 0.0)),
        ({"current": np.array([0.1, 0.2, 0.3])}, "current", (0.1, 0.2, 0.3)),
        ({"buoyancy": "mask"}, "buoyancy", "mask"),
        ({"buoyancy": False}, "buoyancy", "off"),
        ({"drag": "ellipsoid"}, "drag", "ellipsoid"),
        ({"drag": False}, "drag", "off"),
        ({"added_mass": False}, "added_mass", False),
        ({"bed": None}, "bed", None),
        ({"bed": "off"}, "bed", None),
        ({"bed": -3}, "bed", Bed(kind="flat", height=-3.0)),
        ({"bed": np.float64(-3)}, "bed", Bed(kind="flat", height=-3.0)),
        ({"bed": {"kind": "flat", "height": -3}}, "bed", Bed(kind="flat", height=-3)),
        ({"bed": Bed(kind="flat")}, "bed", Bed(kind="flat")),
        # A mapping keeps what it does not name: the lake stays a lake.
        ({"bed": {"friction": 0.2}}, "bed", dataclasses.replace(LAKE, friction=0.2)),
        ({"lift_drag": {"cda": 0.1}}, "lift_drag", LiftDrag(cda=0.1)),
        ({"timestep": 0.002}, "timestep", 0.002),
    ],
)
def test_overrides(override, field, expected):
    water = load_world("lake", **override)
    assert getattr(water, field) == expected
    rest = {f.name for f in dataclasses.fields(World)} - {field}
    assert all(getattr(water, name) == getattr(load_world("lake"), name) for name in rest)


def test_make_world_without_a_file():
    assert make_world() == World()
    assert make_world(bed=-2, current=[0, 0.1, 0]) == World(
        bed=Bed(kind="flat", height=-2.0), current=(0.0, 0.1, 0.0)
    )


# ------------------------------------------------------------------------- wrong inputs


WRONG = [
    ({"density": "heavy"}, "density: expected a number; found 'heavy'"),
    ({"density": True}, "density: expected a number; found True"),
    ({"density": None}, "density: expected a number; found None"),
    ({"density": [999]}, "density: expected a number; found [999]"),
    ({"density": -1}, "density: expected at least 0; found -1"),
    ({"density": math.nan}, "density: expected a finite number; found nan"),
    ({"density": 10**400}, "density: expected a finite number; found 'a huge integer'"),
    ({"viscosity": -1e-3}, "viscosity: expected at least 0; found -0.001"),
    ({"densty": 1000}, f"densty: expected one of {FIELDS}; found 'densty'"),
    ({"surface_height": math.inf}, "surface_height: expected a finite number; found inf"),
    ({"timestep": 0}, "timestep: expected at least 1e-05; found 0"),
    ({"timestep": 1}, "timestep: expected at most 0.1; found 1"),
    ({"gravity": -9.81}, "gravity: expected at least 0; found -9.81"),
    ({"gravity": "down"}, "gravity: expected a number; found 'down'"),
    ({"gravity": (0, -9.81)}, "gravity: expected a number or 3 numbers; found [0, -9.81]"),
    ({"gravity": ("a", 0, -1)}, "gravity: expected a number or 3 numbers; found ['a', 0, -1]"),
    (
        {"gravity": (1, 0, -9.8)},
        "gravity: expected (0, 0, -g), the surface is level; found (1, 0, -9.8)",
    ),
    (
        {"gravity": (0, 0, 9.8)},
        "gravity: expected (0, 0, -g), the surface is level; found (0, 0, 9.8)",
    ),
    ({"gravity": (0, 0, math.nan)}, "gravity: expected a finite number; found nan"),
    ({"current": (1, 2)}, "current: expected 3 numbers; found (1, 2)"),
    ({"current": (1, 2, 3, 4)}, "current: expected 3 numbers; found (1, 2, 3, 4)"),
    ({"current": 0.1}, "current: expected 3 numbers; found 0.1"),
    ({"current": "fast"}, "current: expected 3 numbers; found 'fast'"),
    ({"current": (0, "x", 0)}, "current.y: expected a number; found 'x'"),
    ({"current": (0, 0, math.inf)}, "current.z: expected a finite number; found inf"),
    ({"buoyancy": "half"}, "buoyancy: expected one of 'partial', 'mask', 'off'; found 'half'"),
    (
        {"drag": "boxes"},
        "drag: expected one of 'faces', 'lift_drag', 'inertia_box', 'ellipsoid', 'off'; "
        "found 'boxes'",
    ),
    ({"added_mass": "yes"}, "added_mass: expected true or false; found 'yes'"),
    ({"added_mass": 1}, "added_mass: expected true or false; found 1"),
    (
        {"bed": "sand"},
        "bed: expected 'off', a height in metres or a mapping with kind; found 'sand'",
    ),
    ({"bed": True}, "bed: expected 'off', a height in metres or a mapping with kind; found True"),
    ({"bed": math.nan}, "bed: expected a finite number; found nan"),
    ({"bed": {"kind": "hill"}}, "bed.kind: expected 'flat' or 'lake'; found 'hill'"),
    ({"bed": {"depth": 1}}, f"bed: expected one of {BED_FIELDS}; found 'depth'"),
    ({"bed": {"height": "low"}}, "bed.height: expected a number; found 'low'"),
    ({"bed": {"friction": math.nan}}, "bed.friction: expected a finite number; found nan"),
    (
        {"bed": {"stiffness": -1}},
        "bed: expected extent > 0, stiffness > 0 and friction >= 0; found 998.0, -1, 0.6",
    ),
    ({"bed": {"height": 40}}, "bed.highest: expected more than bed.height (40); found 36.7"),
    ({"lift_drag": 3}, "lift_drag: expected a mapping; found 3"),
    (
        {"lift_drag": {"cl": 1}},
        "lift_drag: expected one of a0, cla, cda, alpha_stall, cla_stall, cda_stall; found 'cl'",
    ),
    ({"lift_drag": {"cla": "x"}}, "lift_drag.cla: expected a number; found 'x'"),
    ({"lift_drag": {"a0": math.nan}}, "lift_drag.a0: expected a finite number; found nan"),
]


@pytest.mark.parametrize(("override", "message"), WRONG, ids=[str(w[0])[:40] for w in WRONG])
def test_wrong_overrides(override, message):
    with pytest.raises(InputError) as caught:
        load_world("lake", **override)
    assert str(caught.value) == f"world lake: {message}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a mapping of world fields; found None"),
        ("[1, 2]", "expected a mapping of world fields; found [1, 2]"),
        ("1: 2", "expected names of world fields; found 1"),
        ("densty: 3", f"densty: expected one of {FIELDS}; found 'densty'"),
        ("density: [1]", "density: expected a number; found [1]"),
        ("bed: {1: 2}", f"bed: expected one of {BED_FIELDS}; found 1"),
        ("name: 3", "name: expected a text; found 3"),
        ("density: 1\ndensity: 2", "line 2: expected each key once; found 'density' twice"),
    ],
)
def test_wrong_files(tmp_path, text, message):
    path = tmp_path / "pond.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_world(path)
    assert str(caught.value) == f"{path}: {message}"


def test_unknown_worlds(tmp_path):
    with pytest.raises(InputError) as caught:
        load_world("ocean")
    assert str(caught.value) == (
        "world: expected one of empty_underwater, lake or a YAML file; found 'ocean'"
    )
    with pytest.raises(InputError, match=r"none\.yaml: expected a file; found none$"):
        load_world(tmp_path / "none.yaml")
    with pytest.raises(InputError, match=r"^world: expected a name or a path; found 5$"):
        load_world(5)


# ------------------------------------------------------------------------- the bed


def test_lake_extremes_are_exact():
    """-112.8 m at the bottom and +36.7 m on the shore, over 998 m x 998 m, never beyond."""
    line = np.linspace(-499, 499, 999)
    x, y = np.meshgrid(line, line)
    height = np.asarray(bed_height(LAKE, x, y))
    assert LAKE.extent == 998.0
    # To rounding of float32, 8 µm at 112 m; dunes stay between the two.
    assert height.min() == height[499, 499] == pytest.approx(-112.8, abs=1e-5)
    assert height.max() == height[0, 0] == height[-1, -1] == pytest.approx(36.7, abs=1e-5)
    # A shore all round: nobody swims off the map.
    rim = np.concatenate([height[0], height[-1], height[:, 0], height[:, -1]])
    assert rim.min() > 20.0


def test_lake_is_always_the_same_and_has_shore_slope_and_basin():
    first, second = sample_bed(LAKE), sample_bed(load_world("lake").bed)
    assert np.array_equal(first, second)
    assert first.shape == (201, 201)
    assert 0.05 < np.mean(first < -110) < 0.3  # basin
    assert 0.2 < np.mean(first > 0) < 0.6  # shore
    assert np.sum((first > -100) & (first < -10)) > 5000  # slope
    assert np.diff(np.sign(np.diff(first[60], 2))).any()  # dunes


def test_lake_heights_of_other_extents():
    bed = Bed(kind="lake", height=-3.0, highest=1.0, extent=20.0)
    heights = sample_bed(bed, 51)
    assert heights.max() == pytest.approx(1.0)
    assert heights[25, 25] == pytest.approx(-3.0)


def test_slope_against_finite_differences():
    """Central differences in float64 over 2 cm: the same numbers; over 1 mm: to what dunes bend."""
    import jax

    x, y = np.random.default_rng(0).uniform(-480, 480, (2, 500))
    with jax.enable_x64(True):
        slope = [np.asarray(s) for s in bed_slope(LAKE, x, y)]
        d = 5e-4
        fine = [
            np.asarray(bed_height(LAKE, x + d, y) - bed_height(LAKE, x - d, y)) / (2 * d),
            np.asarray(bed_height(LAKE, x, y + d) - bed_height(LAKE, x, y - d)) / (2 * d),
        ]
    assert slope[0] == pytest.approx(fine[0], abs=1e-4)
    assert slope[1] == pytest.approx(fine[1], abs=1e-4)
    assert np.hypot(*slope).max() < 1.0


def test_a_flat_bed():
    x = np.zeros(3, np.float32)
    assert np.all(np.asarray(bed_height(Bed(height=-7.0), x, x)) == -7.0)
    assert not any(np.any(np.asarray(s)) for s in bed_slope(Bed(), x, x))
