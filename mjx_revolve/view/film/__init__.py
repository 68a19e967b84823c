"""The film of a robot's episode: frames, camera, stage, light, what is laid over, video."""
