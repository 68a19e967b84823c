"""Worlds: the two that ship, users' own, overrides, every wrong input, and the lake's shape."""

import dataclasses
import math

import numpy as np
import pytest

from laboratory import refusal
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.bed import Bed, bed_height, bed_slope, sample_bed
from mjx_revolve.water.law_names import drag_names
from mjx_revolve.water.world import (
    CurrentField,
    Gust,
    LiftDrag,
    Shear,
    SurfaceTension,
    Wave,
    World,
    load_world,
    make_world,
)

DOWN = "gravity: expected a number, or (0, 0, -g), since the surface is level [m/s2]; found"
UNKNOWN = "found an unknown key; did you mean"
KEYS = len(dataclasses.fields(LiftDrag))
LAKE = load_world("lake").bed


@pytest.mark.parametrize("name", ["empty_underwater", "lake"])
def test_the_thesis_worlds(name):
    water = load_world(name)
    assert water.name == name
    assert water.density == 999.1026
    assert water.gravity == 9.81
    assert water.surface_height == 0.0
    assert water.current == (0.0, 0.0, 0.0)
    assert (water.buoyancy, water.drag, water.added_mass) == ("partial", "cross_flow", True)
    assert (water.shear, water.current_field, water.gust, water.waves) == (None, None, None, ())
    assert (water.water_depth, water.surface_tension) == (None, None)
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
shear: {velocity: [.2, 0, 0], depth: 3, profile: power}
gust: {std: 5e-2, time: 4}
waves:
  - {amplitude: .05, wavelength: 2, direction: 1.57}
  - {amplitude: .01, period: 0.9, phase: -1}
