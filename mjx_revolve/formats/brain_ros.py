"""A ROS 2 node around a brain's Python file."""

from __future__ import annotations

from mjx_revolve.formats.brain import Brain, describe_brain


def make_brain_node(brain: Brain, stem: str) -> str:
    """Writes a ROS 2 node that runs a brain.

    Args:
        brain: from `make_brain`.
        stem: name of the Python file beside it, without its ending.

    Returns:
        A script; it needs rclpy and the brain's file. Topics and units are those of our bags.
    """
    title, _, interface = describe_brain(brain)
    return _NODE.format(
        title=title.rstrip(".") + ", as a ROS 2 node.",
        stem=stem,
        interface="\n".join(interface),
        count=brain.num_hinges,
    )


_NODE = '''"""{title}

Of what its brain uses, it takes angle, speed and load of the joints from /joint_states
(sensor_msgs/JointState); up, north, angular_velocity and force from /imu (sensor_msgs/Imu, in the
core's frame, its orientation that of the core in a frame with z up); each other sensor from
/sensors/NAME (std_msgs/Float64MultiArray). It publishes /joint_targets (sensor_msgs/JointState)
and /thruster_commands (std_msgs/Float64MultiArray).

It waits until each of its sensors has spoken, then commands at the brain's rate from time 0. A
sensor that falls silent is not noticed: its last numbers count on.

{interface}
"""

from functools import partial

import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray

from {stem} import COMMANDS, RATE, SENSORS, Brain

HINGES = COMMANDS[:{count}]
JOINTS = {{"angle": "position", "speed": "velocity", "load": "effort"}}
IMU = ("up", "north", "angular_velocity", "force")


class BrainNode(Node):
    """Runs the brain."""

    def __init__(self):
        super().__init__("brain")
        self.brain, self.sensors, self.count = Brain(), {{}}, 0
        self.joints = {{name: {{}} for name in JOINTS}}
        if any(name in SENSORS for name in JOINTS):
            self.hear(JointState, "/joint_states", self.read_joints)
        if any(name in SENSORS for name in IMU):
            self.hear(Imu, "/imu", self.read_imu)
        for name in SENSORS:
            if name not in JOINTS and name not in IMU:
                self.hear(Float64MultiArray, f"/sensors/{{name}}", partial(self.read, name))
        self.targets = self.create_publisher(JointState, "/joint_targets", 10)
        self.thrust = self.create_publisher(Float64MultiArray, "/thruster_commands", 10)
        self.create_timer(1.0 / RATE, self.step)

    def hear(self, kind, topic, callback):
        """Reliable senders and others."""
        self.create_subscription(kind, topic, callback, qos_profile_sensor_data)

    def read(self, name, message):
        """Numbers as they come."""
        self.sensors[name] = list(message.data)

    def read_joints(self, message):
        """By name: drivers have orders of their own, and may send some joints at a time."""
        for name, field in JOINTS.items():
            known = self.joints[name]
            known.update(zip(message.name, getattr(message, field)))
            if all(hinge in known for hinge in HINGES):
                self.sensors[name] = [known[hinge] for hinge in HINGES]

    def read_imu(self, message):
        """Attitude and motion of the core."""
        q, spin, force = message.orientation, message.angular_velocity, message.linear_acceleration
        # Rows of the rotation from the core to the world: the world's z and x in the core's frame.
        self.sensors["up"] = (
            2 * (q.x * q.z - q.y * q.w), 2 * (q.y * q.z + q.x * q.w), 1 - 2 * (q.x**2 + q.y**2)
        )
        self.sensors["north"] = (
            1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y - q.z * q.w), 2 * (q.x * q.z + q.y * q.w)
        )
        self.sensors["angular_velocity"] = spin.x, spin.y, spin.z
        self.sensors["force"] = force.x, force.y, force.z

    def step(self):
        """Commands, once all sensors have spoken."""
        if any(name not in self.sensors for name in SENSORS):
            return
        commands = [float(x) for x in self.brain.step(self.count / RATE, self.sensors)]
        self.count += 1
        if HINGES:
            targets = JointState(name=HINGES, position=commands[: len(HINGES)])
            targets.header.stamp = self.get_clock().now().to_msg()
            self.targets.publish(targets)
        if len(commands) > len(HINGES):
            self.thrust.publish(Float64MultiArray(data=commands[len(HINGES) :]))


def main():
    """Runs until it is stopped."""
    rclpy.init()
    node = BrainNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
'''
