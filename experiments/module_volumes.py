"""The thesis's Table 1 from our own meshes, and its misprinted volume formula by number.

``python -m experiments.module_volumes``

For a closed mesh whose faces all look outwards, the volume is the sum of the signed volumes of the
tetrahedra between each face and the origin (C. Zhang, T. Chen, "Efficient feature extraction for
2D/3D objects in mesh representation", ICIP 2001, equation 5)::

    V_i = 1/6 (-x3 y2 z1 + x2 y3 z1 + x3 y1 z2 - x1 y3 z2 - x2 y1 z3 + x1 y2 z3)

which is det[v1 v2 v3] / 6. The thesis prints the last term as ``x1 y2 z2``; that is a misprint:
with it the sum depends on where the mesh lies. The package itself asks trimesh, which the first
table checks.

The meshes of `mjx_revolve.body.solids` are drawn to enclose the tabulated volumes, so the first
table is a check of the whole way (shape, closed surface, signed tetrahedra) and not an independent
measurement of RoboGen's printed parts, whose files are not ours to ship.
"""

from __future__ import annotations

import numpy as np

from experiments.common import make_parser, write_results
from experiments.meshes import Mesh, check_mesh, mesh_center_of_volume, mesh_volume
from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.solids import part_mesh
from mjx_revolve.inputs.commands import run_command

# Table 1 of the thesis as Revolve's code has it (the thesis prints the two hinge masses the other
# way round): mesh volume [m³], mass [kg].
TABLE = {
    ("Core", "core"): (5.054e-5, 0.0900),
    ("FixedBrick", "brick"): (1.070e-5, 0.0102),
    ("ActiveHinge", "frame"): (3.032e-6, 0.0017),
    ("ActiveHinge", "servo"): (1.014e-5, 0.0090),
    ("TouchSensor", "sensor"): (2.735e-6, 0.0030),
}


def signed_volume(
    mesh: Mesh, shift: tuple[float, float, float] = (0.0, 0.0, 0.0), printed: bool = False
) -> float:
    """Volume of a mesh by the formula of the thesis [m³].

    Args:
        mesh: as for `experiments.meshes.mesh_volume`.
        shift: moves the mesh first [m]; a volume does not change.
        printed: as the thesis prints the formula, with x1 y2 z2 for x1 y2 z3.
    """
    vertices, faces = (mesh.vertices, mesh.faces) if hasattr(mesh, "faces") else mesh
    corners = (np.asarray(vertices, float) + shift)[np.asarray(faces)]
    (x1, y1, z1), (x2, y2, z2), (x3, y3, z3) = corners.transpose(1, 2, 0)
    terms = -x3 * y2 * z1 + x2 * y3 * z1 + x3 * y1 * z2 - x1 * y3 * z2 - x2 * y1 * z3
    return float((terms + x1 * y2 * (z2 if printed else z3)).sum() / 6.0)


def rows() -> list[dict[str, float | str]]:
    """One row per part: tabulated and computed volume and what follows from them, SI units."""
    found = []
    for kind in {kind.name: kind for kind in MODULES.values()}.values():  # aliases once
        for part in kind.parts:
            if (kind.name, part.name) not in TABLE:
                continue
            volume, mass = TABLE[kind.name, part.name]
            mesh = part_mesh(kind, part)
            check_mesh(mesh, f"{kind.name} {part.name}")
            computed = signed_volume(mesh)
            found.append(
                {
                    "part": f"{kind.name} {part.name}",
                    "tabulated": volume,
                    "computed": computed,
                    "difference": 100.0 * (computed / volume - 1.0),  # %
                    "box": part.box_volume,
                    "mass": mass,
                    "density": mass / computed,
                    "center": mesh_center_of_volume(mesh),
                    "trimesh": mesh_volume(mesh),
                    "moved": signed_volume(mesh, (0.1, 0.1, 0.1)),
                    "printed": signed_volume(mesh, printed=True),
                    "printed_moved": signed_volume(mesh, (0.1, 0.1, 0.1), printed=True),
                }
            )
    return found


def main(argv: list[str] | None = None) -> int:
    """Prints both tables."""
    what = "The thesis's Table 1 from our meshes."
    options = make_parser("module_volumes", what, files=False).parse_args(argv)
    table = rows()
    print("Module volumes (thesis, Table 1) from our meshes\n")
    print(
        f"{'part':<20}{'tabulated':>11}{'computed':>11}{'diff.':>9}{'trimesh':>11}{'boxes':>11}"
        f"{'mass':>9}"
        f"{'density':>9}   centre of volume"
    )
    print(
        f"{'':<20}{'[m3]':>11}{'[m3]':>11}{'[%]':>9}{'[m3]':>11}{'[m3]':>11}{'[kg]':>9}{'[kg/m3]':>9}"
        "   x, y, z [mm]"
    )
    for row in table:
        center = ", ".join(f"{round(1e3 * value, 2) + 0.0:.2f}" for value in row["center"])
        print(
            f"{row['part']:<20}{row['tabulated']:>11.3e}{row['computed']:>11.3e}"
            f"{round(row['difference'], 4) + 0.0:>9.4f}{row['trimesh']:>11.3e}{row['box']:>11.3e}"
            f"{row['mass']:>9.4f}{row['density']:>9.1f}   {center}"
        )
    print(
        "\nThe centres are those of our shapes in the part's frame; the physics uses the "
        "catalogue's.\nThe touch sensor's volume exceeds its box: the pads of its mesh stand out "
        "of it."
    )
    print("\nErratum: with x1 y2 z2 for x1 y2 z3 the sum is no volume\n")
    print(f"{'part':<20}{'correct':>12}{'moved .1 m':>12}{'as printed':>12}{'moved .1 m':>12}")
    print(f"{'':<20}" + f"{'[m3]':>12}" * 4)
    for row in table:
        print(
            f"{row['part']:<20}{row['computed']:>12.3e}{row['moved']:>12.3e}"
            f"{row['printed']:>12.3e}{row['printed_moved']:>12.3e}"
        )
    if options.results:
        parts = [{"name": x["part"], "tabulated": x["tabulated"], "computed": x["computed"]}
                 for x in table]  # fmt: skip
        write_results("module_volumes", {"parts": parts}, ())
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
