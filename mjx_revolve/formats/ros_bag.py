"""A rollout as a ROS 2 bag (MCAP), written without ROS.

The package `rosbags` knows ROS 2's message types and encodes them. Frames follow REP 105: `world`
and `odom` are the simulation's world, `base_link` is the core; angles, axes and units follow
REP 103.
"""

from __future__ import annotations

import importlib.util
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.torques import motor_torques
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.formats.links import BASE, ODOM, WORLD, Link, make_links
from mjx_revolve.formats.urdf import make_urdf
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import write_atomic

# Messages per second, unless the simulation steps more slowly [1/s].
RATE = 100.0

# Topics whose one message reaches those who listen later.
_LATCHED = ("/tf_static", "/robot_description")


def check_rosbags() -> None:
    """Whether bags can be written here.

    Raises:
        InputError: the package that does it is missing.
    """
    if importlib.util.find_spec("rosbags") is None:
        raise InputError(
            "--mcap: expected the package rosbags; found none (pip install 'mjx_revolve[ros]')"
        )


def write_bag(robot: Robot, trajectory: Trajectory, path: Path) -> None:
    """Writes what a robot did.

    - `/tf` (`tf2_msgs/TFMessage`): `odom` to `base_link`, and each link from its parent;
    - `/tf_static`: `world` to `odom`, which are the same;
    - `/joint_states` (`sensor_msgs/JointState`): angle [rad], speed [rad/s] and torque of the
      motor [N·m] of each hinge;
    - `/joint_targets` (`sensor_msgs/JointState`): the angles that the controller asked for [rad];
    - `/odom` (`nav_msgs/Odometry`): pose in `odom`, velocities in `base_link`;
    - `/thruster_commands` (`std_msgs/Float64MultiArray`): behind their lag [-], where there are
      thrusters;
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
    check_rosbags()

    def write(place: Path) -> None:
        with tempfile.TemporaryDirectory() as folder:
            # The bag's index names the file as it will be called.
            bag = Path(folder) / path.stem
            _write(robot, trajectory, bag)
            shutil.copyfile(bag / f"{bag.name}.mcap", place)

    write_atomic(path, write)


def joint_torques(robot: Robot, trajectory: Trajectory, rows: np.ndarray) -> np.ndarray:
    """Torque of the motors, by the servos' own law, without the joints' friction.

    Args:
        robot: that made the trajectory.
        trajectory: what it did.
        rows: `[S]` of it.

    Returns:
        `[S, nhinge]` in the order of the links' joints [N·m].
    """
    some = (np.asarray(x)[rows] for x in (trajectory.qpos, trajectory.qvel, trajectory.ctrl))
    return motor_torques(robot, *some)


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
    finite = np.isfinite(np.asarray(trajectory.qpos)).all(-1)
    finite &= np.isfinite(np.asarray(trajectory.qvel)).all(-1)
    count = len(finite) if finite.all() else int(finite.argmin())
    if count == 0:
        raise InputError("rollout: expected finite poses; found none")
    every = min(max(1, round(1 / (RATE * timestep))), count)
    rows = np.arange(every - 1, count, every)
    # From the number of the step: the trajectory's own times are rounded to single precision.
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
        for topic, kind, stamp, message in _messages(robot, trajectory, _Messages(store)):
            if topic not in channels:
                quality = [_quality(latched=topic in _LATCHED)]
                channels[topic] = writer.add_connection(
                    topic, kind, typestore=store, offered_qos_profiles=quality
                )
            writer.write(channels[topic], stamp, store.serialize_cdr(message, kind))


def _quality(latched: bool) -> Any:
    """ROS 2's quality of service: reliable; latched topics reach those who listen later."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    forever = QosTime(9223372036, 854775807)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )


