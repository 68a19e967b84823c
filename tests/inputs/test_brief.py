"""What is printed of values in a notebook: a line, not all their numbers."""

from dataclasses import dataclass, field

import numpy as np

from mjx_revolve.inputs.short_repr import short_repr


@dataclass(repr=False)
class Some:
    name: str
    rows: np.ndarray
    more: object = None
    hidden: int = field(default=3, repr=False)
    __repr__ = short_repr


def test_arrays_by_shape_and_nothing_by_nothing():
    assert repr(Some("a", np.zeros((200, 3)))) == "Some(name='a', rows [200, 3])"
    assert repr(Some("a", np.float64(2.0))) == "Some(name='a', rows=np.float64(2.0))"
    inner = Some("b" * 500, np.zeros(2))
    assert len(repr(Some("a", np.zeros(1), inner))) < 200
