"""The genotypes by name; NumPy is imported when one is made, not when a configuration is read."""

from __future__ import annotations

GENOTYPES: dict[str, str] = {
    "tree": "tree.make_tree",
    "plasticoding": "plasticoding.make_plasticoding",
    "cppn": "cppn_genotype.make_cppn",
}
"""`module.function` in this package: (space, params, place for messages) → `Genotype`."""
