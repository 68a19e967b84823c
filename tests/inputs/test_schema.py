"""Checked values: what they take, every kind of complaint in one line, what is printed of them."""

import dataclasses
import pickle
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from annotated_types import Ge, Lt, Unit

from laboratory import refusal
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.schema import (
    Boolean,
    ConstraintError,
    Direction,
    Integer,
    LawName,
    NonNegative,
    Number,
    OrOff,
    Pair,
    Positive,
    Text,
    TupleOf,
    Vector,
    checked,
    read,
    words,
)
from mjx_revolve.inputs.short_repr import short_repr
from mjx_revolve.inputs.yaml_reader import parse_yaml


@checked
class Leaf:
    """The end of a branch."""

    length: Annotated[Positive, Unit("m")]
    range: Annotated[Pair[Number], Unit("rad")] = (-1.0, 1.0)

    def __post_init__(self) -> None:
        if self.range[0] > self.range[1]:
            raise ConstraintError("range", "a rising one", str(list(self.range)))


@checked
class Tree:
    """A name, some numbers, and what grows on it."""

    name: Annotated[Text, words("a name")]
    axis: Direction = (0.0, 0.0, 1.0)
    place: Annotated[Vector, Unit("m")] = (0.0, 0.0, 0.0)
    leaves: TupleOf[Leaf] = ()
    by_number: dict[Annotated[Integer, Ge(0)], Leaf] = dataclasses.field(default_factory=dict)
    first: OrOff[Leaf] = None
    age: Annotated[Integer, Ge(0), Lt(2**32)] = 0
    mass: Annotated[NonNegative, Unit("kg")] | None = None
    shade: LawName[Literal["some", "off"]] = "some"
    green: Boolean = True


def test_values_become_plain():
    assert read(Integer, np.int64(3)) == 3 and read(Boolean, np.bool_(True)) is True
    tree = Tree(
        "oak", axis=np.array([0.0, 3.0, 4.0]), place=[np.float32(1.5), 2, np.int64(3)],
        leaves=[{"length": 1}, Leaf(2, range=[0, 1])], first="off", shade=False,
    )  # fmt: skip
    assert tree == Tree(
        name="oak", axis=(0.0, 0.6, 0.8), place=(1.5, 2.0, 3.0),
        leaves=(Leaf(1.0), Leaf(2.0, (0.0, 1.0))), shade="off",
    )  # fmt: skip
    plain = [*tree.axis, *tree.place, tree.leaves[0].length]
    assert {type(x) for x in plain} == {float}
    assert read(Tree, {"name": "oak", "first": {"length": 3}}).first == Leaf(3)


@pytest.mark.parametrize("text", ["012", "-0777", "1:30", "1:30.5"])
def test_numbers_of_other_bases_are_refused(text):
    with pytest.raises(InputError, match="a number without a leading 0 or a colon"):
        parse_yaml(f"a: {text}".encode(), "x.yaml")
    assert parse_yaml(b"[07.5, '012', 0x1f, 0]", "x.yaml") == [7.5, "012", 31, 0]


def test_they_are_frozen_dataclasses():
    leaf = Leaf(1)
    assert hash(leaf) == hash(Leaf(1.0)) and repr(leaf) == "Leaf(length=1.0, range=(-1.0, 1.0))"
    assert pickle.loads(pickle.dumps(leaf)) == leaf
    assert dataclasses.replace(leaf, length=2) == Leaf(2)
    with pytest.raises(dataclasses.FrozenInstanceError):
        leaf.length = 2.0
    with pytest.raises(InputError, match=r"^leaf: length: expected a number > 0 \[m\]; found 0$"):
        dataclasses.replace(leaf, length=0)


NAMES = "name, axis, place, leaves, by_number, first, age, mass, shade, green"


@pytest.mark.parametrize(("values", "message"), [
    ({"name": 3}, "name: expected a name; found 3"),
    ({"place": (1, 2)}, "place: expected three numbers [m]; found (1, 2)"),
    ({"place": (10**5000, 2, 3)}, "place.0: expected a number [m]; found a huge integer"),
    ({"leaves": [{}]}, "leaves.0.length: expected a number > 0 [m]; found none"),
    ({"by_number": {"a": {}}}, "by_number: expected a whole number >= 0; found 'a'"),
    ({"first": 3}, "first: expected a mapping with length, or nothing; found 3"),
    ({"shade": "much"}, "shade: expected one of some, off; found 'much'"),
    ({"gren": 1}, f"gren: expected one of {NAMES}; found an unknown key; did you mean green?"),
    (
        {"age": -1, "green": 1, "colour": 2},
        f"colour: expected one of {NAMES}; found an unknown key "
        "(also wrong or missing: age, green)",
    ),
])  # fmt: skip
def test_complaints(values, message):
    for name, make in (("tree 'ash'", lambda x: Tree(**x)), ("here", lambda x: read(Tree, x))):
        given: dict[str, Any] = {"name": "ash"} | values
        found = refusal(make, given)
        assert message in found and "\n" not in found
        if name != "here":
            assert found.startswith(f"tree {given['name']!r}: ")


@dataclasses.dataclass(repr=False)
class Some:
    name: str
    rows: np.ndarray
    more: object = None
    hidden: int = dataclasses.field(default=3, repr=False)
    __repr__ = short_repr


def test_arrays_by_shape_and_nothing_by_nothing():
    assert repr(Some("a", np.zeros((200, 3)))) == "Some(name='a', rows [200, 3])"
    assert repr(Some("a", np.float64(2.0))) == "Some(name='a', rows=np.float64(2.0))"
    inner = Some("b" * 500, np.zeros(2))
    assert len(repr(Some("a", np.zeros(1), inner))) < 200
