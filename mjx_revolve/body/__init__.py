"""What a robot is: types of modules, their tree, its rest pose, its measures. No worlds, no JAX."""
