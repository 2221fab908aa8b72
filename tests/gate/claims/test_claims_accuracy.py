from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _examined import found as examined
from _examined import of_bundles

from vlatool.accuracy.success_comparison import Outcome, success_row
from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError
from vlatool.gate.claims import accuracy
from vlatool.gate.claims.accuracy import Accuracy, drop_words
from vlatool.gate.evidence import recorded_data
from vlatool.gate.plan import Plan
from vlatool.gate.verdict import judge_interval
from vlatool.measures.actions import RECORDED_DROP
from vlatool.report import Measurement


def test_a_bundle_is_no_worse_than_itself(float_bundle: Bundle) -> None:
    found = of_bundles(float_bundle, float_bundle, Accuracy(max_drop=0.0))
    assert found.verdict == "pass"
    (measured,) = found.measurements
    assert (measured.name, measured.value, measured.low, measured.high) == ("recorded_drop", 0, 0, 0)
    assert "more distance from the expert's actions than the baseline has: +0.00%" in found.sentence


@pytest.mark.parametrize(("off", "verdict"), [(0.0, "pass"), (3.0, "fail")])
def test_actions_that_leave_the_experts_fail(
    float_bundle: Bundle, monkeypatch: pytest.MonkeyPatch, off: float, verdict: str
) -> None:
    real = accuracy.run_recorded

    def run(bundle, recording, indices, engine, context):
        found = real(float_bundle, recording, indices, engine, context)
        return found + off if bundle is worse else found

    monkeypatch.setattr(accuracy, "run_recorded", run)
    worse = Bundle.open(float_bundle.path)
    assert of_bundles(worse, float_bundle, Accuracy()).verdict == verdict


@pytest.mark.parametrize("expert", [True, False])
def test_an_element_that_should_hold_still_and_does_not_fails(
    float_bundle: Bundle, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, expert: bool
) -> None:
    """The last element never changes in the recordings: the expert's standard deviation of it is 0."""
    real = accuracy.run_recorded
    with np.load(float_bundle.path / "data/evaluation.npz") as stored:
        data = {name: stored[name] for name in stored.files if expert or name != "action"}
    if expert:
        data["action"][..., -1] = -1.0
    np.savez(tmp_path / "still.npz", **data)

    def run(bundle, recording, indices, engine, context):
        found = real(float_bundle, recording, indices, engine, context).copy()
        found[..., -1] = 1.0 if bundle is opens else -1.0
        return found

    monkeypatch.setattr(accuracy, "run_recorded", run)
    opens, claim = Bundle.open(float_bundle.path), Accuracy(data=tmp_path / "still.npz")
    assert of_bundles(float_bundle, float_bundle, claim).verdict == "pass"
    assert of_bundles(opens, float_bundle, claim).verdict == "fail"


def test_without_an_expert_the_baselines_actions_are_right(
    float_bundle: Bundle, int8_bundle: Bundle, tmp_path: Path
) -> None:
    with np.load(float_bundle.path / "data/evaluation.npz") as stored:
        np.savez(tmp_path / "own.npz", **{name: stored[name] for name in stored.files if name != "action"})
    claim = Accuracy(max_drop=1.0, data=tmp_path / "own.npz")
    found = of_bundles(int8_bundle, float_bundle, claim)
    assert "distance from the baseline's actions:" in found.sentence
    assert found.measurements[0].value > 0
    assert of_bundles(float_bundle, float_bundle, claim).measurements[0].value == 0


def test_a_gate_says_how_much_of_a_chunk_is_judged(float_bundle: Bundle, tmp_path: Path) -> None:
    with np.load(float_bundle.path / "data/evaluation.npz") as stored:
        data = {name: stored[name] for name in stored.files}
    np.savez(tmp_path / "first.npz", **data | {"action": data["action"][:, 0]})
    found = of_bundles(float_bundle, float_bundle, Accuracy(data=tmp_path / "first.npz"))
    assert "first.npz records 1 of the 4 actions of each chunk: the first one alone is held" in found.sentence
    whole = of_bundles(float_bundle, float_bundle, Accuracy())
    assert "of each chunk" not in whole.sentence


def test_a_baseline_that_does_not_do_its_task_decides_nothing(float_bundle: Bundle, tmp_path: Path) -> None:
    with np.load(float_bundle.path / "data/evaluation.npz") as stored:
        data = {name: stored[name] for name in stored.files}
    np.savez(tmp_path / "other.npz", **data | {"action": data["action"][::-1]})
    claim = Accuracy(max_drop=1.0, data=tmp_path / "other.npz")
    found = of_bundles(float_bundle, float_bundle, claim)
    assert found.verdict == "inconclusive"
    assert found.sentence.startswith("The reference fails, so that nothing can be held against it: the baseline makes")
    assert {each.name for each in found.baseline} == {"skill_expert", "variation"}


