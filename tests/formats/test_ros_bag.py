"""ROS 2 bags that rosbags wrote, as mcap-ros2-support reads them."""

import itertools
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from exports import odd_episode
from mjx_revolve.engine.forces import motor_torques
from mjx_revolve.formats.links import make_links
from mjx_revolve.formats.ros_bag import pick_rows, write_bag
from mjx_revolve.numerics.spatial import quat_to_matrix


@pytest.fixture(scope="module")
def episode():
    return odd_episode()


@pytest.fixture(scope="module")
def bag(episode, tmp_path_factory):
    """Messages by topic, as mcap-ros2-support decodes them, and the file's summary."""
    pytest.importorskip("rosbags", reason="the package rosbags writes bags")
    pytest.importorskip("mcap_ros2", reason="the package mcap-ros2-support reads bags")
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    path, found = tmp_path_factory.mktemp("bag") / "rollout.mcap", {}
    write_bag(episode.robot, episode.trajectory, path)
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        header, summary = reader.get_header(), reader.get_summary()
        for _, channel, record, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((record.log_time, message))
    return SimpleNamespace(topics=found, summary=summary, header=header)


def test_bag_holds_every_pose_in_order(bag, episode):
    rows, stamps = pick_rows(episode.robot, episode.trajectory)
    assert bag.header.profile == "ros2"
    counts = {topic: len(messages) for topic, messages in bag.topics.items()}
    moving = ("/tf", "/odom", "/joint_states", "/joint_targets", "/thruster_commands")
    assert counts == dict.fromkeys(moving, len(rows)) | {"/tf_static": 1, "/robot_description": 1}
    for topic in moving:
        times = [time for time, _ in bag.topics[topic]]
        assert times == list(stamps)
        assert all(b > a for a, b in itertools.pairwise(times))
    for topic in ("/odom", "/joint_states", "/joint_targets"):
        for time, message in bag.topics[topic]:
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == time
    # 100 Hz: every second step of 5 ms.
    np.testing.assert_array_equal(np.diff(stamps), 10**7)
    kinds = {schema.name: schema.encoding for schema in bag.summary.schemas.values()}
    assert kinds["tf2_msgs/msg/TFMessage"] == "ros2msg"
    assert {channel.message_encoding for channel in bag.summary.channels.values()} == {"cdr"}
    latched = {
        channel.topic
        for channel in bag.summary.channels.values()
        if "durability: 1" in channel.metadata["offered_qos_profiles"]
    }
    assert latched == {"/tf_static", "/robot_description"}


def test_bag_transforms_lead_to_every_link(bag, episode):
    """From the world down each chain: MuJoCo's own positions and rotations."""
    robot, links = episode.robot, make_links(episode.robot)
    rows, _ = pick_rows(robot, episode.trajectory)
    data = mujoco.MjData(robot.mj_model)
    ((_, still),) = bag.topics["/tf_static"]
    for k, (_, message) in enumerate(bag.topics["/tf"]):
        poses = {"world": (np.zeros(3), np.eye(3))}
        for one in [*still.transforms, *message.transforms]:
            p, q = one.transform.translation, one.transform.rotation
            position, turn = poses[one.header.frame_id]
            poses[one.child_frame_id] = (
                position + turn @ [p.x, p.y, p.z],
                turn @ quat_to_matrix([q.w, q.x, q.y, q.z]),
            )
        data.qpos[:] = np.asarray(episode.trajectory.qpos)[rows[k]]
        mujoco.mj_kinematics(robot.mj_model, data)
        for link in links:
            np.testing.assert_allclose(poses[link.name][0], data.xpos[link.body], atol=1e-9)
            np.testing.assert_allclose(
                poses[link.name][1], data.xmat[link.body].reshape(3, 3), atol=1e-9
            )
    assert [t.child_frame_id for t in message.transforms] == [link.name for link in links]


def test_bag_odometry_is_in_its_frames(bag, episode):
    rows, _ = pick_rows(episode.robot, episode.trajectory)
    for k, (_, message) in enumerate(bag.topics["/odom"]):
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
        qpos = np.asarray(episode.trajectory.qpos, float)[rows[k]]
        qvel = np.asarray(episode.trajectory.qvel, float)[rows[k]]
        p, twist = message.pose.pose.position, message.twist.twist
        v, w = twist.linear, twist.angular
        np.testing.assert_allclose([p.x, p.y, p.z], qpos[:3])
        turn = quat_to_matrix(qpos[3:7] / np.linalg.norm(qpos[3:7]))
        np.testing.assert_allclose([v.x, v.y, v.z], turn.T @ qvel[:3], atol=1e-9)
        np.testing.assert_allclose([w.x, w.y, w.z], qvel[3:6], atol=1e-9)


def test_bag_joint_states_are_the_trajectorys(bag, episode):
    robot, trajectory = episode.robot, episode.trajectory
    rows, _ = pick_rows(robot, trajectory)
    some = (np.asarray(x)[rows] for x in (trajectory.qpos, trajectory.qvel, trajectory.ctrl))
    torque = motor_torques(robot, *some)
    for k, (_, message) in enumerate(bag.topics["/joint_states"]):
        assert list(message.name) == ["arm_1", "arm_1_2"]
        np.testing.assert_allclose(message.position, np.asarray(trajectory.qpos)[rows[k], 7:])
        np.testing.assert_allclose(message.velocity, np.asarray(trajectory.qvel)[rows[k], 6:])
        np.testing.assert_allclose(message.effort, torque[k])
    ctrl = np.asarray(trajectory.ctrl)[rows]
    found = [message.position for _, message in bag.topics["/joint_targets"]]
    np.testing.assert_allclose(found, ctrl[:, list(robot.servos)])
    assert bag.topics["/thruster_commands"][0][1].layout.dim[0].label == "jet"
    found = [message.data[0] for _, message in bag.topics["/thruster_commands"]]
    np.testing.assert_allclose(found, np.asarray(trajectory.command)[rows, 0])


def test_torque_is_the_servos(episode):
    """Below its limits a servo pulls with its stiffness; far off its target, with its effort."""
    robot = episode.robot
    joint = make_links(robot)[1].joint
    angle, far = 0.01, 0.5
    rows = (
        np.array([[0, 0, 0, 1, 0, 0, 0, angle, 0.0]] * 2),
        np.zeros((2, 8)),
        np.array([[0.02, 0.0, 0.0], [far, 0.0, -far]]),  # a thruster is in the middle
    )
    torque = motor_torques(robot, *rows)
    assert torque[0, 0] == pytest.approx(joint.stiffness * 0.01, rel=1e-4)
    np.testing.assert_allclose(torque[1], [joint.effort, -joint.effort], rtol=1e-5)


def test_bag_describes_the_robot_without_files(bag, episode):
    ((_, message),) = bag.topics["/robot_description"]
    assert "<mesh" not in message.data
    model = mujoco.MjModel.from_xml_string(message.data)
    frames = {one.child_frame_id for one in bag.topics["/tf"][0][1].transforms}
    assert frames == {model.body(k).name for k in range(1, model.nbody)}
