"""Sources: ways of obtaining a policy, one file each; and which of them a person means."""

from __future__ import annotations

import contextlib
from pathlib import Path

from vlatool import registry
from vlatool.bundle.bundle import MANIFEST, Bundle
from vlatool.errors import PluginError, SourceError
from vlatool.module.description import FILE, read_description
from vlatool.sources._source import Source
from vlatool.stage.base import Context
from vlatool.stage.run import cached_transform

__all__ = ["Source", "brings_calibration", "is_bundle", "source_stage", "sourced"]


def is_bundle(source: str) -> bool:
    """Return whether SOURCE is a bundle rather than a policy to export."""
    path = Path(source)
    if (path / MANIFEST).is_file() or not path.is_dir():
        return (path / MANIFEST).is_file()
    return not (path / FILE).is_file() and not any(path.glob("*.onnx"))


def source_stage(source: str) -> Source:
    """Turn what a person types as SOURCE into a stage.

    Args:
        source: A directory with ``policy.yaml``, a ``policy.yaml``, ``path.py:make`` (beside a ``policy.yaml``) or an
            ONNX file.

    Raises:
        SourceError: when it is none of them.
    """
    for name in registry.names("sources"):
        with contextlib.suppress(PluginError):  # of a package that cannot be imported; ``doctor`` names it
            kind: type[Source] = registry.load("sources", name)
            if stage := kind.accepting(source):
                return stage
    raise SourceError(
        f"'{source}' is neither a bundle nor a policy source.",
        "give a bundle, a directory with a policy.yaml, path/to/policy.py:make, or a .onnx file",
    )


def sourced(source: str, cache: Path, context: Context) -> Bundle:
    """Return the source bundle of what a person typed as SOURCE."""
    stage = source_stage(source)
    stage.check(None, None)
    return cached_transform(stage, None, cache, context)


def brings_calibration(source: str) -> bool:
    """Return whether SOURCE has calibration data, which static quantization needs."""
    policy = source_stage(source).policy
    return policy is not None and read_description(policy).calibration is not None
