"""A checkpoint directory of LeRobot: the policy of its config.json, with the statistics of its processors."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from vlatool.registry import Claim
from vlatool.sources._converted_checkpoint import ConvertedCheckpoint, config_of
from vlatool.sources._lerobot_directory import converted_checkpoint

WEIGHTS = "model.safetensors"


class LerobotCheckpoint(ConvertedCheckpoint):
    """A checkpoint of LeRobot, traced once in the Python that has LeRobot into a policy directory in the cache.

    LeRobot pins releases of torch and NumPy that exclude those of vlatool, so that it stays where it is installed:
    ``VLATOOL_LEROBOT_PYTHON`` names that Python. It is only asked to trace the policy; its processors are read as data.
    """

    needs: ClassVar[str] = "a LeRobot checkpoint: a directory with config.json and model.safetensors"

    @classmethod
    def claims(cls, typed: str) -> Claim:
        """Claim a directory whose config.json has the ``type`` of a policy and its features, beside the weights."""
        config = config_of(typed) if (Path(typed) / WEIGHTS).exists() else {}
        return Claim.CERTAIN if isinstance(config.get("type"), str) and "input_features" in config else Claim.NONE

    def converted_directory(self) -> Path:
        """Return the policy directory that the checkpoint is traced into, made when it is not in the cache.

        Raises:
            SourceError: when the checkpoint is incomplete or of an unknown kind, LeRobot is not found, or cannot trace
                it.
        """
        return converted_checkpoint(self.policy)
