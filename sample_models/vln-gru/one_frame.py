"""BabyAI GoToLocal with one frame in an observation: what was seen before it, the policy must remember.

Levels, frames and disturbances are those of the sample policy vln-babyai, whose folder lies beside this one.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

BABYAI = Path(__file__).resolve().parent.parent / "vln-babyai"
if str(BABYAI) not in sys.path:
    sys.path.append(str(BABYAI))

from environment import GoToLocal  # noqa: E402  (of vln-babyai)


class OneFrame(GoToLocal):
    """A level of which an observation shows the last frame and the last action alone."""

    def _observation(self) -> dict[str, Any]:
        seen = super()._observation()
        last = np.asarray(seen["actions"][-1:], np.int64)
        return {"image": seen["image"][-1], "action_before": last, "instruction": seen["instruction"]}


def make(task: str, instruction: str = "right") -> OneFrame:
    """Make the environment of `task` ("GoToLocalS6N3", ...), as that of vln-babyai."""
    return OneFrame(task, instruction)
