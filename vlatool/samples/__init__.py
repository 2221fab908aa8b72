"""Policies with random weights and realistic shapes, to study latency and memory; one file for each."""

from __future__ import annotations

from pathlib import Path


def write_sample(name: str, folder: Path, seed: int) -> None:
    """Write a sample to an empty directory; see ``_write.write_sample``."""
    from vlatool.samples._write import write_sample

    write_sample(name, folder, seed)