water_depth: 4
surface_tension: yes
timestep: 2e-3
""")
    water = load_world(path)
    assert water == World(
        name="mars", density=1025.0, gravity=3.71, current=(0.1, 0.0, -0.05), drag="off",
        buoyancy="mask", added_mass=False, bed=Bed(kind="lake", height=-4, highest=1.5, extent=40),
        lift_drag=LiftDrag(cla=4.7), shear=Shear((0.2, 0.0, 0.0), depth=3, profile="power"),
        gust=Gust((0.05, 0.05, 0.0), time=4),
        waves=(Wave(0.05, 2, direction=1.57), Wave(0.01, period=0.9, phase=-1)), water_depth=4,
        surface_tension=SurfaceTension(gamma=0.0728, contact_angle=0.0), timestep=0.002,
    )  # fmt: skip
    assert load_world(str(path)) == water
    assert hash(load_world(path)) == hash(water)
    # A mapping keeps what it does not name; lists are replaced; each can be switched off.
    assert load_world(path, shear={"depth": 2}).shear == dataclasses.replace(water.shear, depth=2)
    assert load_world(path, gust={"time": 2}).gust == Gust((0.05, 0.05, 0.0), time=2)
    assert load_world(path, waves=[{"amplitude": 0.1, "wavelength": 5}]).waves == (Wave(0.1, 5),)
    one = tmp_path / "one.yaml"
    one.write_text("waves: {amplitude: 0.02, wavelength: 2}\n")
    wave = {"amplitude": 0.02, "period": 1}
    assert load_world(one, waves=wave).waves == (Wave(0.02, period=1),)
    still = load_world(path, shear=None, gust="off", waves=False, surface_tension=None)
    assert (still.shear, still.gust, still.waves, still.surface_tension) == (None, None, (), None)


@pytest.mark.parametrize(("override", "field", "expected"), [
    ({"gravity": np.array([0.0, 0.0, -9.81])}, "gravity", 9.81),
    ({"current": np.array([0.1, 0.2, 0.3])}, "current", (0.1, 0.2, 0.3)),
    ({"buoyancy": False}, "buoyancy", "off"),
    ({"drag": False}, "drag", "off"),
    ({"bed": "off"}, "bed", None),
    ({"bed": np.float64(-3)}, "bed", Bed(kind="flat", height=-3.0)),
    # A mapping keeps what it does not name: the lake stays a lake.
    ({"bed": {"friction": 0.2}}, "bed", dataclasses.replace(LAKE, friction=0.2)),
    ({"lift_drag": {"cda": 0.1}}, "lift_drag", LiftDrag(cda=0.1)),
    ({"shear": {"velocity": np.ones(3)}}, "shear", Shear((1.0, 1.0, 1.0))),
    ({"gust": {"std": np.float32(0.5)}}, "gust", Gust((0.5, 0.5, 0.0))),
    ({"gust": {"std": [0.1, 0, 0.2]}}, "gust", Gust((0.1, 0.0, 0.2))),
    ({"waves": {"amplitude": 0, "period": 2}}, "waves", (Wave(0, period=2),)),
    ({"waves": [Wave(0.1, 3), Wave(0.1, 4)]}, "waves", (Wave(0.1, 3), Wave(0.1, 4))),
    ({"surface_tension": True}, "surface_tension", SurfaceTension()),
    ({"surface_tension": {"gamma": 0.03}}, "surface_tension", SurfaceTension(0.03)),
])  # fmt: skip
def test_overrides(override, field, expected):
    water = load_world("lake", **override)
    assert getattr(water, field) == expected
    rest = {f.name for f in dataclasses.fields(World)} - {field}
    assert all(getattr(water, name) == getattr(load_world("lake"), name) for name in rest)


def test_a_bed_by_its_height_alone_keeps_it(tmp_path):
    for given in ("-2.0", "{height: -2, friction: 0.6}"):
        (tmp_path / "pool.yaml").write_text(f"bed: {given}")
        pool = load_world(tmp_path / "pool.yaml", bed={"kind": "flat", "friction": 0.3})
        assert pool.bed == Bed(kind="flat", height=-2.0, friction=0.3)


WRONG = [
    ({"density": math.nan}, "density: expected a number >= 0 [kg/m3]; found nan"),
    ({"gravity": (1, 0, -9.8)}, f"{DOWN} (1, 0, -9.8)"),
    ({"drag": "boxes"}, f"drag: expected {drag_names()}; found 'boxes'"),
    (
        {"lift_drag": {"cl": 1}},
        f"lift_drag.cl: expected one of {KEYS} keys; {UNKNOWN} lift_drag.cla?",
    ),
    ({"gust": {"std": [1, -2, 0]}}, "gust.std.1: expected a number >= 0 [m/s]; found -2"),
    # Miche: 2 a / L at most 0.142, a = 0.071 m at 1 m.
    (
        {"waves": {"amplitude": 0.0711, "wavelength": 1}},
        "waves.0.amplitude: expected at most 0.071, or a wave 1 m long breaks; found 0.0711",
    ),
    # In water that is shallow for it, at most 0.142 tanh(2 pi h / L).
    (
        {"waves": {"amplitude": 0.05, "wavelength": 10}, "water_depth": 0.1},
        "waves.0.amplitude: expected at most 0.0446, or a wave 10 m long breaks; found 0.05",
    ),
    ({"current_field": "none.npz"}, "current_field: none.npz: expected a file; found none"),
]


@pytest.mark.parametrize(("override", "message"), WRONG, ids=[str(w[0])[:40] for w in WRONG])
def test_wrong_overrides(override, message):
    assert refusal(load_world, "lake", **override) == f"world lake: {message}"


def test_an_empty_file(tmp_path):
    path = tmp_path / "pond.yaml"
    path.touch()
    assert refusal(load_world, path) == f"{path}: expected a mapping of world fields; found None"


def test_unknown_worlds(tmp_path):
    assert refusal(load_world, "ocean") == (
        "world: expected one of empty_underwater, lake or a YAML file; found 'ocean'"
    )
    with pytest.raises(InputError, match=r"none\.yaml: expected a file; found none$"):
        load_world(tmp_path / "none.yaml")


X, Y, Z = np.array([0.0, 1.0, 3.0]), np.array([-1.0, 2.0]), np.array([-4.0, -1.0])
VELOCITY = np.random.default_rng(0).normal(size=(3, 2, 2, 3)).round(6)
ARRAYS = {"x": X, "y": Y, "z": Z, "velocity": VELOCITY}


def table(order=slice(None)) -> list[str]:
    """The grid as lines of a CSV file, without their heading."""
    rows = [
        ",".join(map(repr, map(float, (X[i], Y[j], Z[k], *VELOCITY[i, j, k]))))
        for i, j, k in np.ndindex(3, 2, 2)
    ]
    return list(np.array(rows)[order])


def test_a_field_is_the_same_from_either_kind_of_file(tmp_path):
    (tmp_path / "deep").mkdir()
    np.savez(tmp_path / "deep" / "flow.npz", **ARRAYS)
    with (tmp_path / "small.NPZ").open("wb") as file:
        np.savez_compressed(file, **ARRAYS)
    shuffled = table(np.random.default_rng(1).permutation(12))
    (tmp_path / "flow.csv").write_text("\n".join(["x,y,z,u,v,w", *shuffled]) + "\n\n")
    # A column more, spaces, another order, and a spreadsheet's invisible mark at the start.
    loose = [f" {row}, 7 " for row in table()]
    (tmp_path / "loose.csv").write_text("\ufeffx, y ,z,u,v,w,salt\n" + "\n".join(loose))
    worlds = []
    for name in ("deep/flow.npz", "small.NPZ", "flow.csv", "loose.csv"):
        path = tmp_path / "sea.yaml"
        path.write_text(f"name: sea\ncurrent_field: {name}\n")
        worlds.append(load_world(path))
        worlds.append(make_world(name="sea", current_field=tmp_path / name))
    for sea in worlds:
        for name, array in ARRAYS.items():
            assert np.array_equal(getattr(sea.current_field, name), array)
        assert (sea, hash(sea), repr(sea)) == (worlds[0], hash(worlds[0]), repr(worlds[0]))
    assert load_world(tmp_path / "sea.yaml", current_field=None).current_field is None
    # Other numbers are another world, to caches and to resumed runs.
    other = CurrentField(X, Y, Z, VELOCITY + 1e-9)
    assert make_world(current_field=other) != worlds[0]
    assert repr(other) != repr(worlds[0].current_field)
    with pytest.raises(ValueError, match="read-only"):
        other.velocity[0] = 0


def test_relative_paths_start_where_they_are_written(tmp_path, monkeypatch):
    folder = tmp_path / "worlds"
    folder.mkdir()
    np.savez(tmp_path / "flow.npz", **ARRAYS)
    path = folder / "sea.yaml"
    path.write_text("current_field: flow.npz")
    monkeypatch.chdir(tmp_path)
    assert refusal(load_world, path) == (
        f"{path}: current_field: {folder / 'flow.npz'}: expected a file; found none"
    )
    assert load_world("lake", current_field="flow.npz").current_field.x[2] == 3.0
    path.write_text("current_field: ../flow.npz")
    (folder / "link.npz").symlink_to(tmp_path / "flow.npz")
    for name, found in (("../flow.npz", "one"), ("link.npz", "a link")):
        path.write_text(f"current_field: {name}")
        assert refusal(load_world, path) == (
            f"{path}: current_field: {name}: expected a path inside {folder}; "
            f"found {found} that leads out"
        )
    path.write_text(f"current_field: {tmp_path / 'flow.npz'}")
    assert load_world(path).current_field is not None
    path.write_text('current_field: "a\\0b.npz"')
    with pytest.raises(InputError, match=r"expected a file name; found a null byte$"):
        load_world(path)


GRID = "expected one row for each of 3 x 2 x 2 points of a full grid"


@pytest.mark.parametrize(("lines", "message"), [
    (["x,y,z,u,v"], "line 1: expected columns x, y, z, u, v, w; found no w"),
    (["x,y,z,u,v,w", "1,2,3,4,5,fast"], "line 2: expected a number; found 'fast'"),
    (["x,y,z,u,v,w", *table()[1:]], f"{GRID}; found 11 rows"),
    (["x,y,z,u,v,w", *table(), table()[5]], f"{GRID}; found (1, -1, -1) twice"),
])  # fmt: skip
def test_wrong_tables(tmp_path, lines, message):
    path = tmp_path / "flow.csv"
    path.write_text("\n".join(lines))
    found = refusal(load_world, "lake", current_field=path)
    assert found == f"world lake: current_field: {path}: {message}"


@pytest.mark.parametrize(("changes", "message"), [
    ({"x": None}, "expected arrays x, y, z, velocity; found no x"),
    ({"z": [-1.0, -4.0]}, "z: expected rising numbers [m]; found -4 after -1"),
    (
        {"velocity": VELOCITY[..., :2]},
        "velocity: expected shape [3, 2, 2, 3], as x, y and z have it; found [3, 2, 2, 2]",
    ),
])  # fmt: skip
def test_wrong_arrays(tmp_path, changes, message):
    path = tmp_path / "flow.npz"
    np.savez(path, **{k: v for k, v in (ARRAYS | changes).items() if v is not None})
    found = refusal(load_world, "lake", current_field=path)
    assert found == f"world lake: current_field: {path}: {message}"


def test_files_that_are_no_fields(tmp_path):
    whole = tmp_path / "whole.npz"
    np.savez_compressed(whole, **ARRAYS)
    content = whole.read_bytes()
    middle = content.index(b"velocity") + 60
    wrong = {
        "empty.npz": b"",
        "text.npz": b"x,y,z,u,v,w",
        "cut.npz": content[:-100],
        "spoilt.npz": content[:middle] + bytes(40) + content[middle + 40 :],
        "latin.csv": b"x,y,z,u,v,w\n\xff",
    }
    np.save(tmp_path / "array.npy", X)
    wrong["array.npz"] = (tmp_path / "array.npy").read_bytes()
    (tmp_path / "folder.npz").mkdir()
    for name, data in wrong.items():
        (tmp_path / name).write_bytes(data)
    for name in (*wrong, "folder.npz"):
        with pytest.raises(InputError, match=rf"{name}: expected .*; found:? [^\n]+$"):
            load_world("lake", current_field=tmp_path / name)


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
    assert np.concatenate([height[0], height[-1], height[:, 0], height[:, -1]]).min() > 20.0


def test_lake_is_always_the_same_and_has_shore_slope_and_basin():
    first = sample_bed(LAKE)
    second = sample_bed.__wrapped__(load_world("lake").bed)  # not what the cache has kept
    assert np.array_equal(first, second)
    assert first.shape == (201, 201)
    assert 0.05 < np.mean(first < -110) < 0.3  # basin
    assert 0.2 < np.mean(first > 0) < 0.6  # shore
    assert np.sum((first > -100) & (first < -10)) > 5000  # slope
    assert np.diff(np.sign(np.diff(first[60], 2))).any()  # dunes


@pytest.mark.parametrize("bed", [LAKE, Bed(height=-2.5)], ids=["lake", "flat"])
def test_whole_numbers_are_places_as_others_are(bed):
    x, y = np.array([200, -300]), np.array([3, 50])
    exact = bed_height(bed, 1.0 * x, 1.0 * y)
    assert np.array_equal(bed_height(bed, x, y), exact)
    assert float(bed_height(bed, 200, 3)) == pytest.approx(exact[0], abs=1e-4)
    assert np.shape(bed_slope(bed, 200, 3)) == (2,)


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
