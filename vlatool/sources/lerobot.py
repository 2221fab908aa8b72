"""A checkpoint directory of LeRobot: the policy of its config.json, with the statistics of its processors."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from vlatool.files.json import parse_json
from vlatool.module.description import FILE, Description, read_description
from vlatool.registry import Claim
from vlatool.sources._lerobot_directory import converted_checkpoint
from vlatool.sources.torch_module import TorchModule

if TYPE_CHECKING:
    from typing_extensions import Self

CONFIG, WEIGHTS = "config.json", "model.safetensors"
MAX_CONFIG_BYTES = 1 << 20


class LerobotCheckpoint(TorchModule):
    """A checkpoint of LeRobot, traced once in the Python that has LeRobot into a policy directory in the cache.

    LeRobot pins releases of torch and NumPy that exclude those of vlatool, so that it stays where it is installed:
    ``VLATOOL_LEROBOT_PYTHON`` names that Python. It is only asked to trace the policy; its processors are read as data.
    """

    needs: ClassVar[str] = "a LeRobot checkpoint: a directory with config.json and model.safetensors"

    @classmethod
    def claims(cls, typed: str) -> Claim:
        """Claim a directory whose config.json has the ``type`` of a policy and its features, beside the weights."""
        folder = Path(typed)
        if (folder / FILE).is_file() or not (folder / CONFIG).is_file() or not (folder / WEIGHTS).exists():
            return Claim.NONE
        with contextlib.suppress(OSError, ValueError), (folder / CONFIG).open("rb") as stream:
            config = parse_json(stream.read(MAX_CONFIG_BYTES))
            if isinstance(config, dict) and isinstance(config.get("type"), str) and "input_features" in config:
                return Claim.CERTAIN
        return Claim.NONE

    @classmethod
    def of(cls, typed: str) -> Self:
        """Return the stage for a checkpoint directory."""
        return cls(policy=Path(typed))

    def describe(self) -> Description:
        """Return the description of the policy directory that the checkpoint becomes.

        Raises:
            SourceError: when the checkpoint is incomplete or of an unknown kind, LeRobot is not found, or cannot trace
                it.
        """
        return self.with_given(read_description(self.converted_directory()))

    def converted_directory(self) -> Path:
        """Return the policy directory that the checkpoint is traced into, made when it is not in the cache.

        Raises:
            SourceError: as ``describe``.
        """
        return converted_checkpoint(self.policy)
