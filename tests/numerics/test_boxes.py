"""Penetration of turned boxes: against MuJoCo's collisions, and by moving them apart."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_revolve.numerics.boxes import BoxPair, box_contact, box_gap, pair_of

XML = """<mujoco><worldbody>
  <body><freejoint/><geom name="a" type="box" size=".1 .1 .1"/></body>
  <body><freejoint/><geom name="b" type="box" size=".1 .1 .1"/></body>
</worldbody></mujoco>"""


def draw_pairs(count: int, near: float) -> tuple[np.ndarray, ...]:
    """Boxes of all shapes and attitudes, their centres up to `near` m apart; some aligned."""
    draw = np.random.default_rng(0)
    half = draw.uniform(0.01, 0.05, (2, count, 3))
    turn = Rotation.random(2 * count, random_state=0).as_matrix().reshape(2, count, 3, 3)
    turn[1, ::5] = turn[0, ::5]
    center = draw.uniform(-near / 2, near / 2, (2, count, 3))
    return center[0], turn[0], half[0], center[1], turn[1], half[1]


def test_depth_is_the_least_translation_that_parts_the_boxes():
    boxes = draw_pairs(2000, 0.08)
    contact = box_contact(pair_of(*boxes))
    gap = np.asarray(contact.gap)
    np.testing.assert_allclose(box_gap(pair_of(*boxes)), gap, atol=1.1e-5)
    normal = np.stack(contact.normal, -1)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-12)
    hit = gap < -1e-4
    assert hit.sum() > 1000
    moved = list(boxes)
    moved[3] = boxes[3] - gap[:, None] * normal
    assert np.all(box_gap(pair_of(*moved))[hit] > -2e-5)
    # No other of many directions parts them sooner.
    for way in Rotation.random(40, random_state=1).as_matrix()[:, 0]:
        moved[3] = boxes[3] + 0.99 * np.maximum(-gap, 0)[:, None] * way
        assert np.all(box_gap(pair_of(*moved))[hit] < 1e-5)


def test_contacts_are_mujocos():
    """MuJoCo's own contact of two boxes: whether, how deep, and along which normal."""
    model = mujoco.MjModel.from_xml_string(XML)
    data = mujoco.MjData(model)
    boxes = draw_pairs(400, 0.12)
    contact = box_contact(pair_of(*boxes))
    normal, point = np.stack(contact.normal, -1), np.stack(contact.point, -1) + boxes[0]
    seen = aligned = 0
    for k in range(400):
        for body in range(2):
            model.geom_size[body] = boxes[2 + 3 * body][k]
            data.qpos[7 * body : 7 * body + 3] = boxes[3 * body][k]
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, boxes[1 + 3 * body][k].ravel())
            data.qpos[7 * body + 3 : 7 * body + 7] = quat
            model.geom_rbound[body] = np.linalg.norm(model.geom_size[body])
            model.geom_aabb[body, 3:] = model.geom_size[body]
        mujoco.mj_forward(model, data)
        if abs(contact.gap[k]) < 1e-4:
            continue
        assert (data.ncon > 0) == (contact.gap[k] < 0), k
        if not -0.01 < contact.gap[k] < 0:  # deeper, several axes are as good
            continue
        seen += 1
        found = data.contact[: data.ncon]
        deepest = min(found, key=lambda c: c.dist)
        assert deepest.dist == pytest.approx(contact.gap[k], abs=2e-5)
        if abs(deepest.frame[:3] @ normal[k]) > 0.999:  # else as deep along another axis
            aligned += 1
    assert aligned > 0.9 * seen
    # Our point lies between the two surfaces, and so in both boxes.
    for center, turn, half in (boxes[:3], boxes[3:]):
        local = (turn.swapaxes(1, 2) @ (point - center)[..., None])[..., 0]
        beyond = (np.abs(local) - half).max(1)[contact.gap < 0]
        assert np.quantile(beyond, 0.95) < 1e-3
        assert beyond.max() < 0.01
    assert seen > 30


def test_point_of_flat_faces_is_the_middle_of_what_they_share():
    unit = np.eye(3)[None]
    boxes = (
        np.zeros((1, 3)), unit, np.array([[0.05, 0.05, 0.05]]),
        np.array([[0.03, 0.04, 0.069]]), unit, np.array([[0.04, 0.04, 0.02]]),
    )  # fmt: skip
    contact = box_contact(pair_of(*boxes))
    assert contact.gap[0] == pytest.approx(-0.001)
    np.testing.assert_allclose(np.ravel(contact.normal), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.ravel(contact.point), [0.02, 0.025, 0.0495], atol=1e-9)


def test_a_box_that_would_pass_through_another_within_a_step_is_seen():
    unit, thin = np.eye(3)[None], np.array([[0.05, 0.05, 0.001]])
    now = pair_of(np.zeros((1, 3)), unit, thin, np.array([[0.0, 0.0, 0.01]]), unit, thin)
    ahead = now._replace(offset=now.offset - np.array([[0], [0], [0.02]]))
    contact = box_contact(now, ahead)
    assert contact.gap[0] == pytest.approx(-0.012)
    assert contact.normal[2][0] == 1
    assert box_gap(ahead)[0] == pytest.approx(0.008)


@pytest.mark.slow
def test_runs_under_jit_with_finite_gradients():
    boxes = draw_pairs(200, 0.1)
    pair = pair_of(*boxes)
    expected = box_contact(pair)
    with jax.enable_x64(True):
        made = jax.tree.map(jnp.asarray, pair)
        found = jax.jit(box_contact)(made)
        np.testing.assert_allclose(found.gap, expected.gap, atol=1e-12)
        np.testing.assert_allclose(found.point, expected.point, atol=1e-9)

        def total(pair: BoxPair) -> jax.Array:
            contact = box_contact(pair)
            return sum(jnp.sum(x) for x in (contact.gap, *contact.normal, *contact.point))

        slopes = jax.jit(jax.grad(total))(made)
        assert all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(slopes))
