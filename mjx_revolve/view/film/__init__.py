"""The film of a robot's episode: scene, camera, light, captions, video."""
