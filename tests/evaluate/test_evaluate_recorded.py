"""Errors on recordings, against the same sums done by hand."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import partialmethod

import numpy as np
import pytest

from vlatool.bundle.bundle import Bundle, replace_manifest, seal
from vlatool.bundle.spec import TensorSpec
from vlatool.data import evaluation_recording, recorded_observations
from vlatool.errors import DataError, GraphError
from vlatool.evaluate import recorded
from vlatool.evaluate.recorded import Recorded, compare, run_recorded
from vlatool.measures import tables
from vlatool.measures.actions import BASELINE, EXPERT
from vlatool.runtime import Policy, load
from vlatool.runtime.identity import policy_identity
from vlatool.stage.base import Context

ARM = TensorSpec("action", (1, 2, 2), labels=("dx", "gripper"), unit=("m", "1"))
TURN = TensorSpec("action", (1, 3), kind="discrete", labels=("left", "right", "forward"))


def by_name(found):
    return {measurement.name: measurement for measurement in found}


def chunks(bundle):
    """What the runtime gives on the bundle's evaluation data, and what the expert did."""
    policy = load(bundle.path, threads=1, seed=0)
    with np.load(bundle.path / "data/evaluation.npz") as data:
        recorded = {name: data[name] for name in data.files}
    given = []
    for index in range(len(recorded["image"])):
        observation = {name: recorded[name][index] for name in ("image", "proprio")}
        given.append(policy.infer({**observation, "instruction": str(recorded["instruction"][index])}).chunk)
    return np.stack(given).astype(np.float64), recorded["action"].astype(np.float64)


def test_errors_are_mean_absolute_ones_in_the_unit_of_each_element(float_bundle):
    (row,) = Recorded().run(float_bundle, Context()).rows
    got, expert = chunks(float_bundle)
    errors = np.abs(got - expert).mean(axis=(0, 1))
    for index, label in enumerate(("dx", "dy")):
        found = row.get(f"error_expert.{label}")
        assert found.value == pytest.approx(errors[index], rel=1e-5)
        assert (found.unit, found.samples) == ("m", 16)
    relative = np.mean(errors / expert.std(axis=(0, 1)))
    assert row.value("error_expert") == pytest.approx(relative, rel=1e-5)
    assert row.get("error_expert").unit == "1"


def test_a_baseline_gets_its_row_and_the_bundle_its_distance_to_it(float_bundle, int8_bundle):
    stage = Recorded(baseline=float_bundle.path)
    assert stage.inputs() == (float_bundle.path / "manifest.json",)
    base, row = stage.run(int8_bundle, Context()).rows
    assert (base.role, row.role) == ("baseline", "subject")
    identities = [each.details[tables.IDENTITY][0]["identity"] for each in (base, row)]
    assert identities == [policy_identity(float_bundle), policy_identity(int8_bundle)]
    assert len({base.name, row.name}) == 2, "by their folders: both bundles are of one policy"
    expected = np.abs(chunks(int8_bundle)[0] - chunks(float_bundle)[0]).mean(axis=(0, 1))
    assert row.value("error_baseline.dx") == pytest.approx(expected[0], rel=1e-4)
    assert row.value("error_baseline.dy") == pytest.approx(expected[1], rel=1e-4)
    assert base.value("error_expert.dx") != row.value("error_expert.dx")


def test_a_baseline_runs_once_for_all_that_are_compared_with_it(
    float_bundle, int8_bundle, policy_template, monkeypatch
):
    ran = []

    def counting(bundle, *rest):
        ran.append(bundle.hash)
        return run_recorded(bundle, *rest)

    monkeypatch.setattr(recorded, "REFERENCES", {})
    monkeypatch.setattr(recorded, "run_recorded", counting)
    first, again = (
        Recorded(baseline=float_bundle.path).run(int8_bundle, Context()).rows[-1].measurements for _ in range(2)
    )
    assert ran == [float_bundle.hash, int8_bundle.hash, int8_bundle.hash]
    assert first == again
    Recorded(baseline=float_bundle.path, samples=3).run(int8_bundle, Context())
    other = policy_template / "calibration.npz"
    Recorded(baseline=float_bundle.path, data=other).run(int8_bundle, Context())
    assert ran[3:] == [float_bundle.hash, int8_bundle.hash] * 2, "other observations"
    for samples in range(4, 12):
        Recorded(baseline=float_bundle.path, samples=samples).run(int8_bundle, Context())
    assert len(recorded.REFERENCES) == recorded.MAX_REFERENCES


def test_against_itself_a_bundle_has_no_error(float_bundle):
    _, row = Recorded(baseline=float_bundle.path).run(float_bundle, Context()).rows
    assert row.value("error_baseline") == 0.0


def test_fewer_samples_are_spread_over_the_recording(float_bundle):
    report = Recorded(samples=4).run(float_bundle, Context())
    assert report.rows[0].get("error_expert").samples == 4
    assert "on 4 recorded observations" in report.title


