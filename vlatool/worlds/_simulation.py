"""MuJoCo: imported with a way to render that this machine has; steps that stay stable, or an error."""

from __future__ import annotations

import ctypes.util
import importlib
import os
import sys
from typing import Any

from vlatool.errors import InputError, require


def load_mujoco() -> Any:
    """Import MuJoCo, with a way to render that this machine has, unless ``MUJOCO_GL`` names one.

    MuJoCo chooses at its import; where another module has imported it already, it chooses again. Its warnings do not
    write the file MUJOCO_LOG.TXT into the current directory.

    Raises:
        MissingExtra: when it is not installed.
    """
    if "MUJOCO_GL" not in os.environ:
        found = next((name for name in ("EGL", "OSMesa") if ctypes.util.find_library(name)), "")
        if found:
            os.environ["MUJOCO_GL"] = found.lower()
            if (chosen := sys.modules.get("mujoco.gl_context")) is not None:
                importlib.reload(chosen)
    mujoco = require("mujoco", "worlds")
    mujoco.set_mju_user_warning(_leave_to_counts)
    return mujoco


def _leave_to_counts(_text: object) -> None:
    """Do nothing: ``mjData.warning`` counts what was warned of, and ``advance_model`` looks there."""


def advance_model(mujoco: Any, model: Any, data: Any) -> None:
    """Compute one step.

    Raises:
        InputError: when the simulation is unstable: MuJoCo would start again from its first pose and go on.
    """
    mujoco.mj_step(model, data)
    if not data.warning.number.any():
        return
    kinds = mujoco.mjtWarning
    if any(data.warning[kind].number for kind in (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)):
        raise InputError(
            f"The simulated robot became unstable at {data.time:.3f} s: not all of its state is finite.",
            "reset the world; send commands that its motors can follow",
        )
