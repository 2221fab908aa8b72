from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.cli.gate import _gate
from vlatool.data import NamedRecording, read_drawn
from vlatool.errors import DataError, UsageError
from vlatool.gate import inputs
from vlatool.gate.claims.accuracy import Accuracy
from vlatool.gate.inputs import AGREEMENT, TIMING, Inputs
from vlatool.gate.plan import Plan


def states(drawn) -> list[list[float]]:
    return [each.observation["proprio"].tolist() for each in drawn]


def test_each_process_and_purpose_draws_its_own_and_a_seed_draws_them_again(float_bundle: Bundle) -> None:
    inputs = Inputs(float_bundle, None, seed=7)
    first = states(inputs.draw(20, TIMING, 0))
    assert states(Inputs(float_bundle, None, seed=7).draw(20, TIMING, 0)) == first
    for other in (
        inputs.draw(20, TIMING, 1),
        inputs.draw(20, AGREEMENT),
        Inputs(float_bundle, None, 8).draw(20, TIMING),
    ):
        assert states(other) != first


def test_recordings_are_the_baselines_and_the_gates(float_bundle: Bundle, policy_dir: Path) -> None:
    assert [len(each) for each in Inputs(float_bundle, None, 0).recordings] == [16, 24]
    inputs = Inputs(float_bundle, policy_dir / "calibration.npz", 0)
    assert [len(each) for each in inputs.recordings] == [24, 16, 24]
    assert inputs.description().startswith(
        "observations are drawn from 64 recorded ones and the vocabulary with the seed 0; "
    )


def test_without_recordings_the_spec_alone_is_drawn_from(float_bundle: Bundle, tmp_path: Path, resealed) -> None:
    bare = Bundle.open(shutil.copytree(float_bundle.path, tmp_path / "bare"))
    shutil.rmtree(bare.path / "data")
    inputs = Inputs(resealed(bare), None, 0)
    assert {each.kind for each in inputs.draw(20, TIMING)} == {"drawn"}
    assert "from the spec alone: none is recorded" in inputs.description()


def test_large_observations_are_fewer(float_bundle: Bundle, monkeypatch) -> None:
    monkeypatch.setattr(inputs, "LARGEST", 3000)
    assert len(Inputs(float_bundle, None, 0).draw(50, TIMING)) == 11


def test_the_file_is_gone_in_the_end(float_bundle: Bundle) -> None:
    inputs = Inputs(float_bundle, None, 3)
    with inputs.file(9, TIMING, 2) as path:
        assert states(read_drawn(path)) == states(inputs.draw(9, TIMING, 2))
    assert not path.parent.exists()


def test_data_of_another_policy_are_an_error(float_bundle: Bundle, tmp_path: Path) -> None:
    np.savez(tmp_path / "own.npz", image=np.zeros((3, 8, 8, 3), np.uint8))
    with pytest.raises(DataError, match="has no 'proprio'"):
        _ = Inputs(float_bundle, tmp_path / "own.npz", 0).recordings


def renamed(recording: Path, out: Path) -> Path:
    arrays = dict(np.load(recording))
    arrays["joints"] = arrays.pop("proprio")
    np.savez(out, **arrays)
    return out


def test_the_data_of_a_gate_may_have_other_names(float_bundle: Bundle, policy_dir: Path, tmp_path: Path) -> None:
    data = renamed(policy_dir / "evaluation.npz", tmp_path / "other.npz")
    named = NamedRecording(data, {"proprio": "joints"})
    assert len(Inputs(float_bundle, named, 0).recordings[0]) == 16
    with pytest.raises(DataError, match="proprio"):
        _ = Inputs(float_bundle, data, 0).recordings
    plan = Accuracy(data=data, map=named.names).extend_plan(Plan())
    assert (plan.data, plan.names) == (data, named.names)


def test_map_of_a_gate_is_that_of_its_data(tmp_path: Path) -> None:
    (tmp_path / "gate.yaml").write_text("accuracy: {data: a.npz, map: {proprio: x}}\n")
    gate = _gate(tmp_path / "gate.yaml", None, ["proprio=joints"])
    assert gate.claims["accuracy"].map == {"proprio": "joints"}
    assert _gate(tmp_path / "gate.yaml", None, []).claims["accuracy"].map == {"proprio": "x"}
    (tmp_path / "gate.yaml").write_text("accuracy: {max_drop: 0.1}\n")
    with pytest.raises(UsageError, match="none is given"):
        _gate(tmp_path / "gate.yaml", None, ["proprio=joints"])
    with pytest.raises(DataError, match="maps names of recorded data"):
        Accuracy(map={"proprio": "x"}).check(None, Plan())
