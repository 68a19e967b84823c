"""A ROS 2 node around a brain's Python file."""

from __future__ import annotations

from mjx_revolve.formats.brain import Brain, describe_brain

# What standard messages hold, by reading; all else comes as plain numbers.
_JOINTS = {"angle": "position", "speed": "velocity", "load": "effort"}
_IMU = {
    "up": "self._rotation(message.orientation)[2]",
    "north": "self._rotation(message.orientation)[0]",
    "angular_velocity": "self._xyz(message.angular_velocity)",
    "force": "self._xyz(message.linear_acceleration)",
}


def make_brain_node(brain: Brain, stem: str) -> str:
    """Writes a ROS 2 node that runs a brain.

    Args:
        brain: from `make_brain`.
        stem: name of the Python file beside it, without its ending.

    Returns:
        A script; it needs rclpy and the brain's file. Topics and units are those of our bags.
    """
    names = [signal.name for signal in brain.signals]
    joints = {name: field for name, field in _JOINTS.items() if name in names}
    inertial = {name: text for name, text in _IMU.items() if name in names}
    others = [name for name in names if name not in joints and name not in inertial]
    hinges, jets = brain.commands[: brain.num_hinges], brain.commands[brain.num_hinges :]
    topics, setup, readers = [], [], []
    if joints:
        topics.append(f"/joint_states (sensor_msgs/JointState): {', '.join(joints.values())}")
        setup.append(
            "self.create_subscription(JointState, '/joint_states', self.read_joints, _QOS)"
        )
        lines = "".join(_JOINT.format(name=name, field=field) for name, field in joints.items())
        readers.append(_READ_JOINTS + lines)
    if inertial:
        topics.append(
            "/imu (sensor_msgs/Imu), in the core's frame, the orientation that of the core in a "
            "frame whose z is up"
        )
        setup.append("self.create_subscription(Imu, '/imu', self.read_imu, _QOS)")
        lines = "".join(
            f"        self.sensors[{name!r}] = {text}\n" for name, text in inertial.items()
        )
        readers.append(_READ_IMU + lines + _IMU_HELPERS)
    for name in others:
        topics.append(f"/sensors/{name} (std_msgs/Float64MultiArray)")
        read = f"lambda message: self.sensors.update({name}=list(message.data))"
        setup.append(
            f"self.create_subscription(Float64MultiArray, '/sensors/{name}', {read}, _QOS)"
        )
    out = []
    if hinges:
        setup.append("self.targets = self.create_publisher(JointState, '/joint_targets', 10)")
        out.append(_TARGETS)
    if jets:
        topic = "'/thruster_commands'"
        setup.append(f"self.thrust = self.create_publisher(Float64MultiArray, {topic}, 10)")
        out.append(_THRUST)
    published = ["/joint_targets (sensor_msgs/JointState): position"] * bool(hinges)
    published += ["/thruster_commands (std_msgs/Float64MultiArray)"] * bool(jets)
    title, _, interface = describe_brain(brain)
    return _NODE.format(
        title=title.rstrip(".") + ", as a ROS 2 node.",
        stem=stem,
        topics="\n".join(f"- {topic}" for topic in topics) or "- nothing: it feels nothing",
        published="\n".join(f"- {topic}" for topic in published) or "- nothing",
        interface="\n".join(interface),
        hinges=list(hinges),
        setup="\n".join(f"        {line}" for line in setup),
        readers="".join(f"\n{text}" for text in readers),
        out="".join(out),
    )


_NODE = '''"""{title}

It waits until each of its sensors has spoken, then commands at the brain's rate from time 0. A
sensor that falls silent is not noticed: its last numbers count on.

Subscribes to
{topics}
Publishes
{published}

{interface}
"""

import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray

from {stem} import RATE, SENSORS, Brain

HINGES = {hinges}
_QOS = qos_profile_sensor_data  # hears reliable senders, and others


class BrainNode(Node):
    """Runs the brain."""

    def __init__(self):
        super().__init__("brain")
        self.brain, self.sensors, self.count = Brain(), {{}}, 0
        self.joints = {{name: {{}} for name in SENSORS}}
{setup}
        self.create_timer(1.0 / RATE, self.step)
{readers}
    def step(self):
        """Commands, once all sensors have spoken."""
        if any(name not in self.sensors for name in SENSORS):
            return
        commands = [float(x) for x in self.brain.step(self.count / RATE, self.sensors)]
        self.count += 1
{out}

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

_TARGETS = """        targets = JointState()
        targets.header.stamp = self.get_clock().now().to_msg()
        targets.name, targets.position = HINGES, commands[: len(HINGES)]
        self.targets.publish(targets)
"""

_THRUST = """        thrust = Float64MultiArray()
        thrust.data = commands[len(HINGES) :]
        self.thrust.publish(thrust)
"""

_READ_JOINTS = '''    def read_joints(self, message):
        """By name, as drivers have orders of their own and may send some joints at a time."""
'''

_JOINT = """        self.joints[{name!r}].update(zip(message.name, message.{field}))
        if all(hinge in self.joints[{name!r}] for hinge in HINGES):
            self.sensors[{name!r}] = [self.joints[{name!r}][hinge] for hinge in HINGES]
"""

_READ_IMU = '''    def read_imu(self, message):
        """Attitude and motion of the core."""
'''

_IMU_HELPERS = '''
    @staticmethod
    def _xyz(vector):
        return vector.x, vector.y, vector.z

    @staticmethod
    def _rotation(q):
        """World from core, its rows."""
        return (
            (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y - q.z * q.w), 2 * (q.x * q.z + q.y * q.w)),
            (2 * (q.x * q.y + q.z * q.w), 1 - 2 * (q.x**2 + q.z**2), 2 * (q.y * q.z - q.x * q.w)),
            (2 * (q.x * q.z - q.y * q.w), 2 * (q.y * q.z + q.x * q.w), 1 - 2 * (q.x**2 + q.y**2)),
        )
'''
