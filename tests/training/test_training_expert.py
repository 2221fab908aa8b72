"""An expert's recorded actions: which are chosen, how they are encoded, and the loss against them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.conversion import Conversion
from vlatool.bundle.program import ProgramStep
from vlatool.bundle.spec import TensorSpec
from vlatool.data import calibration_recording
from vlatool.errors import DataError, SpecError
from vlatool.runtime.observation import ObservationEncoder
from vlatool.training.expert import Expert, encoded_actions, expert_loss, write_noise
from vlatool.training.losses.l1 import L1

DISCRETE = TensorSpec("logits", (1, 2, 3), kind="discrete", labels=("left", "right", "forward"))


def prepared(bundle: Bundle, place: Path, share: float = 1.0, seed: int = 0) -> Expert:
    expert = Expert(place)
    encode = ObservationEncoder(bundle.manifest.spec, bundle)
    expert.prepare(calibration_recording(bundle), bundle, share, seed, encode)
    return expert


def rows_of(expert: Expert) -> dict[str, Any]:
    return expert.frames.batch(np.arange(len(expert.frames)))


def test_rows_hold_what_the_policy_takes_and_what_the_expert_did(source_bundle: Bundle, tmp_path: Path):
    rows = rows_of(prepared(source_bundle, tmp_path))
    recording = calibration_recording(source_bundle)
    assert rows["image"].tolist() == recording.inputs["image"][:].tolist()
    mean, std = np.float32([0.01, -0.02]), np.float32([0.05, 0.1])
    np.testing.assert_allclose(rows["expert.action"] * std + mean, recording.actions, atol=1e-6)
    assert rows["expert.action"].dtype == np.float32


def test_a_smaller_share_is_a_part_of_a_larger_one(source_bundle: Bundle, tmp_path: Path):
    shown = {share: prepared(source_bundle, tmp_path / str(share), share) for share in (0.01, 0.25, 0.5)}
    rows = {share: {row.tobytes() for row in rows_of(expert)["proprio"]} for share, expert in shown.items()}
    assert rows[0.01] < rows[0.25] < rows[0.5]
    assert [expert.counts for expert in shown.values()] == [
        {"used": 1, "recorded": 24}, {"used": 6, "recorded": 24}, {"used": 12, "recorded": 24},
    ]  # fmt: skip
    others = prepared(source_bundle, tmp_path / "other", 0.5, seed=1)
    assert {row.tobytes() for row in rows_of(others)["proprio"]} != rows[0.5]


def test_what_was_written_is_used_again(source_bundle: Bundle, tmp_path: Path):
    prepared(source_bundle, tmp_path)
    again, peer = Expert(tmp_path), Expert(tmp_path)
    again.prepare(calibration_recording(source_bundle), source_bundle, 1.0, 0, lambda _: pytest.fail("written again"))
    peer.read()
    peer.read()
    assert len(again.frames) == len(peer.frames) == again.counts["used"] == 24
    assert peer.round() == {"step": 0, "actor": "expert", "observations": 24}


def test_without_actions_there_is_no_expert(source_bundle: Bundle, tmp_path: Path):
    recording = replace(calibration_recording(source_bundle), actions=None)
    for given in (None, recording):
        with pytest.raises(DataError, match="A loss against an expert's actions needs them") as caught:
            Expert(tmp_path).prepare(given, source_bundle, 1.0, 0, dict)
        assert "or use --alpha 1" in caught.value.fix


def test_indices_stay_indices(source_bundle: Bundle):
    actions = encoded_actions(DISCRETE, source_bundle, np.array([[2, 0]], np.int32))
    assert (actions.dtype, actions.tolist()) == (np.int64, [[2, 0]])


def converted(bundle: Bundle, *convert: Conversion) -> tuple[TensorSpec, Bundle]:
    """Return the action of a bundle with conversions, and the bundle that has it."""
    spec = bundle.manifest.spec
    action = replace(spec.action, mode="absolute", convert=convert)
    return action, replace(bundle, manifest=replace(bundle.manifest, spec=replace(spec, outputs=(action,))))


def test_recorded_targets_become_the_differences_that_the_network_gives(source_bundle: Bundle):
    random = np.random.default_rng(0)
    targets, states = (random.normal(size=size).astype(np.float32) for size in ((5, 4, 2), (5, 3)))
    action, bundle = converted(source_bundle, Conversion("relative", (1,), "proprio", (2,)))
    wanted = targets.copy()
    wanted[:, :, 1] -= states[:, None, 2]
    found = encoded_actions(action, bundle, targets, states)
    np.testing.assert_allclose(found, encoded_actions(source_bundle.manifest.spec.action, source_bundle, wanted))


def test_what_has_no_way_back_is_not_trained_on(source_bundle: Bundle):
    action, bundle = converted(source_bundle, Conversion("binarise", (1,)))
    with pytest.raises(SpecError, match="binarise, has no way back") as caught:
        encoded_actions(action, bundle, np.zeros((2, 4, 2), np.float32))
    assert "train on what the network gives" in caught.value.fix


def test_noise_is_drawn_for_every_row(tmp_path: Path):
    step = ProgramStep("main", {}, {}, noise={"start": {"shape": [1, 4, 2], "distribution": "normal"}})
    bundle: Any = SimpleNamespace(manifest=SimpleNamespace(program=(step,)))
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        write_noise(bundle, 300, (0, 1), tmp_path / name)
    one, other = (np.load(tmp_path / name / "noise.start.npy") for name in ("one", "other"))
    assert one.shape == (300, 4, 2)
    assert np.unique(one[:, 0, 0]).size == 300
    assert (one == other).all()


class Answers(nn.Module):
    """Gives the same for every row, and has a weight."""

    def __init__(self, values: torch.Tensor) -> None:
        super().__init__()
        self.values = nn.Parameter(values)

    def forward(self, proprio):
        return self.values.expand(len(proprio), *self.values.shape[1:])


def loss_of(action: TensorSpec, values: torch.Tensor, expert: np.ndarray) -> torch.Tensor:
    program = (ProgramStep("main", {"proprio": "proprio"}, {"out": action.name}),)
    source: Any = SimpleNamespace(manifest=SimpleNamespace(program=program, spec=SimpleNamespace(action=action)))
    loss = expert_loss({"main": Answers(values)}, source, L1())
    return loss({"proprio": np.zeros((len(expert), 3), np.float32), f"expert.{action.name}": expert})


def test_discrete_actions_have_a_cross_entropy():
    logits = torch.tensor([[[0.1, 2.0, -1.0], [1.0, 0.0, 0.5]]])
    expert = np.array([[1, 2], [0, 0]])
    chances = torch.softmax(logits[0].double(), -1).numpy()
    wanted = -np.log([chances[0, 1], chances[1, 2], chances[0, 0], chances[1, 0]]).mean()
    assert loss_of(DISCRETE, logits, expert).item() == pytest.approx(wanted, rel=1e-6)
    only_first = -np.log([chances[0, 1], chances[0, 0]]).mean()
    assert loss_of(DISCRETE, logits, expert[:, :1]).item() == pytest.approx(only_first, rel=1e-6)


def test_continuous_actions_are_compared_as_far_as_they_were_recorded():
    action = TensorSpec("action", (1, 2, 2), labels=("dx", "dy"), unit=("m", "m"))
    given, expert = torch.tensor([[[1.0, 2.0], [3.0, 4.0]]]), np.zeros((3, 2, 2), np.float32)
    assert loss_of(action, given, expert).item() == pytest.approx(2.5)
    loss = loss_of(action, given, expert[:, :1])
    assert loss.item() == pytest.approx(1.5)
    assert loss.requires_grad
