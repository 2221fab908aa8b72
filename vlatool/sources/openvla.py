"""A directory of an OpenVLA policy as Hugging Face has it: vision towers, a language model, action tokens."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from vlatool.registry import Claim
from vlatool.sources._converted_checkpoint import ConvertedCheckpoint, config_of
from vlatool.sources._openvla_directory import converted_checkpoint


class OpenVla(ConvertedCheckpoint):
    """An OpenVLA checkpoint, built from its tensors; its weights are read from its shards, its own code never runs.

    ``VLATOOL_UNNORM_KEY`` names the dataset whose statistics the actions are in, where there are several.
    """

    needs: ClassVar[str] = "an OpenVLA checkpoint: a directory whose config.json has model_type openvla"

    @classmethod
    def claims(cls, typed: str) -> Claim:
        """Claim a directory whose config.json says ``model_type: openvla``."""
        return Claim.CERTAIN if config_of(typed).get("model_type") == "openvla" else Claim.NONE

    def converted_directory(self) -> Path:
        """Return the policy directory with links to the weights, made when it is not in the cache.

        Raises:
            SourceError: when the checkpoint is incomplete, damaged, or of an unknown kind.
        """
        return converted_checkpoint(self.policy)
