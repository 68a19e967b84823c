"""The world and its laws: bed, currents, waves, buoyancy, drag, lift, added mass, thrusters."""