def _messages(
    robot: Robot, trajectory: Trajectory, make: _Messages
) -> Iterator[tuple[str, str, int, Any]]:
    """Topic, type, time [ns] and message, in the order of time."""
    links, model = make_links(robot), robot.mj_model
    rows, stamps = pick_rows(robot, trajectory)
    qpos = np.asarray(trajectory.qpos, np.float64)[rows]
    qvel = np.asarray(trajectory.qvel, np.float64)[rows]
    ctrl = np.asarray(trajectory.ctrl, np.float64)[rows]
    torques = joint_torques(robot, trajectory, rows)
    joints = [int(model.body_jntadr[link.body]) for link in links[1:]]
    drive = {int(model.actuator_trnid[k, 0]): k for k in robot.servos}
    # Encoding wants each row in one piece.
    angles, speeds, targets = map(
        np.ascontiguousarray,
        (
            qpos[:, model.jnt_qposadr[joints]],
            qvel[:, model.jnt_dofadr[joints]],
            ctrl[:, [drive[j] for j in joints]],
        ),
    )
    names, none = [link.joint.name for link in links if link.joint is not None], np.zeros(0)
    moving, joint_state = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/JointState"

    first, text = int(stamps[0]), "std_msgs/msg/String"
    yield "/robot_description", text, first, make(text, data=make_urdf(robot, meshes=None))
    fixed = make.transform(first, WORLD, ODOM, np.zeros(3), np.array([1.0, 0, 0, 0]))
    yield "/tf_static", moving, first, make(moving, transforms=[fixed])
    for k, stamp in enumerate(map(int, stamps)):
        base = qpos[k, 3:7] / np.linalg.norm(qpos[k, 3:7])
        frames = [make.transform(stamp, ODOM, BASE, qpos[k, :3], base)]
        for link, angle in zip(links[1:], angles[k], strict=True):
            parent = links[link.parent].name
            pose = _turned(model.body_quat[link.body], link, angle)
            frames.append(make.transform(stamp, parent, link.name, link.position, pose))
        yield "/tf", moving, stamp, make(moving, transforms=frames)
        odometry = make.odometry(stamp, qpos[k, :3], base, qvel[k, :6])
        yield "/odom", "nav_msgs/msg/Odometry", stamp, odometry
        if names:
            head = make.header(stamp, "")
            states = make.joints(head, names, angles[k], speeds[k], torques[k])
            yield "/joint_states", joint_state, stamp, states
            aims = make.joints(head, names, targets[k], none, none)
            yield "/joint_targets", joint_state, stamp, aims
        if robot.num_thrusters:
            commands = make.commands(robot, trajectory, int(rows[k]))
            yield "/thruster_commands", "std_msgs/msg/Float64MultiArray", stamp, commands


def _turned(rest: np.ndarray, link: Link, angle: float) -> np.ndarray:
    """Quaternion (w, x, y, z) of a link in its parent's frame, its hinge turned."""
    assert link.joint is not None
    w, (x, y, z) = np.cos(angle / 2), np.sin(angle / 2) * link.joint.axis
    a, b, c, d = rest
    return np.array(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


class _Messages:
    """Makes messages of ROS 2's types."""

    def __init__(self, store: Any) -> None:
        self._types = store.types

    def __call__(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def stamp(self, time: int) -> Any:
        """A time [ns]."""
        return self("builtin_interfaces/msg/Time", sec=time // 10**9, nanosec=time % 10**9)

    def header(self, time: int, frame: str) -> Any:
        """Time [ns] and frame."""
        return self("std_msgs/msg/Header", stamp=self.stamp(time), frame_id=frame)

    def vector(self, xyz: Any, kind: str = "geometry_msgs/msg/Vector3") -> Any:
        """Three numbers."""
        x, y, z = map(float, xyz)
        return self(kind, x=x, y=y, z=z)

    def quaternion(self, wxyz: np.ndarray) -> Any:
        """ROS has (x, y, z, w)."""
        w, x, y, z = map(float, wxyz)
        return self("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def joints(self, header: Any, names: list[str], *values: np.ndarray) -> Any:
        """Angles, speeds and torques of joints."""
        fields = dict(zip(("position", "velocity", "effort"), values, strict=True))
        return self("sensor_msgs/msg/JointState", header=header, name=names, **fields)

    def transform(
        self, time: int, parent: str, child: str, position: np.ndarray, quat: np.ndarray
    ) -> Any:
        """Pose of the child in the parent's frame."""
        pose = self(
            "geometry_msgs/msg/Transform",
            translation=self.vector(position),
            rotation=self.quaternion(quat),
        )
        return self(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(time, parent),
            child_frame_id=child,
            transform=pose,
        )

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
        w, axis = quat[0], quat[1:]
        linear = velocity[:3]
        # The inverse rotation: v - 2 w (a × v) + 2 a × (a × v).
        side = np.cross(axis, linear)
        linear = linear - 2 * w * side + 2 * np.cross(axis, side)
        pose = self(
            "geometry_msgs/msg/Pose",
            position=self.vector(position, "geometry_msgs/msg/Point"),
            orientation=self.quaternion(quat),
        )
        twist = self(
            "geometry_msgs/msg/Twist",
            linear=self.vector(linear),
            angular=self.vector(velocity[3:]),
        )
        none = np.zeros(36)
        return self(
            "nav_msgs/msg/Odometry",
            header=self.header(time, ODOM),
            child_frame_id=BASE,
            pose=self("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=none),
            twist=self("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=none),
        )

    def commands(self, robot: Robot, trajectory: Trajectory, row: int) -> Any:
        """Commands of the thrusters; the layout's label names them."""
        if trajectory.command is None:
            values = np.asarray(trajectory.ctrl)[row, list(robot.thrusters)]
        else:
            values = np.asarray(trajectory.command)[row]
        names = [robot.mj_model.actuator(k).name for k in robot.thrusters]
        count = len(names)
        dimension = self(
            "std_msgs/msg/MultiArrayDimension", label=",".join(names), size=count, stride=count
        )
        layout = self("std_msgs/msg/MultiArrayLayout", dim=[dimension], data_offset=0)
        return self(
            "std_msgs/msg/Float64MultiArray", layout=layout, data=np.asarray(values, np.float64)
        )
