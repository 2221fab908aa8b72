"""A directory of an OpenVLA policy as Hugging Face has it: vision towers, a language model, action tokens."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from vlatool.files.json import parse_json
from vlatool.module.description import FILE, Description, read_description
from vlatool.registry import Claim
from vlatool.sources._openvla_directory import converted_checkpoint
from vlatool.sources.torch_module import TorchModule

if TYPE_CHECKING:
    from typing_extensions import Self

CONFIG = "config.json"
MAX_CONFIG_BYTES = 1 << 24
"""Statistics of all datasets of a policy are in config.json."""


class OpenVla(TorchModule):
    """An OpenVLA checkpoint, built from its tensors; its weights are read from its shards, its own code never runs.

    ``VLATOOL_UNNORM_KEY`` names the dataset whose statistics the actions are in, where there are several.
    """

    needs: ClassVar[str] = "an OpenVLA checkpoint: a directory whose config.json has model_type openvla"

    @classmethod
    def claims(cls, typed: str) -> Claim:
        """Claim a directory whose config.json says ``model_type: openvla``."""
        folder = Path(typed)
        if (folder / FILE).is_file() or not (folder / CONFIG).is_file():
            return Claim.NONE
        with contextlib.suppress(OSError, ValueError), (folder / CONFIG).open("rb") as stream:
            config = parse_json(stream.read(MAX_CONFIG_BYTES))
            if isinstance(config, dict) and config.get("model_type") == "openvla":
                return Claim.CERTAIN
        return Claim.NONE

    @classmethod
    def of(cls, typed: str) -> Self:
        """Return the stage for a checkpoint directory."""
        return cls(policy=Path(typed))

    def describe(self) -> Description:
        """Return the description of the policy directory that the checkpoint becomes.

        Raises:
            SourceError: when the checkpoint is incomplete, damaged, or of an unknown kind.
        """
        return self.with_given(read_description(self.converted_directory()))

    def converted_directory(self) -> Path:
        """Return the policy directory with links to the weights, made when it is not in the cache.

        Raises:
            SourceError: as ``describe``.
        """
        return converted_checkpoint(self.policy)
