"""MuJoCo's own renderer into arrays: colours, and how far away they are.

`mujoco.Renderer` gives one or the other, and draws twice for both.
"""

from __future__ import annotations

import contextlib
import importlib
import os
from types import TracebackType
from typing import Any

import mujoco
import numpy as np

# The bed, the robot's parts, and what a user adds in the viewer.
_MOST_GEOMS = 4000
# The sky is a cube about so large, in shares of the far plane's distance; nothing else is that far.
_SKY = 0.3


class Painter:
    """Draws a model's scene into arrays; a context manager, for the context must be freed.

    Args:
        model: what to draw; its offscreen buffer must hold the size.
        size: width and height [pixels].
        way: from `find_opengl`.
    """

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int], way: str) -> None:
        self.model = model
        self.size = size
        self.data = mujoco.MjData(model)
        self.option = mujoco.MjvOption()
        self.camera = mujoco.MjvCamera()
        self.scene = mujoco.MjvScene(model, _MOST_GEOMS)
        self._rect = mujoco.MjrRect(0, 0, *size)
        # PyOpenGL looks at this once, when it is first imported.
        if way in ("egl", "osmesa"):
            os.environ.setdefault("PYOPENGL_PLATFORM", way)
        self._opengl: Any = importlib.import_module(f"mujoco.{way}").GLContext(*size)
        self._opengl.make_current()
        self.context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self.context)
        # Zero far: floats are dense near 0, where the far distances then are.
        self.context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR

    def paint(self) -> tuple[np.ndarray, np.ndarray]:
        """Draws `self.scene`.

        Returns:
            Colours `[height, width, 3]` uint8 and depths along the view `[height, width]` float32
            [m], infinite where nothing is; the first row is the top one.
        """
        width, height = self.size
        color = np.empty((height, width, 3), np.uint8)
        raw = np.empty((height, width), np.float32)
        mujoco.mjr_render(self._rect, self.scene, self.context)
        mujoco.mjr_readPixels(color, raw, self._rect, self.context)
        extent = self.model.stat.extent
        near, far = (extent * z for z in (self.model.vis.map.znear, self.model.vis.map.zfar))
        # OpenGL's hyperbola, from 1 at the near plane to 0 at the far one.
        depth = near * far / (near + raw * (far - near))
        depth[depth > _SKY * far] = np.inf
        return color[::-1], depth[::-1]

    def close(self) -> None:
        """Frees the context."""
        if self._opengl is not None:
            self.context.free()
            # EGL's clean-up may find its library gone already when Python ends.
            with contextlib.suppress(Exception):
                self._opengl.free()
            self._opengl = None

    def __enter__(self) -> Painter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
