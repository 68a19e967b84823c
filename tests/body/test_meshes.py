"""Volumes of meshes against closed forms and trimesh; refusals; the shapes of the modules."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from experiments import module_volumes as experiment
from experiments.meshes import check_mesh, load_mesh, mesh_center_of_volume, mesh_volume
from mjx_revolve.body.catalogue import MODULES, THESIS_MODULES, Box
from mjx_revolve.body.solids import part_mesh
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.trust import audited_by

TETRAHEDRON = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
TETRAHEDRON_FACES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
PARTS = [(kind, part) for kind in MODULES.values() for part in kind.parts]
PARTS = list({(kind.name, part.name): (kind, part) for kind, part in PARTS}.values())
PART_NAMES = [f"{kind.name}-{part.name}" for kind, part in PARTS]


def box(size=(2.0, 3.0, 4.0), center=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """Solid box."""
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(center)
    return mesh


def join(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """Bodies in one mesh."""
    return trimesh.util.concatenate(meshes)


def inverted(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with its faces turned round."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


# --- volume and centre --------------------------------------------------------------------------


def test_whoever_is_asked_hears_of_a_file(tmp_path):
    """As `--trust` does, of files elsewhere."""
    trimesh.creation.box().export(tmp_path / "box.stl")
    heard = []
    with audited_by(lambda path, kind, content: heard.append((path.name, kind, len(content)))):
        load_mesh(tmp_path / "box.stl")
    assert heard == [("box.stl", "data", 684)]


def test_volume_of_a_unit_tetrahedron_is_a_sixth():
    mesh = (TETRAHEDRON, TETRAHEDRON_FACES)
    assert mesh_volume(mesh) == pytest.approx(1 / 6, rel=1e-14)
    np.testing.assert_allclose(mesh_center_of_volume(mesh), 0.25, rtol=1e-14)


def test_volume_of_a_box_is_its_product():
    mesh = box(center=(1.0, -2.0, 0.5))
    assert mesh_volume(mesh) == pytest.approx(24.0, rel=1e-14)
    np.testing.assert_allclose(mesh_center_of_volume(mesh), (1.0, -2.0, 0.5), atol=1e-14)


def test_icosphere_converges_to_the_ball_with_second_order():
    errors = [4 / 3 * np.pi - mesh_volume(trimesh.creation.icosphere(level)) for level in (2, 3, 4)]
    # Halving the edges of an inscribed polyhedron quarters what it leaves out.
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.02)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.01)
    assert errors[2] < 0.01


@pytest.mark.parametrize("seed", range(5))
def test_rotation_and_translation_carry_the_centre_and_keep_the_volume(seed):
    random = np.random.default_rng(seed)
    mesh = trimesh.creation.icosphere(1)
    mesh.vertices = mesh.vertices * random.uniform(0.5, 2.0, 3) + 0.1 * mesh.vertices[:, ::-1] ** 2
    volume, center = mesh_volume(mesh), mesh_center_of_volume(mesh)
    rotation = trimesh.transformations.random_rotation_matrix(random.random(3))[:3, :3]
    shift = random.uniform(-3, 3, 3)
    moved = (mesh.vertices @ rotation.T + shift, mesh.faces)
    assert mesh_volume(moved) == pytest.approx(volume, rel=1e-12)
    np.testing.assert_allclose(mesh_center_of_volume(moved), rotation @ center + shift, atol=1e-12)


@pytest.mark.parametrize(
    "mesh",
    [
        box(),
        trimesh.creation.icosphere(2),
        trimesh.creation.cylinder(0.3, 1.0),
        trimesh.creation.annulus(0.2, 0.5, 1.0),
        trimesh.creation.capsule(1.0, 0.25),
    ],
    ids=["box", "ball", "cylinder", "ring", "capsule"],
)
def test_volume_and_centre_agree_with_trimesh(mesh):
    mesh = mesh.copy()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, (1, 2, 3)))
    mesh.apply_translation((0.3, -0.2, 0.9))
    assert mesh_volume(mesh) == pytest.approx(mesh.volume, rel=1e-10)
    assert mesh_volume(mesh) == pytest.approx(experiment.signed_volume(mesh), rel=1e-10)
    np.testing.assert_allclose(mesh_center_of_volume(mesh), mesh.center_mass, atol=1e-10)


def test_disjoint_bodies_add_up():
    mesh = join(box((1, 1, 1)), box((2, 1, 1), center=(5, 0, 0)))
    assert mesh_volume(mesh) == pytest.approx(3.0, rel=1e-13)
    np.testing.assert_allclose(mesh_center_of_volume(mesh), (10 / 3, 0, 0), atol=1e-13)
    check_mesh(mesh)


def test_an_inner_void_is_taken_away():
    mesh = join(box((2, 2, 2)), inverted(box((1, 1, 1), center=(0.25, 0, 0))))
    assert mesh_volume(mesh) == pytest.approx(7.0, rel=1e-13)
    np.testing.assert_allclose(mesh_center_of_volume(mesh), (-0.25 / 7, 0, 0), atol=1e-13)
    check_mesh(mesh)


def test_a_mesh_far_from_the_origin_keeps_its_digits():
    mesh = box((0.01, 0.01, 0.01), center=(1e4, 1e4, 1e4))
    assert mesh_volume(mesh) == pytest.approx(1e-6, rel=1e-8)


def test_an_inside_out_mesh_has_negative_volume():
    assert mesh_volume(inverted(box())) == pytest.approx(-24.0)


def test_the_thesis_formula_as_printed_is_no_volume():
    mesh = (TETRAHEDRON, TETRAHEDRON_FACES)
    assert experiment.signed_volume(mesh) == pytest.approx(1 / 6)
    assert experiment.signed_volume(mesh, printed=True) != pytest.approx(1 / 6, rel=0.1)
    # What is worse: it depends on where the mesh lies.
    shift = (1.0, 2.0, 3.0)
    assert experiment.signed_volume(box(), shift) == pytest.approx(24.0)
    here = experiment.signed_volume(box(), printed=True)
    there = experiment.signed_volume(box(), shift, printed=True)
    assert abs(there - here) > 1.0
    assert abs(here - 24.0) > 1.0


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (
            (np.zeros((4, 2)), TETRAHEDRON_FACES),
            r"vertices: expected shape \[n, 3\]; found \[4, 2\]",
        ),
        (
            (TETRAHEDRON, np.zeros((2, 4), int)),
            r"faces: expected triangles \[m, 3\]; found \[2, 4\]",
        ),
        ((TETRAHEDRON, TETRAHEDRON_FACES * 1.0), "faces: expected whole numbers; found float64"),
    ],
)
def test_arrays_of_the_wrong_shape_are_refused(mesh, message):
    for function in (mesh_volume, mesh_center_of_volume, check_mesh):
        with pytest.raises(InputError, match=message):
            function(mesh)


def test_no_volume_has_no_centre():
    flat = join(box((1, 1, 1)), inverted(box((1, 1, 1))))
    with pytest.raises(InputError, match="expected a mesh that encloses a volume"):
        mesh_center_of_volume(flat)


# --- refusals -----------------------------------------------------------------------------------


def changed(function) -> tuple[np.ndarray, np.ndarray]:
    """A box as arrays, changed in place by `function`, or replaced by what it returns."""
    mesh = box()
    vertices, faces = mesh.vertices.copy(), mesh.faces.copy()
    return function(vertices, faces) or (vertices, faces)


def with_nan(vertices, faces):
    """One vertex that is not a number."""
    vertices[3, 1] = np.nan


def with_infinity(vertices, faces):
    """One vertex at infinity."""
    vertices[0, 0] = np.inf


def with_turned_face(vertices, faces):
    """One face wound against its neighbours."""
    faces[4] = faces[4, ::-1]


def with_missing_vertex(vertices, faces):
    """One face that names a vertex that is not there."""
    faces[2, 0] = 8


def with_doubled_corner(vertices, faces):
    """One face with the same corner twice."""
    faces[7, 0] = faces[7, 1]


BROKEN = {
    "empty": (
        (np.zeros((0, 3)), np.zeros((0, 3), int)),
        "x.stl: expected a mesh with vertices and faces; found 0 vertices and 0 faces",
    ),
    "no faces": (
        (TETRAHEDRON, np.zeros((0, 3), int)),
        "x.stl: expected a mesh with vertices and faces; found 4 vertices and 0 faces",
    ),
    "nan": (
        changed(with_nan),
        "x.stl: expected finite vertices; found 1 of 8 that are not (first: vertex 3)",
    ),
    "infinity": (
        changed(with_infinity),
        "x.stl: expected finite vertices; found 1 of 8 that are not (first: vertex 0)",
    ),
    "missing vertex": (
        changed(with_missing_vertex),
        "x.stl: expected faces of vertices 0 to 7; found 1 of 12 with others (first: face 2)",
    ),
    "degenerate": (
        changed(with_doubled_corner),
        "x.stl: expected faces with three different corners; found 1 of 12 degenerate "
        "(first: face 7)",
    ),
    "open": (
        changed(lambda vertices, faces: (vertices, faces[1:])),
        "x.stl: expected a closed surface; found 3 open edges of 18",
    ),
    "unmerged": (
        (box().triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3)),
        "x.stl: expected a closed surface; found 36 open edges of 36",
    ),
    "inconsistent": (
        changed(with_turned_face),
        "x.stl: expected faces wound one way; found 3 edges of 18 whose faces are wound against "
        "each other",
    ),
    "flat": (
        (TETRAHEDRON[:3], np.array([(0, 1, 2), (0, 2, 1)])),
        "x.stl: expected a solid; found a flat mesh (volume 0 m3)",
    ),
    "inside out": (
        inverted(box()),
        "x.stl: expected faces that look outwards; found the mesh inside out (volume -24 m3): "
        "flip its faces",
    ),
    "one body inside out": (
        join(box(), inverted(box((1, 1, 1), center=(9, 0, 0)))),
        "x.stl: body 1 of 2: expected faces that look outwards; found it inside out (volume -1 m3)",
    ),
    "nested bodies": (
        join(box(), box((1, 1, 1))),
        "x.stl: body 1 of 2: expected bodies apart from each other; found it reaching into another "
        "one, so that their common volume would count twice",
    ),
    "crossing bodies": (
        join(box((2, 2, 2)), box((2, 2, 2), center=(1, 1, 1)).subdivide()),
        "x.stl: body 0 of 2: expected bodies apart from each other; found it reaching into another "
        "one, so that their common volume would count twice",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_meshes_are_refused(case):
    mesh, message = BROKEN[case]
    with pytest.raises(InputError) as error:
        check_mesh(mesh, "x.stl")
    assert str(error.value) == message


@pytest.mark.parametrize(
    "mesh",
    [
        box(),
        (TETRAHEDRON * 1e-3, TETRAHEDRON_FACES),
        trimesh.creation.annulus(0.2, 0.5, 1.0),
        box((1, 1, 1e-4)),
        join(box((2, 2, 2)), box((2, 2, 2), center=(2, 0, 0))),
        join(box((4, 4, 4)), inverted(box((2, 2, 2))), box((1, 1, 1))),
    ],
    ids=["box", "tetrahedron", "ring", "sheet", "touching", "body in a void"],
)
def test_good_meshes_pass(mesh):
    check_mesh(mesh)


# --- files --------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "STL"])
def test_files_in_millimetres_are_read(tmp_path, suffix):
    mesh = box((20.0, 30.0, 40.0), center=(1.0, 2.0, 3.0))
    (tmp_path / f"part.{suffix}").write_bytes(_exported(mesh, suffix.lower()))
    for path, folder in ((f"part.{suffix}", tmp_path), (tmp_path / f"part.{suffix}", None)):
        found = load_mesh(path, folder=folder, scale=1e-3)
        assert len(found.vertices) == 8
        assert mesh_volume(found) == pytest.approx(2.4e-5, rel=1e-6)
        np.testing.assert_allclose(mesh_center_of_volume(found), (1e-3, 2e-3, 3e-3), atol=1e-9)


def _exported(mesh: trimesh.Trimesh, kind: str) -> bytes:
    data = mesh.export(file_type=kind)
    return data if isinstance(data, bytes) else data.encode()


def test_ascii_stl_is_read(tmp_path):
    (tmp_path / "a.stl").write_text(trimesh.creation.icosphere(1).export(file_type="stl_ascii"))
    assert mesh_volume(load_mesh(tmp_path / "a.stl")) == pytest.approx(
        trimesh.creation.icosphere(1).volume, rel=1e-5
    )


def test_quadrangles_and_a_missing_material_are_read(tmp_path):
    lines = ["mtllib ../nowhere.mtl"]
    lines += [f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    lines += ["usemtl gold", "f 1 2 4 3", "f 5 7 8 6", "f 1 5 6 2", "f 3 4 8 7", "f 1 3 7 5"]
    (tmp_path / "cube.obj").write_text("\n".join([*lines, "f 2 6 8 4"]))
    assert mesh_volume(load_mesh("cube.obj", folder=tmp_path)) == pytest.approx(1.0)


def _folder(tmp_path: Path) -> Path:
    """A folder `robot/` with good and bad files, beside a file outside of it."""
    folder = tmp_path / "robot"
    (folder / "parts").mkdir(parents=True)
    good = _exported(box(), "stl")
    for place in (folder / "good.stl", folder / "parts" / "good.stl", tmp_path / "secret.stl"):
        place.write_bytes(good)
    (folder / "link.stl").symlink_to(tmp_path / "secret.stl")
    (folder / "out").symlink_to(tmp_path)
    (folder / "in.stl").symlink_to("parts/good.stl")
    (folder / "loop.stl").symlink_to("loop.stl")
    (folder / "cut.stl").write_bytes(good[:-20])
    (folder / "noise.ply").write_bytes(os.urandom(200))
    (folder / "text.obj").write_text("v 1 2\nf a b c\n")
    (folder / "empty.obj").write_text("")
    (folder / "open.stl").write_bytes(
        _exported(trimesh.Trimesh(box().vertices, box().faces[2:], process=False), "stl")
    )
    (folder / "nan.obj").write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "part.dae").write_text("<COLLADA/>")
    (folder / "none").write_text("")
    return folder


def test_paths_inside_the_folder_are_read(tmp_path):
    folder = _folder(tmp_path)
    for path in ("good.stl", "parts/good.stl", "./good.stl", "in.stl"):
        assert mesh_volume(load_mesh(path, folder=folder)) == pytest.approx(24.0)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("../secret.stl", "../secret.stl: expected a path inside {folder}; found one that leads "
         "out"),
        ("parts/../good.stl", "parts/../good.stl: expected a path inside {folder}; found one that "
         "leads out"),
        ("/etc/x.stl", "/etc/x.stl: expected a path inside {folder}; found one that leads out"),
        ("..\\secret.stl", "..\\secret.stl: expected a path inside {folder}; found one that leads "
         "out"),
        ("C:\\x.stl", "C:\\x.stl: expected a path inside {folder}; found one that leads out"),
        ("link.stl", "link.stl: expected a path inside {folder}; found a link that leads out"),
        ("out/secret.stl", "out/secret.stl: expected a path inside {folder}; found a link that "
         "leads out"),
        ("loop.stl", "loop.stl: expected a readable file; found "),
        ("a\0.stl", "'a\\x00.stl': expected a file name; found a null byte"),
        ("missing.stl", "missing.stl: expected a file; found none"),
        ("parts", "parts: expected one of .stl, .obj, .ply; found no suffix"),
        ("part.dae", "part.dae: expected one of .stl, .obj, .ply; found '.dae'"),
        ("cut.stl", "cut.stl: expected a "),  # what trimesh finds depends on its optional packages
        ("noise.ply", "noise.ply: expected a valid PLY mesh; found: Not a ply file!"),
        ("text.obj", "text.obj: expected a valid OBJ mesh; found: "),
        ("empty.obj", "empty.obj: expected a mesh with vertices and faces; found 0 vertices and 0 "
         "faces"),
        ("open.stl", "open.stl: expected a closed surface; found 4 open edges of 17"),
        ("nan.obj", "nan.obj: expected finite vertices; found 1 of 3 that are not (first: "
         "vertex 0)"),
    ],
)  # fmt: skip
def test_bad_files_are_refused(tmp_path, path, message):
    folder = _folder(tmp_path)
    with pytest.raises(InputError) as error:
        load_mesh(path, folder=folder)
    assert str(error.value).startswith(message.format(folder=folder))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("scale", [0, -1.0, float("nan"), float("inf"), "1", True, None])
def test_bad_scales_are_refused(tmp_path, scale):
    with pytest.raises(InputError, match=r"scale: expected a number > 0 \[m per unit\]"):
        load_mesh("good.stl", folder=_folder(tmp_path), scale=scale)


def test_a_large_file_is_refused(tmp_path):
    with (tmp_path / "large.stl").open("wb") as file:
        file.truncate(65 * 2**20)
    with pytest.raises(InputError, match="expected at most 64 MiB; found more"):
        load_mesh(tmp_path / "large.stl")


# --- the shapes of the modules ------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "part"), PARTS, ids=PART_NAMES)
def test_module_meshes_have_the_tabulated_volume_and_outer_size(kind, part):
    mesh = part_mesh(kind, part)
    check_mesh(mesh, part.name)
    assert mesh.is_volume  # trimesh's own opinion
    assert mesh_volume(mesh) == pytest.approx(part.volume, rel=5e-3)
    assert mesh.volume == pytest.approx(part.volume, rel=5e-3)
    corners = [
        np.asarray(one.position) + sign * 0.5 * np.asarray(one.size)
        for one in part.boxes
        for sign in (-1, 1)
    ]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    np.testing.assert_allclose(mesh.bounds[0], low, atol=1e-9)
    if part.volume <= sum(np.prod(one.size) for one in part.boxes):
        np.testing.assert_allclose(mesh.bounds[1], high, atol=1e-9)
    else:  # the pads of the touch sensor
        np.testing.assert_allclose(mesh.bounds[1, 1:], high[1:], atol=1e-9)
        assert mesh.bounds[1, 0] > high[0]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "part"), PARTS, ids=PART_NAMES)
@pytest.mark.parametrize("share", [0.02, 0.5, 0.9, 1.0, 1.5])
def test_types_of_users_are_drawn_with_their_volume(kind, part, share):
    full = float(sum(np.prod(one.size) for one in part.boxes))
    own = replace(part, volume=share * full)
    for name in (kind.name, "MyOwn"):
        mesh = part_mesh(replace(kind, name=name), own)
        check_mesh(mesh, name)
        assert mesh_volume(mesh) == pytest.approx(own.volume, rel=1e-6)


def test_a_shell_has_the_volume_of_walls_less_windows():
    """The brick against pencil and paper: outer box - inner box - window polygons x wall."""
    kind = MODULES["FixedBrick"]
    mesh = part_mesh(kind, kind.parts[0])
    size = np.asarray(kind.parts[0].boxes[0].size)
    inner = np.unique(np.round(np.abs(mesh.vertices[:, 0]), 9))[-2]  # the inner wall's x
    wall = size[0] / 2 - inner
    window = 0.0
    for axis in range(3):
        front = mesh.vertices[np.isclose(mesh.vertices[:, axis], size[axis] / 2)]
        across = np.delete(front, axis, axis=1)
        radius = np.linalg.norm(across, axis=1).min()
        corners = int(np.isclose(np.linalg.norm(across, axis=1), radius).sum())
        window += 2 * 0.5 * corners * radius**2 * np.sin(2 * np.pi / corners)
    expected = np.prod(size) - np.prod(size - 2 * wall) - window * wall
    assert mesh_volume(mesh) == pytest.approx(expected, rel=1e-6)


def test_the_hinge_frame_is_bored_where_the_axis_is():
    kind = MODULES["ActiveHinge"]
    frame = kind.parts[0]
    mesh = part_mesh(kind, frame)
    x, y, z = mesh.vertices.T
    distance = np.hypot(x - (kind.hinge.anchor[0] - frame.position[0]), z)
    bore = distance < 0.45 * frame.boxes[0].size[2] / 2
    assert bore.sum() == 4 * 24  # two rims of a regular polygon in each arm
    np.testing.assert_allclose(distance[bore], distance[bore][0], rtol=1e-9)
    assert y[bore].min() == -y[bore].max() == -frame.boxes[0].size[1] / 2


def test_boxes_that_overlap_are_drawn_once():
    kind = MODULES["Core"]
    part = replace(
        kind.parts[0],
        boxes=(Box((0.04, 0.04, 0.04), (0, 0, 0)), Box((0.04, 0.04, 0.04), (0.02, 0.01, 0.0))),
        volume=6.4e-5 * 1.625,  # the union: the second box adds 1 - 1/2 x 3/4 of its volume
    )
    mesh = part_mesh(replace(kind, name="Twin"), part)
    check_mesh(mesh)
    assert mesh_volume(mesh) == pytest.approx(6.4e-5 * 1.625, rel=1e-9)
    np.testing.assert_allclose(mesh.bounds, [(-0.02, -0.02, -0.02), (0.04, 0.03, 0.02)], atol=1e-6)


def test_a_part_that_displaces_nothing_is_drawn_all_the_same():
    kind = MODULES["FixedBrick"]
    part = replace(kind.parts[0], volume=0.0)
    mesh = part_mesh(kind, part)
    check_mesh(mesh)
    assert mesh_volume(mesh) == pytest.approx(1e-3 * part.box_volume, rel=1e-6)


def test_the_thesis_variant_is_drawn_like_the_catalogue():
    for name, kind in THESIS_MODULES.items():
        for mine, theirs in zip(kind.parts, MODULES[name].parts, strict=True):
            assert mesh_volume(part_mesh(kind, mine)) == pytest.approx(theirs.volume, rel=5e-3)


def test_the_experiment_recomputes_the_table(capsys):
    rows = experiment.rows()
    assert len(rows) == len(experiment.TABLE)
    densities = {row["part"]: row["density"] for row in rows}
    for row in rows:
        assert abs(row["difference"]) < 0.5
        assert row["trimesh"] == pytest.approx(row["computed"], rel=1e-9)
        assert row["moved"] == pytest.approx(row["computed"], rel=1e-9)
        assert abs(row["printed_moved"] / row["computed"] - 1) > 0.5
    assert sorted(densities.values()) == pytest.approx(
        [560.7, 887.6, 953.3, 1096.9, 1780.8], rel=2e-4
    )
    assert experiment.main([]) == 0
    assert "Erratum" in capsys.readouterr().out
