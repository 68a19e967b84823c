"""What bodies are grown from and how they vary. No worlds, brains or evolution; NumPy only."""
