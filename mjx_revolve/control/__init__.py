"""What a robot feels, and genes to parameters to commands, from a table of the plant."""
