"""Sources: ways of obtaining a policy, one file each, and the choice of the source for what the user types."""

from __future__ import annotations

from pathlib import Path

from vlatool.bundle.bundle import Bundle
from vlatool.module.source import Source, is_bundle, source_of_policy
from vlatool.stage.base import Context, Result
from vlatool.stage.run import cached_transform

__all__ = ["Source", "brings_calibration", "is_bundle", "open_source", "source_bundle", "source_stage"]


def open_source(typed: str) -> Bundle | Source:
    """Open what the user types as SOURCE: a bundle, or the stage that reads a policy, whose code is then trusted.

    Raises:
        BundleError: when the bundle is damaged.
        SourceError: when it is neither a bundle nor a policy.
    """
    return Bundle.open(typed) if is_bundle(typed) else source_stage(typed)


def source_stage(typed: str) -> Source:
    """Return the stage that reads the policy that the user types; the policy's code is then trusted.

    Raises:
        SourceError: when no source reads it, or the policy is invalid.
    """
    return source_of_policy(typed).trust_code()


def source_bundle(source: Bundle | Source, cache: Path, context: Context) -> Result:
    """Return a bundle unchanged, or the source bundle of a policy."""
    if isinstance(source, Bundle):
        return Result(source)
    source.check(None, None)
    return cached_transform(source, None, cache, context)


def brings_calibration(source: Source) -> bool:
    """Return whether a policy has calibration data, which static quantization needs."""
    if source.calibration is not None:
        return True
    described = source.describe()
    return described is not None and described.calibration is not None
