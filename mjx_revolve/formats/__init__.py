"""Robots and rollouts for other programs: MJCF, URDF, SDF, ROS bags."""
