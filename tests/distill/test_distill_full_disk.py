"""A disk that becomes full in the middle of a training costs no step."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import _wrong_trainings
import pytest
from _wrong_inputs import Line

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main


@pytest.fixture
def at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> _wrong_trainings.Workshop:
    return _wrong_trainings.place(tmp_path, monkeypatch, request.getfixturevalue)


def ran(line: Line, capfd: pytest.CaptureFixture[str]) -> tuple[Any, str]:
    with pytest.raises(SystemExit) as caught:
        main([str(word) for word in line])
    return caught.value.code, capfd.readouterr().err


def test_a_full_disk_loses_no_step(
    at: _wrong_trainings.Workshop, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """The file system refuses the second checkpoint: the first stays, and the next run goes on from it."""
    loop = importlib.import_module("vlatool.training.loop")
    save = loop.Trainer.save
    with monkeypatch.context() as patched:
        patched.setattr(loop.Trainer, "save", lambda self: save(self) if self.step < 3 else limited(self, save))
        code, told = ran([*at.line("--patience", 9, "--every", 2)], capfd)
    assert (code, "File too large" in told) == (3, True), told
    assert not at.out.exists()
    left = [path.name for path in (at.root / "cache").rglob("*checkpoint*")]
    assert left == ["checkpoint.safetensors"], "no half-written file"
    steps = []
    take = loop.Trainer._take_step
    monkeypatch.setattr(loop.Trainer, "_take_step", lambda self, draw: (steps.append(self.step), take(self, draw)))
    assert ran(at.line("--patience", 9, "--every", 2), capfd)[0] == 0
    assert steps == [2], "the steps before the checkpoint are not taken again"
    assert Bundle.open(at.out)


def limited(trainer: Any, save: Callable[[Any], None]) -> None:
    """Save where no file may grow beyond a kilobyte."""
    import resource
    import signal

    kept, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, kept[1]))
    try:
        save(trainer)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, kept)
        signal.signal(signal.SIGXFSZ, handler)