def test_other_data_may_be_named(float_bundle, policy_template):
    stage = Recorded(data=policy_template / "calibration.npz")
    assert stage.inputs() == (policy_template / "calibration.npz",)
    assert stage.run(float_bundle, Context()).rows[0].get("error_expert").samples == 24


def test_data_without_expert_actions_or_episodes_is_still_run(float_bundle, policy_template, tmp_path):
    with np.load(policy_template / "evaluation.npz") as data:
        np.savez(tmp_path / "bare.npz", **{name: data[name] for name in ("image", "proprio", "instruction")})
    _, row = Recorded(data=tmp_path / "bare.npz", baseline=float_bundle.path).run(float_bundle, Context()).rows
    wanted = {"error_baseline", "error_baseline.dx", "error_baseline.dy", "relative_error", "variation"}
    assert {each.name for each in row.measurements} == wanted


def test_without_data_the_remedy_is_named(float_bundle, copied):
    bare = copied(float_bundle)
    for name in ("evaluation", "calibration"):
        (bare.path / f"data/{name}.npz").unlink()
    bare = seal(bare.path, bare.manifest)
    with pytest.raises(DataError, match="carries no evaluation data") as caught:
        Recorded().check(Bundle.open(bare.path), None)
    assert caught.value.fix == "pass --data FILE.npz"
    Recorded().check(None, None)


def test_with_calibration_data_alone_a_half_that_calibration_does_not_see_is_evaluated_on(float_bundle, copied):
    bare = copied(float_bundle)
    (bare.path / "data/evaluation.npz").unlink()
    bare = seal(bare.path, bare.manifest)
    Recorded().check(bare, None)
    report = Recorded(baseline=float_bundle.path).run(bare, Context())
    assert report.rows[-1].get("error_baseline").samples == 12
    assert report.rows[-1].value("error_baseline") == 0.0
    assert report.title == "tiny on 12 calibration observations"
    assert "12 of the 24 observations for calibration, held out of it" in report.warnings[0]
    seen = {tuple(each["proprio"]) for each in recorded_observations(bare, 99)}
    held_out = {tuple(each["proprio"]) for each in evaluation_recording(bare)[0]}
    assert len(seen) == len(held_out) == 12
    assert not seen & held_out
    assert len(recorded_observations(float_bundle, 99)) == 24, (
        "a bundle with an evaluation recording calibrates with all"
    )


def test_a_few_calibration_observations_are_not_split_and_that_is_said(float_bundle, copied):
    bare = copied(float_bundle)
    (bare.path / "data/evaluation.npz").unlink()
    with np.load(bare.path / "data/calibration.npz") as data:
        np.savez(bare.path / "data/calibration.npz", **{name: data[name][:15] for name in data.files})
    bare = seal(bare.path, bare.manifest)
    report = Recorded(baseline=float_bundle.path).run(bare, Context())
    assert report.rows[-1].get("error_baseline").samples == 15
    assert "what calibrates is what evaluates" in report.warnings[0]
    assert len(recorded_observations(bare, 99)) == 15


def test_continuous_actions_by_hand():
    wanted = np.array([[[1.0, 1.0], [3.0, -1.0]], [[1.0, 1.0], [3.0, -1.0]]])
    got = wanted + np.array([0.5, 0.0])
    found = by_name(compare(ARM, got, wanted, EXPERT))
    assert found["error_expert.dx"].value == 0.5
    assert found["error_expert.gripper"].value == 0.0
    assert found["error_expert"].value == pytest.approx((0.5 / 1.0 + 0.0 / 1.0) / 2)
    assert found["gripper_flips_expert"].value == 0.0


def test_gripper_flips_are_the_share_of_steps_with_the_other_sign():
    wanted = np.array([[[0.0, 1.0], [0.0, -1.0]], [[0.0, 0.2], [0.0, -0.2]]])
    got = np.array([[[0.0, -1.0], [0.0, -0.1]], [[0.0, 9.0], [0.0, -9.0]]])
    flips = by_name(compare(ARM, got, wanted, BASELINE))["gripper_flips_baseline"]
    assert (flips.value, flips.samples) == (0.25, 4)
    assert 0 < flips.low < 0.25 < flips.high


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (0.0, 0.08), (-1.0, 1.0)])
def test_a_gripper_flips_at_the_middle_of_what_it_does(low: float, high: float):
    closed, wide = low + 0.1 * (high - low), low + 0.9 * (high - low)
    wanted = np.array([[[0.0, low], [0.0, high]], [[0.0, low], [0.0, high]]])
    got = np.array([[[0.0, closed], [0.0, wide]], [[0.0, wide], [0.0, high]]])
    assert by_name(compare(ARM, got, wanted, BASELINE))["gripper_flips_baseline"].value == 0.25


def test_an_element_that_never_moves_does_not_divide_by_zero():
    wanted = np.zeros((3, 1, 2))
    found = by_name(compare(ARM, wanted + 1.0, wanted, EXPERT))
    assert math.isnan(found["error_expert"].value)
    assert found["error_expert"].note == "the expert's action never varies, so no error relative to its spread"
    assert found["error_expert.dx"].value == 1.0


