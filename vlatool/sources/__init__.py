"""Sources: ways of obtaining a policy, one file each; and which one reads what a person names."""

from __future__ import annotations

from pathlib import Path

from vlatool.bundle.bundle import Bundle
from vlatool.module.source import Source, is_bundle, source_of_policy
from vlatool.stage.base import Context, Result
from vlatool.stage.run import cached_transform

__all__ = ["Source", "brings_calibration", "is_bundle", "open_source", "source_bundle", "source_stage"]


def open_source(typed: str) -> Bundle | Source:
    """Return what a person types as SOURCE: a bundle, or the stage that reads a policy, whose code may run then.

    Raises:
        BundleError: when the bundle is damaged.
        SourceError: when it is neither.
    """
    return Bundle.open(typed) if is_bundle(typed) else source_stage(typed)


def source_stage(typed: str) -> Source:
    """Return the stage that reads a policy which a person names; its code may run then.

    Raises:
        SourceError: when no source reads it, or it is wrong.
    """
    return source_of_policy(typed).trust_code()


def source_bundle(source: Bundle | Source, cache: Path, context: Context) -> Result:
    """Return a bundle as it is, and the source bundle of a policy."""
    if isinstance(source, Bundle):
        return Result(source)
    source.check(None, None)
    return cached_transform(source, None, cache, context)


def brings_calibration(typed: str) -> bool:
    """Return whether a policy has calibration data, which static quantization needs."""
    described = source_stage(typed).describe()
    return described is not None and described.calibration is not None
