"""A rollout as a ROS 2 bag (MCAP), written without ROS.

The package `rosbags` has ROS 2's message types and encodes them. Frames follow REP 105: `world`
and `odom` are the simulation's world, `base_link` is the core; angles, axes and units follow
REP 103.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from mjx_revolve.engine.forces import motor_torques
from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.formats.links import BASE, ODOM, WORLD, Link, make_links
from mjx_revolve.formats.urdf import make_urdf
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.inputs.packages import check_package
from mjx_revolve.numerics.spatial import quat_mul, quat_to_matrix

# About so many messages per second: one every so many whole steps [1/s].
RATE = 100.0

# Latched topics, with one message that late subscribers receive, too.
_LATCHED = ("/tf_static", "/robot_description")


def write_bag(robot: Robot, trajectory: Trajectory, path: str | Path) -> None:
    """Writes a trajectory.

    - `/tf` (`tf2_msgs/TFMessage`): `odom` to `base_link`, and each link from its parent;
    - `/tf_static`: `world` to `odom`, which are the same;
    - `/joint_states` (`sensor_msgs/JointState`): angle [rad], speed [rad/s] and torque of the
      motor [N·m] of each hinge;
    - `/joint_targets` (`sensor_msgs/JointState`): the controller's target angles [rad];
    - `/odom` (`nav_msgs/Odometry`): pose in `odom`, velocities in `base_link`;
    - `/thruster_commands` (`std_msgs/Float64MultiArray`): the controller's, before their lag [-],
      where there are thrusters;
    - `/robot_description` (`std_msgs/String`): the URDF, drawn with boxes, so that RViz and
      Foxglove show the robot without further files.

    Time is the simulation's, from 0. Files appear whole or not at all.

    Args:
        robot: that made the trajectory.
        trajectory: what it did.
        path: of the MCAP file.

    Raises:
        InputError: the package `rosbags` is missing.
        OSError: the file cannot be written.
    """
    check_package("--mcap", "rosbags")
    path = Path(path)

    def write(place: Path) -> None:
        with tempfile.TemporaryDirectory() as folder:
            # The bag's index names the file as it will be called.
            bag = Path(folder) / path.stem
            _write(robot, trajectory, bag)
            shutil.copyfile(bag / f"{bag.name}.mcap", place)

    write_atomic(path, write)


def pick_rows(robot: Robot, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Which rows of a trajectory become messages.

    Args:
        robot: that made the trajectory.
        trajectory: what it did.

    Returns:
        `[S]` rows, up to the first that is not finite, and `[S]` their times [ns].

    Raises:
        InputError: not one row is finite.
    """
    timestep = robot.world.timestep
    finite = np.isfinite(np.hstack([trajectory.qpos, trajectory.qvel])).all(-1)
    count = len(finite) if finite.all() else int(finite.argmin())
    if count == 0:
        raise InputError("rollout", "finite poses", "none")
    every = min(max(1, round(1 / (RATE * timestep))), count)
    rows = np.arange(every - 1, count, every)
    # From the number of the step: the trajectory's own times are rounded to single precision. A
    # replay of many bodies has a row every few steps.
    timestep *= max(1, round(float(trajectory.time[0]) / timestep))
    return rows, np.round(1e9 * timestep * (rows + 1)).astype(np.int64)


def _write(robot: Robot, trajectory: Trajectory, folder: Path) -> None:
    """A bag as `rosbags` writes it: a folder with one MCAP file."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    # Version 8 is what ROS 2 Humble can read, and later ones too.
    bag = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)
    bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    channels: dict[str, Any] = {}
    with bag as writer:
        for topic, stamp, message in _messages(robot, trajectory, _Messages(store)):
            kind = message.__msgtype__
            if topic not in channels:
                quality = [_quality(latched=topic in _LATCHED)]
                channels[topic] = writer.add_connection(
                    topic, kind, typestore=store, offered_qos_profiles=quality
                )
            writer.write(channels[topic], stamp, store.serialize_cdr(message, kind))


def _quality(latched: bool) -> Any:
    """ROS 2's quality of service: reliable; latched topics are transient local."""
    from rosbags import interfaces as ros

    forever = ros.QosTime(9223372036, 854775807)
    return ros.Qos(
        history=ros.QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=ros.QosReliability.RELIABLE,
        durability=getattr(ros.QosDurability, "TRANSIENT_LOCAL" if latched else "VOLATILE"),
        deadline=forever,
        lifespan=forever,
        liveliness=ros.QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )


def _messages(
    robot: Robot, trajectory: Trajectory, make: _Messages
) -> Iterator[tuple[str, int, Any]]:
    """Topic, time [ns] and message, in the order of time."""
    links = make_links(robot)
    joints = [link.joint for link in links if link.joint is not None]
    names, none = [joint.name for joint in joints], np.zeros(0)
    rows, stamps = pick_rows(robot, trajectory)
    whole = trajectory.qpos, trajectory.qvel, trajectory.ctrl
    qpos, qvel, ctrl = (np.asarray(x, np.float64)[rows] for x in whole)
    # The encoder requires contiguous rows.
    angles = np.ascontiguousarray(qpos[:, [joint.qpos for joint in joints]])
    speeds = np.ascontiguousarray(qvel[:, [joint.qvel for joint in joints]])
    targets = np.ascontiguousarray(ctrl[:, [joint.ctrl for joint in joints]])
    # The torque of the motors, without the joints' friction.
    torques = motor_torques(robot, qpos, qvel, ctrl, trajectory.variation)
    torques = np.ascontiguousarray(torques, np.float64)
    commands = ctrl[:, list(robot.thrusters)]
    pushing = [robot.mj_model.actuator(k).name for k in robot.thrusters]

    first, still = int(stamps[0]), np.array([1.0, 0.0, 0.0, 0.0])
    yield "/robot_description", first, make.ros.String(make_urdf(robot, meshes=None))
    fixed = make.transform(first, WORLD, ODOM, np.zeros(3), still)
    yield "/tf_static", first, make.ros.TFMessage([fixed])
    for k, stamp in enumerate(map(int, stamps)):
        base = qpos[k, 3:7] / np.linalg.norm(qpos[k, 3:7])
        frames = [make.transform(stamp, ODOM, BASE, qpos[k, :3], base)]
        for link, angle in zip(links[1:], angles[k], strict=True):
            pose = _turned(robot.mj_model.body_quat[link.body], link, angle)
            parent = links[link.parent].name
            frames.append(make.transform(stamp, parent, link.name, link.position, pose))
        yield "/tf", stamp, make.ros.TFMessage(frames)
        yield "/odom", stamp, make.odometry(stamp, qpos[k, :3], base, qvel[k, :6])
        if names:
            head, state = make.header(stamp, ""), make.ros.JointState
            yield "/joint_states", stamp, state(head, names, angles[k], speeds[k], torques[k])
            yield "/joint_targets", stamp, state(head, names, targets[k], none, none)
        if pushing:
            yield "/thruster_commands", stamp, make.commands(pushing, commands[k])


def _turned(rest: np.ndarray, link: Link, angle: float) -> np.ndarray:
    """Quaternion (w, x, y, z) of a link in its parent's frame, its hinge turned."""
    assert link.joint is not None
    turn = (np.cos(angle / 2), *(np.sin(angle / 2) * np.asarray(link.joint.axis)))
    return np.array(quat_mul(tuple(rest), turn))


class _Messages:
    """Makes messages of ROS 2's types.

    Attributes:
        ros: the types by their short names; their fields are in the order of ROS's definitions.
    """

    def __init__(self, store: Any) -> None:
        self.ros = SimpleNamespace(
            **{name.rpartition("/")[2]: kind for name, kind in store.types.items()}
        )

    def header(self, time: int, frame: str) -> Any:
        """Time [ns] and frame."""
        return self.ros.Header(self.ros.Time(*divmod(time, 10**9)), frame)

    def quaternion(self, wxyz: np.ndarray) -> Any:
        """ROS has (x, y, z, w)."""
        return self.ros.Quaternion(*np.roll(wxyz, -1).tolist())

    def transform(
        self, time: int, parent: str, child: str, position: np.ndarray, quat: np.ndarray
    ) -> Any:
        """Pose of the child in the parent's frame."""
        place = self.ros.Vector3(*position.tolist())
        pose = self.ros.Transform(place, self.quaternion(quat))
        return self.ros.TransformStamped(self.header(time, parent), child, pose)

    def odometry(
        self, time: int, position: np.ndarray, quat: np.ndarray, velocity: np.ndarray
    ) -> Any:
        """Pose in `odom`; velocities in `base_link`, as REP 105 and the message's comment say.

        Args:
            time: [ns].
            position: `[3]` [m].
            quat: `[4]` (w, x, y, z).
            velocity: `[6]` MuJoCo's: linear in the world's frame [m/s], angular in the body's
                [rad/s].
        """
        ros, none = self.ros, np.zeros(36)
        linear = velocity[:3] @ quat_to_matrix(quat)
        pose = ros.Pose(ros.Point(*position.tolist()), self.quaternion(quat))
        twist = ros.Twist(ros.Vector3(*linear.tolist()), ros.Vector3(*velocity[3:].tolist()))
        both = ros.PoseWithCovariance(pose, none), ros.TwistWithCovariance(twist, none)
        return ros.Odometry(self.header(time, ODOM), BASE, *both)

    def commands(self, names: list[str], values: np.ndarray) -> Any:
        """Commands of the thrusters; the layout's label names them."""
        count = len(names)
        dimension = self.ros.MultiArrayDimension(",".join(names), count, count)
        layout = self.ros.MultiArrayLayout([dimension], 0)
        return self.ros.Float64MultiArray(layout, np.ascontiguousarray(values))
