"""Short representations of dataclasses: the shapes of arrays, a few words of other fields."""

from __future__ import annotations

import dataclasses
import reprlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_SHORT_REPR = reprlib.Repr()
_SHORT_REPR.maxstring = _SHORT_REPR.maxother = 80
_SHORT_REPR.maxtuple = 4


def short_repr(value: DataclassInstance) -> str:
    """The fields of a dataclass in one line, for `__repr__ = short_repr`.

    For example `Trajectory(time [200], qpos [200, 15])`.

    Fields that are None, or hidden by `field(repr=False)`, are left out.
    """
    parts = []
    for field in dataclasses.fields(value):
        found = getattr(value, field.name, None)
        if field.repr and found is not None:
            shape = getattr(found, "shape", ())
            array = isinstance(shape, tuple) and len(shape) > 0
            parts.append(f"{field.name} {list(shape)}" if array else _field(field.name, found))
    return f"{type(value).__name__}({', '.join(parts)})"


def _field(name: str, value: object) -> str:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        text = repr(value)
        return f"{name}={text if len(text) <= 200 else type(value).__name__ + '(...)'}"
    return f"{name}={_SHORT_REPR.repr(value)}"