def test_a_world_that_everybody_succeeds_in_decides_nothing(float_bundle: Bundle, policy_dir: Path) -> None:
    world = policy_dir / "environment.py"
    world.write_text(world.read_text().replace('{"success": done and good}', '{"is_success": True}'))
    claim = Accuracy(max_drop=0.5, episodes=8, policy=policy_dir)
    found = of_bundles(float_bundle, float_bundle, claim)
    assert found.verdict == "inconclusive"
    assert "100.0% of 8 closed-loop episodes, and actions that do not look" in found.sentence


def test_episodes_are_paired(float_bundle: Bundle, int8_bundle: Bundle, policy_dir: Path) -> None:
    claim = Accuracy(max_drop=0.5, episodes=8, policy=policy_dir)
    found = of_bundles(int8_bundle, float_bundle, claim)
    recorded, loop, rate = found.measurements
    assert (recorded.name, loop.name, loop.samples) == ("recorded_drop", "success_drop", 8)
    before = next(each for each in found.baseline if each.name == "success")
    assert (rate.name, rate.samples, rate.value) == ("success", 8, pytest.approx(before.value - loop.value))
    assert "more failed episodes: +0.00%" in found.sentence
    strict = of_bundles(int8_bundle, float_bundle, claim.model_copy(update={"max_drop": 0.01}))
    assert strict.verdict in ("inconclusive", "fail"), "eight episodes do not show that at most 1 % more fail"


def test_without_data_and_episodes_there_is_nothing_to_examine(float_bundle: Bundle, tmp_path: Path, resealed) -> None:
    bare = Bundle.open(shutil.copytree(float_bundle.path, tmp_path / "bare"))
    shutil.rmtree(bare.path / "data")
    bare = resealed(bare)
    with pytest.raises(DataError, match=r"the baseline .*bare carries no evaluation data .*no episodes") as caught:
        Accuracy().check(bare, Plan())
    assert "accuracy: null" in caught.value.fix
    assert recorded_data(bare, Plan(episodes=5)) is None
    assert recorded_data(bare, Plan(data=tmp_path)) == tmp_path
    Accuracy(episodes=5).check(bare, Plan(episodes=5))


def judged(value: float, low: float | None, high: float | None, samples: int):
    measured = Measurement("recorded_drop", value, "1", samples=samples, low=low, high=high)
    return judge_interval(measured, 0.01, "away:", starts=0)


@pytest.mark.parametrize(
    ("value", "low", "high", "wanted"), [(0.0, -0.02, 0.02, 400), (0.02, 0.0, 0.04, 400), (0, 0, 0.1, 10_000)]
)
def test_it_says_how_many_would_decide(value: float, low: float, high: float, wanted: int) -> None:
    assert drop_words(judged(value, low, high, 100)).endswith(f", about {wanted:,} would decide")


def test_what_is_decided_needs_no_more() -> None:
    assert "would decide" not in drop_words(judged(0.0, -0.01, 0.01, 100))
    assert "would decide" not in drop_words(judged(0.01, -0.01, 0.03, 100))


def test_one_recorded_episode_decides_nothing() -> None:
    alone = Accuracy()._held(RECORDED_DROP, "away:", (0.2, -math.inf, math.inf), 60)
    assert (alone.outcome, alone.measured.low) == ("inconclusive", None)
    assert drop_words(alone) == (
        "away: +20.00% (unbounded to unbounded, 60 of them; allowed: +1.00%), of one episode alone, "
        "which says nothing of others"
    )


@pytest.mark.parametrize(
    ("starts", "lost", "verdict"),
    [(3, 0, "inconclusive"), (3, 300, "inconclusive"), (20, 0, "pass"), (20, 300, "fail"), (300, 0, "pass")],
)
def test_pairs_that_begin_alike_are_worth_as_many_as_their_starts(starts: int, lost: int, verdict: str) -> None:
    """Three hundred pairs; an environment whose seed draws one of a few episodes."""
    base = [Outcome("open", seed, True, 5, start=f"{seed % starts}") for seed in range(300)]
    own = [replace(each, success=each.seed >= lost) for each in base]
    rows = success_row("baseline", "baseline", base), success_row("subject", "subject", own)
    claim = Accuracy(max_drop=0.25, episodes=300)
    found = examined(claim, recording_path=None, episodes=rows)
    assert found.verdict == verdict, found.sentence
    assert f"300 of them, {starts} distinct starts; allowed" in found.sentence
    told = f"have {starts} distinct first observations, so that they count as {starts}"
    assert (told in found.sentence) == (starts < 300)
    drop = next(each for each in found.measurements if each.name == "success_drop")
    assert (drop.high - drop.low > 0.05) == (starts < 300)
