"""A training that several processes share: the same curve and weights as one, and an end that is told."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from _trainings import digest, distilled, killed_after, peers, training_of
from safetensors.numpy import load_file

from vlatool.bundle.bundle import Bundle
from vlatool.errors import SourceError
from vlatool.prune.neurons import Neurons
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform
from vlatool.training.stage import TrainingStage

pytestmark = pytest.mark.usefixtures("in_this_process")
TOLERANCE = 1e-3
"""Relative difference of losses and weights: sums are added in another order, and Adam divides by small numbers."""


def weights(made: Bundle) -> np.ndarray:
    return np.concatenate(
        [value.ravel() for _, value in sorted(load_file(made.path / "module/main.safetensors").items())]
    )


def test_two_processes_train_as_one_does(pruned_once: Bundle, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    one = distilled(pruned_once, tmp_path / "one")
    two = distilled(pruned_once, tmp_path / "two", processes=2)
    parts = distilled(pruned_once, tmp_path / "parts", accumulate=2, threads=1)
    curves = [np.array(training_of(made)["losses"]) for made in (one, two, parts)]
    curve = float(np.abs(curves[1] / curves[0] - 1).max())
    apart = float(np.linalg.norm(weights(two) - weights(one)) / np.linalg.norm(weights(one)))
    with capsys.disabled():
        print(f"\n2 processes and 1: losses {curve:.1e}, weights {apart:.1e} (allowed {TOLERANCE:.0e})")
    assert curve < TOLERANCE
    assert apart < TOLERANCE
    assert curves[1].tolist() == curves[2].tolist(), "two halves, added in the same order"
    assert training_of(two)["processes"] == 2
    assert "processes" not in training_of(one)
    assert two.manifest.made_by["options"]["processes"] == 2
    assert not psutil.wait_procs(peers(), timeout=10)[1], "none is left, and none waits to be reaped"


def test_a_process_that_is_killed_is_told_and_the_next_run_goes_on(
    pruned_once: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    whole = distilled(pruned_once, tmp_path / "whole", processes=2)
    settings = TrainingStage.settings
    monkeypatch.setattr(TrainingStage, "settings", lambda self: replace(settings(self), checkpoint_s=0.0))
    with (
        killed_after(5, lambda: os.kill(peers()[0].pid, signal.SIGKILL)),
        pytest.raises(SourceError, match=r"process 2 of 2: the process that ran it was killed \(SIGKILL\)") as caught,
    ):
        distilled(pruned_once, tmp_path / "out", processes=2)
    assert "goes on from the last checkpoint" in caught.value.fix
    assert not (tmp_path / "out").exists()
    assert len(list((tmp_path / "cache").rglob("checkpoint.safetensors"))) == 1
    taken: list[int] = []
    monkeypatch.setattr(TrainingStage, "settings", settings)
    with killed_after(6, lambda: taken.append(6)):
        again = distilled(pruned_once, tmp_path / "out", processes=2)
    assert taken == [6]
    assert digest(again) == digest(whole)


def test_what_one_process_meets_ends_the_others(policy_dir: Path, tmp_path: Path):
    code = (policy_dir / "policy.py").read_text()
    fails = (
        "        if torch.distributed.is_initialized() and torch.distributed.get_rank() == 1:\n"
        "            raise ValueError('not with me')\n"
    )
    start = "        pixels = image"
    (policy_dir / "policy.py").write_text(code.replace(start, fails + start))
    source = run_transform(TorchModule(policy=policy_dir), None, tmp_path / "source", Context()).bundle
    pruned = run_transform(Neurons(ratio=0.7), source, tmp_path / "pruned", Context()).bundle
    with pytest.raises(SourceError, match="ValueError: not with me"):
        distilled(pruned, tmp_path / "out", processes=2)
    assert not psutil.wait_procs(peers(), timeout=10)[1], "none is left, and none waits to be reaped"
