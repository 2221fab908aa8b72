"""A checkpoint directory that becomes a policy directory in the cache: what sources of that kind have in common."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlatool.files.json import parse_json
from vlatool.module.description import FILE, Description, read_description
from vlatool.sources.torch_module import TorchModule

if TYPE_CHECKING:
    from typing_extensions import Self

CONFIG = "config.json"
MAX_CONFIG_BYTES = 1 << 24
"""The config.json of an OpenVLA policy holds the statistics of all its datasets."""


class ConvertedCheckpoint(TorchModule):
    """A checkpoint of another library; a source of this kind converts it (``converted_directory``)."""

    @classmethod
    def of(cls, typed: str) -> Self:
        """Return the stage for a checkpoint directory."""
        return cls(policy=Path(typed))

    def describe(self) -> Description:
        """Return the description of the policy directory that the checkpoint becomes.

        Raises:
            SourceError: as ``converted_directory``.
        """
        return self.with_given(read_description(self.converted_directory()))

    def converted_directory(self) -> Path:
        """Return the policy directory in the cache, which is made when it is not there.

        Raises:
            SourceError: when the checkpoint is incomplete, damaged, or of an unknown kind.
        """
        raise NotImplementedError


def config_of(typed: str) -> dict[str, Any]:
    """Return the config.json of a directory; empty where there is none, or a policy.yaml describes it already."""
    folder = Path(typed)
    if (folder / FILE).is_file() or not (folder / CONFIG).is_file():
        return {}
    with contextlib.suppress(OSError, ValueError), (folder / CONFIG).open("rb") as stream:
        config = parse_json(stream.read(MAX_CONFIG_BYTES))
        return config if isinstance(config, dict) else {}
    return {}