def with_action(float_bundle, copied, change):
    """A copy of the bundle whose expert acts otherwise."""
    bundle = copied(float_bundle)
    with np.load(bundle.path / "data/evaluation.npz") as stored:
        data = {name: stored[name] for name in stored.files}
    np.savez(bundle.path / "data/evaluation.npz", **data | {"action": change(data["action"])})
    return seal(bundle.path, bundle.manifest)


def test_a_constant_expert_is_told_in_words_and_never_as_nan(float_bundle, copied):
    bundle = with_action(float_bundle, copied, lambda action: action * 0 + np.float32(0.1))
    report = Recorded(baseline=float_bundle.path, data=bundle.path / "data/evaluation.npz").run(bundle, Context())
    told = " ".join((*report.summary, *report.warnings))
    assert "nan" not in told
    assert "the expert's action never varies" in told
    assert re.search(r"d[xy] is off by 0\.\d+ m on average", told)
    assert "NaN" not in report.to_json()
    assert report.verdict == "inconclusive"


def test_a_baseline_that_does_no_better_than_a_constant_action_is_said(float_bundle, copied):
    assert Recorded(baseline=float_bundle.path).run(float_bundle, Context()).verdict == "info"
    bundle = with_action(float_bundle, copied, lambda action: action[::-1])
    data = bundle.path / "data/evaluation.npz"
    report = Recorded(baseline=float_bundle.path, data=data).run(float_bundle, Context())
    assert report.verdict == "inconclusive"
    assert report.summary[0].startswith("The reference fails, so that nothing can be held against it")
    assert Recorded(data=data).run(float_bundle, Context()).verdict == "info", "alone, nothing is held against it"


def test_chunks_of_unequal_length_are_compared_as_far_as_both_go():
    wanted = np.ones((2, 5, 2)) * np.arange(5)[None, :, None]
    found = by_name(compare(ARM, wanted[:, :3] + 0.25, wanted, EXPERT))
    assert found["error_expert.dx"].value == 0.25


def test_discrete_chunks_of_unequal_length_agree_as_far_as_both_go():
    got = np.array([[0, 1, 2], [2, 1, 0]])
    (found,) = compare(TURN, got, np.array([[0], [1]]), EXPERT)
    assert (found.value, found.samples) == (0.5, 2)
    (found,) = compare(TURN, got, np.array([[0, 1], [1, 1]]), EXPERT)
    assert (found.value, found.samples) == (0.75, 4)


@pytest.mark.parametrize(("steps", "told"), [(4, 0), (2, 1), (1, 1)])
def test_a_report_says_how_much_of_a_chunk_is_judged(float_bundle, tmp_path, steps, told):
    with np.load(float_bundle.path / "data/evaluation.npz") as data:
        recorded = {name: data[name] for name in data.files}
    np.savez(tmp_path / "part.npz", **{**recorded, "action": recorded["action"][:, :steps]})
    report = Recorded(data=tmp_path / "part.npz").run(float_bundle, Context())
    assert len(report.warnings) == told
    assert all(f"part.npz records {steps} of the 4 actions of each chunk" in warning for warning in report.warnings)


def test_without_labels_elements_are_numbered():
    plain = TensorSpec("action", (1, 1, 2), unit="rad")
    found = by_name(compare(plain, np.zeros((2, 1, 2)), np.ones((2, 1, 2)), EXPERT))
    assert found["error_expert.1"].unit == "rad"


def test_discrete_actions_agree_or_not():
    wanted = np.array([[0], [1], [2], [2]])
    (found,) = compare(TURN, np.array([[0], [1], [2], [0]]), wanted, EXPERT)
    assert (found.name, found.value, found.samples) == ("agreement_expert", 0.75, 4)
    assert found.low < 0.75 < found.high


def test_nothing_to_compare_with_gives_nothing():
    assert compare(TURN, np.zeros((2, 1)), None, EXPERT) == []


def test_what_a_stage_found_to_be_wrong_is_said(float_bundle, copied):
    bundle = copied(float_bundle)
    finding = {"name": "engine-difference", "message": "the engine computes something else."}
    bundle = replace_manifest(bundle, replace(bundle.manifest, findings=(finding,)))
    warnings = Recorded().run(bundle, Context()).warnings
    assert "load refuses this bundle (engine-difference): the engine computes something else." in warnings


def test_what_load_refuses_is_not_evaluated(float_bundle, copied, monkeypatch):
    bundle = copied(float_bundle)
    monkeypatch.setattr(Policy, "warm_up", partialmethod(Policy.warm_up, tolerance=-1.0))
    with pytest.raises(GraphError, match="a different golden action"):
        Recorded().run(bundle, Context())


def test_an_inference_without_end_is_stopped(float_bundle, monkeypatch):
    monkeypatch.setattr("vlatool.evaluate.recorded.FIRST_RUN_S", -1.0)
    with pytest.raises(GraphError, match="takes longer than"):
        Recorded().run(float_bundle, Context())
