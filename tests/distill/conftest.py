"""A pruned policy and a place for trainings."""

from __future__ import annotations

from pathlib import Path

import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.prune.neurons import Neurons
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform


@pytest.fixture(scope="session")
def pruned_once(source_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """The tiny policy without most of its hidden neurons; read only."""
    return run_transform(Neurons(ratio=0.7), source_bundle, tmp_path_factory.mktemp("pruned") / "bundle", Context())


@pytest.fixture
def in_this_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stages run without a child of their own, with a new cache."""
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("vlatool.stage.run.run_apart", lambda stage, *rest: stage.run(*rest))
