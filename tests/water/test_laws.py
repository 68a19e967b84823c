"""The tables of laws: what a law must say before it may stand in them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from laboratory import ROOT, at_rest, box_robot, check_refused, march, world
from mjx_revolve.body.module_types import Part
from mjx_revolve.body.params import check_overrides
from mjx_revolve.engine.level import PartLaws, Parts
from mjx_revolve.engine.robot import check_timestep
from mjx_revolve.engine.step_constants import read_constants
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.config import RobustConfig
from mjx_revolve.episodes.simulate import simulate
from mjx_revolve.formats.mjcf import make_mjcf
from mjx_revolve.formats.sdf import PLUGINS, make_sdf
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.validation_messages import fields_of
from mjx_revolve.numerics.spatial import dot, mul
from mjx_revolve.water.added_mass import CarriedWater
from mjx_revolve.water.buoyancy import BUOYANCY_LAWS
from mjx_revolve.water.drag import DRAG_LAWS, find_drag_law
from mjx_revolve.water.laws import (
    Coefficient,
    Drag,
    Export,
    PartDragLaw,
    PartFlow,
    law_numbers,
    part_field,
    part_fields,
)
from mjx_revolve.water.world import World

NUMBERS = (Parts, CarriedWater)


def numbers_of(law):
    """The class of a part law's numbers, from a robot's table."""
    robot = box_robot((0.1, 0.08, 0.06), 0.3, world(drag=law.name))
    return law.numbers(robot.fluid, robot.world)


def part_laws():
    return [law for law in DRAG_LAWS.values() if isinstance(law, PartDragLaw)]


def test_laws_are_found_by_their_names_and_unknown_ones_are_errors():
    for table in (DRAG_LAWS, BUOYANCY_LAWS):
        assert all(law.name == name and law.summary for name, law in table.items())
    with pytest.raises(InputError, match=r"law: expected one of faces, .*; found 'treacle'"):
        find_drag_law("treacle")
    # Nor does a step take an unknown one for no force.
    with pytest.raises(InputError, match="found 'treacle'"):
        _ = PartLaws("off", "treacle").idle


def test_every_number_of_a_part_is_varied_or_says_why_not():
    """And every law says what of it varies, or `task.robust` refuses it."""
    factors = {*Variation._fields} - {"motor"}
    assert {*RobustConfig.model_fields} == {*Variation._fields}
    varied = set()
    for numbers in (*NUMBERS, *(type(numbers_of(law)) for law in part_laws())):
        for name, field in part_fields(numbers).items():
            assert bool(field.varied) != bool(field.fixed), name
            assert {*field.varied} <= factors and field.unit, name
            varied |= {*field.varied}
    assert varied == factors
    for law in part_laws():
        fields = part_fields(type(numbers_of(law))).values()
        assert law.varied == (not fields or any(field.varied for field in fields)), law.name
    with pytest.raises(TypeError, match="either varied"):
        part_field("kg")


@pytest.mark.parametrize("law", DRAG_LAWS.values(), ids=lambda law: law.name)
def test_every_coefficient_is_documented_bounded_and_exported(law):
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    assert f"| `drag: {law.name}` |" in page
    for c in law.coefficients:
        where = c.name if c.own_field else f"coefficients.{c.name}"
        assert f"| `{where}` | `{law.name}` | {c.unit} |" in page
        assert c.low <= c.default <= c.high
        if c.own_field:  # declared twice, for bodies are read without JAX
            field = fields_of(Part)[c.name]
            assert field.default == c.default
            assert any(getattr(item, "unit", None) == c.unit for item in field.metadata)
    for field in fields_of(law.parameters).values() if law.parameters else ():
        stated = any(getattr(item, "unit", None) for item in field.metadata)
        assert stated or field.default is None or field.default is False
    for export in (law.mjcf, law.sdf):
        assert export.note or export.missing or law.name == "off"
        assert not export.stand_in or export.stand_in in DRAG_LAWS
    assert not law.sdf.stand_in or law.sdf.stand_in in PLUGINS


def flow(lanes=200):
    draw = np.random.default_rng(0)
    v, w = draw.normal(size=(2, 3, lanes))
    submerged = jnp.asarray(draw.uniform(size=lanes))
    return PartFlow(tuple(map(jnp.asarray, v)), tuple(map(jnp.asarray, 5 * w)), submerged)


@pytest.mark.parametrize("law", part_laws(), ids=lambda law: law.name)
def test_no_law_adds_energy_and_padding_has_no_effect(law):
    """The work of force and torque on a part, and on one of those that pad tables."""
    robot = box_robot((0.1, 0.08, 0.06), 0.3, world(drag=law.name))
    with jax.enable_x64(True):
        passing = flow()
        numbers = read_constants(robot.assembly).parts.drag[law.name]
        part, blank = (jax.tree.map(lambda x, k=k: x[k], numbers) for k in (0, 1))
        drag = law.force(passing, part, robot.world)
        work = dot(drag.force, passing.velocity) + dot(drag.torque, passing.angular_velocity)
        assert np.all(np.asarray(work) <= 1e-9)
        for x in jax.tree.leaves(law.force(passing, blank, robot.world)):
            assert not np.any(x)
        angular = law.angular(blank) if law.angular else ()
        assert not np.any(angular)


@law_numbers
class LinearNumbers:
    """Drag per velocity."""

    linear: Any = part_field("N s/m", axes="size", varied=("drag",))


def linear_drag(flow: PartFlow, numbers: LinearNumbers, world: World) -> Drag:
    """A force against the velocity, with its gradient as damping."""
    damping = [mul(c, flow.submerged) for c in numbers.linear]
    force = tuple(-d * v for d, v in zip(damping, flow.velocity, strict=True))
    return Drag(force, (0.0, 0.0, 0.0), tuple(damping))


LINEAR = PartDragLaw(
    name="linear",
    summary="a drag that grows with velocity",
    explicit=False,
    varied=True,
    coefficients=(Coefficient("linear_drag", "N s/m3", "drag per velocity and area", 40.0),),
    numbers=lambda parts, world: LinearNumbers(
        parts.coefficients["linear_drag"][:, None] * parts.exposed * parts.silhouette
    ),
    force=linear_drag,
    mjcf=Export("", missing="drag: linear"),
    sdf=Export("faces", missing="drag: linear, in whose place is that of the faces"),
)


@pytest.fixture
def linear(monkeypatch):
    monkeypatch.setitem(DRAG_LAWS, "linear", LINEAR)


def test_a_law_in_the_table_needs_nothing_else(linear):
    """Worlds and modules take it, with its coefficient; steps, variation and exporters have it."""
    size, mass, speed = np.array([0.1, 0.08, 0.06]), 0.3, 0.5
    tank = world(drag="linear", coefficients={"linear_drag": 60.0})
    plain, own = (
        box_robot(tuple(size), mass, tank, **part)
        for part in ({}, {"coefficients": {"linear_drag": 90.0}})
    )
    assert check_overrides({"drag": "linear", "coefficients": {"linear_drag": 2}}, "params")
    qpos, qvel = at_rest(plain, 1, -5.0)
    qvel[0] = speed
    area, dt = size[1] * size[2], tank.timestep
    for robot, c in ((plain, 60.0), (own, 90.0)):
        time, _, after, _ = march(robot, 0.5, qpos, qvel)
        expected = speed / (1 + c * area * dt / mass) ** (time / dt)
        assert after[:, 0, 0] == pytest.approx(expected, rel=1e-9)
    with jax.enable_x64(True):
        track = simulate(plain, duration=0.5, qpos=qpos[:, 0], qvel=qvel[:, 0],
                         variation=Variation(drag=1.5))  # fmt: skip
    assert track.qvel[-1, 0] == pytest.approx(after[-1, 0, 0], rel=1e-6)
    check_timestep(plain)
    assert "drag: linear" in make_mjcf(plain) and "drag: linear" in make_sdf(plain)


def test_a_coefficient_out_of_its_bounds_or_of_no_law_is_an_error(linear):
    for given, text in (
        ({"linear_drag": -1.0}, "linear_drag: expected a number from 0 to inf .N s/m3.; found -1"),
        (
            {"linear": 1.0},
            r"expected names of coefficients .(?:\w+, )*linear_drag.; found 'linear'",
        ),
        ({"drag_coefficient": 1.0}, "expected names of coefficients"),
        (3, "expected a mapping from coefficients to numbers; found 3"),
    ):
        with pytest.raises(InputError, match=text):
            world(drag="linear", coefficients=given)


def test_a_step_is_refused_by_the_inertia_box_itself():
    """Ballast far outside makes a box much larger than the parts' faces, and so does its drag."""
    light, heavy = (
        box_robot(
            (0.089, 0.089, 0.045), 0.09, world(drag="inertia_box", timestep=0.01), 5e-5,
            ballast_mass=ballast, ballast_position=(0.0, 0.0, -0.3),
        )
        for ballast in (0.0, 0.02)
    )  # fmt: skip
    check_timestep(light)
    expected = "timestep: expected at most 0.0067 s, as drag: inertia_box"
    check_refused(expected, check_timestep, heavy)
