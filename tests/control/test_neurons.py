"""Revolve's neural networks from a robot's YAML: read, run by hand, evolved and saved."""

import re

import jax
import numpy as np
import pytest
import yaml

import laboratory
from laboratory import check_refused, read, world
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.control.kinds import find_controller
from mjx_revolve.control.neurons import evolve_brain, make_neural_network
from mjx_revolve.control.readings import SensorReadings
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.config import ControllerConfig
from mjx_revolve.inputs.errors import InputError

DT, REACH = 0.005, np.pi / 4
ROBOT = """
id: thinker
body:
  id: core
  type: Core
  children:
    1:
      id: arm
      type: ActiveHinge
      children: {1: {id: hand, type: FixedBrick, children: {1: {id: pad, type: TouchSensor}}}}
    2: {id: tail, type: ActiveHinge}
    3: {id: fin, type: ActiveHinge}
brain:
  neurons:
    a1: {id: a1, layer: input, part_id: core, type: Input}
    a2: {id: a2, layer: input, part_id: core, type: Input}
    a3: {id: a3, layer: input, part_id: core, type: Input}
    g1: {id: g1, layer: input, part_id: core, type: Input}
    t1: {id: t1, layer: input, part_id: pad, type: Input}
    t2: {id: t2, layer: input, part_id: pad, type: Input}
    clock: {id: clock, layer: hidden, type: Oscillator}
    mix: {id: mix, layer: output, part_id: arm, type: Sigmoid}
    sum: {id: sum, layer: output, part_id: tail, type: Simple}
    late: {id: late, layer: output, part_id: tail, type: Simple}
  connections:
    - {src: a2, dst: mix, weight: 0.2}
    - {src: g1, dst: mix, weight: -0.7}
    - {src: t2, dst: sum, weight: 0.5}
    - {src: clock, dst: sum, weight: 0.4}
    - {src: mix, dst: sum, weight: 0.3}
    - {src: sum, dst: mix, weight: 1.5}
    - {src: sum, dst: sum, weight: -0.25}
    - {src: sum, dst: clock, weight: 9.0}
  params:
    clock: {period: 0.8, phase_offset: 0.3, gain: 0.6}
    mix: {bias: 0.1, gain: 0.9}
    sum: {bias: -0.2, gain: 0.7}
    late: {bias: 0.0, gain: 1.0}
"""


@pytest.fixture(scope="module")
def robot():
    return build_robot(read(ROBOT), world())


def play(robot, genes, steps, sense):
    """`[steps, nhinge]` targets, in float64."""
    with jax.enable_x64(True):
        controller = make_neural_network(plant_of(robot), robot.morphology)
        genes = np.zeros(controller.num_genes) if genes is None else genes
        return laboratory.play(controller, plant_of(robot), genes[:, None], steps, sense)[0][..., 0]


def felt():
    """Specific force, spin, and how the bed pushes the pad's left cell and its right one."""
    three = lambda *x: tuple(np.array([v]) for v in x)  # noqa: E731
    zero = three(0.0, 0.0, 0.0)
    pad = SensorReadings(0.0, 0.0, zero, zero, cells=(zero[0] + 3, zero[0] + 0.6))
    return SensorReadings(
        0.0, 0.0, (), three(0.5, -1.0, 2.0), force=three(1.0, 3.0, 9.0), modules={"at pad": pad}
    )


def test_a_network_by_hand(robot):
    """Updated at 8 Hz, all at once, from the values before; held in between."""
    found = play(robot, None, 100, felt())
    mix = total = clock = 0.0
    for k in range(100):
        if k == 0 or int(k * DT * 8 + 0.01) > int((k - 1) * DT * 8 + 0.01):
            wave = (np.sin(2 * np.pi / 0.8 * (k * DT - 0.8 * 0.3)) + 1) / 2
            activity = 0.2 * 3.0 - 0.7 * 0.5 + 1.5 * total
            weighted = 0.5 * 0.6 + 0.4 * clock + 0.3 * mix - 0.25 * total
            mix = 1 / (1 + np.exp(-0.9 * (activity - 0.1)))
            total = 0.7 * (weighted + 0.2)
            clock = 0.5 - 0.3 + 0.6 * wave
        expected = REACH * (2 * np.clip([mix, total, 0.5], 0, 1) - 1)
        assert found[k] == pytest.approx(expected, abs=1e-9), k
    assert len(np.unique(found[:, 0])) == 4


