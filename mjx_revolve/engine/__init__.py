"""A body compiled and stepped in a world: MuJoCo model, tables, contact, servos, the step."""
