"""Volumes of meshes against closed forms and trimesh; refusals; the shapes of the modules."""

import io
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from experiments import module_volumes as experiment
from experiments.meshes import check_mesh, load_mesh, mesh_center_of_volume, mesh_volume
from laboratory import check_refused, refusal
from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.solids import part_mesh

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


def test_volume_of_a_unit_tetrahedron_is_a_sixth():
    mesh = (TETRAHEDRON, TETRAHEDRON_FACES)
    assert mesh_volume(mesh) == pytest.approx(1 / 6, rel=1e-14)
    np.testing.assert_allclose(mesh_center_of_volume(mesh), 0.25, rtol=1e-14)


@pytest.mark.parametrize("mesh", [
    trimesh.creation.cylinder(0.3, 1.0), trimesh.creation.annulus(0.2, 0.5, 1.0),
], ids=["cylinder", "ring"])  # fmt: skip
def test_volume_and_centre_agree_with_trimesh(mesh):
    mesh = mesh.copy()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, (1, 2, 3)))
    mesh.apply_translation((0.3, -0.2, 0.9))
    assert mesh_volume(mesh) == pytest.approx(mesh.volume, rel=1e-10)
    assert mesh_volume(mesh) == pytest.approx(experiment.signed_volume(mesh), rel=1e-10)
    np.testing.assert_allclose(mesh_center_of_volume(mesh), mesh.center_mass, atol=1e-10)


BROKEN = {
    "open": (
        (box().vertices, box().faces[1:]),
        "x.stl: expected a closed surface; found 3 open edges of 18",
    ),
    "inside out": (
        inverted(box()),
        "x.stl: expected faces that look outwards; found the mesh inside out (volume -24 m3): "
        "flip its faces",
    ),
    "nested bodies": (
        join(box(), box((1, 1, 1))),
        "x.stl: body 1 of 2: expected bodies apart from each other; found it reaching into another "
        "one, so that their common volume would count twice",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_meshes_are_refused(case):
    mesh, message = BROKEN[case]
    assert refusal(check_mesh, mesh, "x.stl") == message


@pytest.mark.parametrize("mesh", [
    box(),
    (TETRAHEDRON * 1e-3, TETRAHEDRON_FACES),
    trimesh.creation.annulus(0.2, 0.5, 1.0),
    box((1, 1, 1e-4)),
    join(box((2, 2, 2)), box((2, 2, 2), center=(2, 0, 0))),
    join(box((4, 4, 4)), inverted(box((2, 2, 2))), box((1, 1, 1))),
], ids=["box", "tetrahedron", "ring", "sheet", "touching", "body in a void"])  # fmt: skip
def test_good_meshes_pass(mesh):
    check_mesh(mesh)


def test_files_in_millimetres_are_read(tmp_path):
    box((20.0, 30.0, 40.0), center=(1.0, 2.0, 3.0)).export(tmp_path / "part.stl")
    found = load_mesh("part.stl", folder=tmp_path, scale=1e-3)
    assert mesh_volume(found) == pytest.approx(2.4e-5, rel=1e-6)
    np.testing.assert_allclose(mesh_center_of_volume(found), (1e-3, 2e-3, 3e-3), atol=1e-9)


@pytest.mark.parametrize(("path", "message"), [
    ("../part.stl", "expected a path inside {folder}; found one that leads out"),
    ("missing.stl", "expected a file; found none"),
    ("part.dae", "expected one of .stl, .obj, .ply; found '.dae'"),
])  # fmt: skip
def test_bad_files_are_refused(tmp_path, path, message):
    expected = f"{path}: {message.format(folder=tmp_path)}"
    (tmp_path / "part.dae").write_text("<COLLADA/>")
    check_refused("", load_mesh, path, folder=tmp_path, start=expected)


@pytest.mark.parametrize(("kind", "part"), PARTS, ids=PART_NAMES)
def test_module_meshes_have_the_tabulated_volume_and_outer_size(kind, part):
    mesh = part_mesh(kind, part)
    check_mesh(mesh, part.name)
    file = io.BytesIO(mesh.export(file_type="stl"))
    assert trimesh.load_mesh(file, file_type="stl").is_volume  # as a slicer sees it
    assert mesh_volume(mesh) == pytest.approx(part.volume, rel=5e-3)
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


def test_a_part_that_displaces_nothing_is_drawn_all_the_same():
    kind = MODULES["FixedBrick"]
    part = replace(kind.parts[0], volume=0.0)
    mesh = part_mesh(kind, part)
    check_mesh(mesh)
    assert mesh_volume(mesh) == pytest.approx(1e-3 * part.box_volume, rel=1e-6)