def test_what_it_asks_to_feel_and_what_may_evolve(robot):
    controller = make_neural_network(plant_of(robot), robot.morphology)
    assert set(controller.signals) == {"force", "cells", "at pad"}
    # Seven weights, as that into the oscillator does nothing; three and three times two numbers.
    assert controller.num_genes == 7 + 3 + 6 == len(set(controller.gene_names))
    assert "weight 8 sum>clock" not in controller.gene_names
    assert "period clock" in controller.gene_names and "bias mix" in controller.gene_names


def test_what_has_evolved_is_saved_and_runs_the_same(robot, tmp_path):
    count = make_neural_network(plant_of(robot), robot.morphology).num_genes
    genes = np.random.default_rng(0).normal(size=count)
    brain = evolve_brain(robot.morphology.brain, genes)
    mapping = robot.morphology.to_mapping() | {"brain": brain}
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(mapping, sort_keys=False))
    again = build_robot(load_morphology(tmp_path / "robot.yaml"), world())
    expected = play(robot, genes, 200, felt())
    assert play(again, None, 200, felt()) == pytest.approx(expected, abs=1e-12)
    assert np.abs(expected - play(robot, None, 200, felt())).max() > 0.1
    assert "amplitude" not in brain["params"]["clock"]  # written as it was
    params = robot.morphology.brain["params"]
    assert params["mix"]["bias"] == 0.1  # which stays as it is
    shared = robot.morphology.brain | {"params": params | {"sum": params["mix"]}}  # YAML's alias
    made = evolve_brain(shared, genes)["params"]
    assert made["mix"]["bias"] != made["sum"]["bias"]


def changed(pattern, text):
    return re.sub(pattern, text, ROBOT, count=1)


@pytest.mark.parametrize(
    ("pattern", "text", "message"),
    [
("type: Sigmoid", "type: XOscillator", "brain.neurons.7.type: expected one of Input, "
         "Simple, Sigmoid, Oscillator; found 'XOscillator'"),
("dst: mix, weight: 0.2", "dst: nix, weight: 0.2", "brain.connections.0.dst: expected the "
         "id of a neuron that is no input; found 'nix'"),
("part_id: arm", "part_id: hand", "brain.neurons.mix.part_id: expected the id of a hinge "
         "or a thruster; found 'hand'")
],
)  # fmt: skip
def test_wrong_networks(pattern, text, message):
    robot = build_robot(read(changed(pattern, text)), world())
    given = plant_of(robot), robot.morphology, "mine.yaml"
    check_refused(f"mine.yaml: {message}", make_neural_network, *given)


def test_what_a_file_may_have_for_a_brain(robot):
    plant, settings = plant_of(robot), ControllerConfig(type="brain", points=4)

    def find(brain):
        body = read(re.sub(r"brain:.*", f"brain: {brain}", ROBOT, flags=re.DOTALL))
        return find_controller(plant, settings, "run.yaml", body=body)

    assert find("{type: rlpower-splines}").num_genes == 4 * 3 + 1
    for brain, message in (
        ("{type: bo-cpg}", "brain: expected neurons and connections, or type: rlpower-splines (its "
         "oscillators are those of controller.type cpg); found 'bo-cpg'"),
        ("null", "rlpower-splines; found none"),
        ("{learner: x}", "rlpower-splines; found {'learner': 'x'}"),
    ):  # fmt: skip
        check_refused(message, find, brain)
    check_refused(
        "run.yaml: controller.points: expected 8, as the brain of ", find_controller, plant,
        settings, "run.yaml", body=read(ROBOT),
    )  # fmt: skip
    with pytest.raises(InputError, match=r"run.yaml: controller.type: expected another one, as"):
        find_controller(plant, settings, "run.yaml")
