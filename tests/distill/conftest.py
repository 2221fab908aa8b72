"""A place for trainings."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def in_this_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages run without a child of their own, with a new cache."""
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))
