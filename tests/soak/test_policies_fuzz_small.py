"""Six random policies; ``python tests/soak/policies_fuzz.py`` takes as many as are wanted through every method."""

from __future__ import annotations

from pathlib import Path

import pytest
from _random_policies import RandomPolicy
from policies_fuzz import FLOAT, Outcome, report, trials

SEEDS = (0, 4, 5, 8, 9, 21)
SMALL = ["static", "static-openvino", "int4"]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_random_policy_is_exported_quantized_and_loaded(seed: int, tmp_path: Path) -> None:
    policy = RandomPolicy(seed)
    found = list(trials(policy, tmp_path, SMALL))
    wrong = [each for each in found if each.verdict in ("crash", "drift")]
    assert not wrong, f"{policy.words}: {wrong[0].method} {wrong[0].engine} {wrong[0].drift:.3g} {wrong[0].words}"
    exported = [each for each in found if each.method == "export"]
    assert [each.engine for each in exported] == ["ort_cpu", "openvino"]
    assert all(each.verdict == "right" and each.drift <= FLOAT for each in exported)
    assert sum(each.verdict == "right" for each in found) >= 6, found


def test_the_six_have_every_feature() -> None:
    told = " ".join(RandomPolicy(seed).words for seed in SEEDS)
    for feature in ("image", "state", "text", "sequence", "keeps", "flow", "values"):
        assert feature in told, told


@pytest.mark.parametrize("verdict", ["crash", "drift"])
def test_a_crash_and_a_drift_fail_the_fuzz(verdict: str, capsys: pytest.CaptureFixture[str]) -> None:
    right = Outcome("int4", "ort_cpu", "right", 0.1)
    assert report([right]) == 0
    assert report([right, Outcome("int4", "ort_cpu", verdict, 0.9, "why")]) == 1
    assert "int4" in capsys.readouterr().out
