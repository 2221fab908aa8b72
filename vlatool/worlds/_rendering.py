"""Cameras of MuJoCo without a screen: EGL or OSMesa, in software where there is no graphics card."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlatool.errors import InstallationError

Array = NDArray[Any]
SYSTEM_PACKAGES = "apt-get install libegl1 libosmesa6"


class Camera:
    """A camera of a model: colours and depth of one moment.

    Raises:
        InstallationError: when nothing renders on this machine.
    """

    def __init__(self, mujoco: Any, model: Any, name: str, rows: int, columns: int) -> None:
        self._name = name
        try:
            self._renderer = mujoco.Renderer(model, rows, columns)
        except Exception as error:  # each way to render raises what it likes
            raise InstallationError(
                f"MuJoCo cannot render: {type(error).__name__}: {error}.", f"{SYSTEM_PACKAGES}, or simulate no camera"
            ) from error
        self.close = weakref.finalize(self, self._renderer.close)
        """Give back what the graphics library holds; done at the end of the process at the latest."""

    def colours(self, data: Any) -> Array:
        """Return uint8 (H, W, 3)."""
        self._renderer.update_scene(data, camera=self._name)
        return np.array(self._renderer.render())

    def depth(self, data: Any) -> Array:
        """Return float32 (H, W): distances along the axis of the camera, in metres."""
        self._renderer.update_scene(data, camera=self._name)
        self._renderer.enable_depth_rendering()
        depth = np.array(self._renderer.render(), np.float32)
        self._renderer.disable_depth_rendering()
        return depth
