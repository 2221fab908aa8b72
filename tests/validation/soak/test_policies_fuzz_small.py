"""A few random policies; ``tests/validation/soak/policies_fuzz.py`` takes as many as wanted through every method."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import policies_fuzz
import pytest
from _full import small_or_full
from _policy_trials import FLOAT, Outcome, trials
from _random_policies import RandomPolicy
from policies_fuzz import Journal, report

SEEDS = (0, 8, 9, 21, *small_or_full((), (4, 5)))
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


def test_the_few_have_every_feature() -> None:
    told = " ".join(RandomPolicy(seed).words for seed in SEEDS)
    for feature in ("image", "state", "text", "sequence", "keeps", "flow", "values"):
        assert feature in told, told


@pytest.mark.parametrize("verdict", ["crash", "drift"])
def test_a_crash_and_a_drift_fail_the_fuzz(verdict: str, capsys: pytest.CaptureFixture[str]) -> None:
    right = Outcome("int4", "ort_cpu", "right", 0.1)
    assert report([right]) == 0
    assert report([right, Outcome("int4", "ort_cpu", verdict, 0.9, "why")]) == 1
    assert "int4" in capsys.readouterr().out


DIES = """
import json, os, signal, sys
asked = json.loads(sys.stdin.readline())
if ["export", "openvino"] not in asked["skip"]:
    print(json.dumps(vars_of("export", "ort_cpu")), flush=True)
    print('{"begin": ["export", "openvino"]}', flush=True)
    os.kill(os.getpid(), signal.SIGSEGV)
for engine in ("ort_cpu", "openvino"):
    print(json.dumps(vars_of("int4", engine)), flush=True)
print('{"done": true}', flush=True)
"""
LINE = """
def vars_of(method, engine):
    return {"method": method, "engine": engine, "verdict": "right", "drift": 0.1, "words": ""}
"""


def test_a_policy_that_ends_its_process_is_a_crash_and_the_rest_is_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [sys.executable, "-c", LINE + DIES]
    started = []

    def start() -> subprocess.Popen[str]:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        started.append(process)
        return process

    monkeypatch.setattr(policies_fuzz, "_started", start)
    told = tmp_path / "outcomes.jsonl"
    policies_fuzz.run(Journal(told, ["int4"]), iter([0]), ["int4"], 1)
    again = Journal(told, ["int4"])
    found = {(each["method"], each["engine"]): each["verdict"] for each in again.lines}
    assert found == {
        ("export", "ort_cpu"): "right", ("export", "openvino"): "crash",
        ("int4", "ort_cpu"): "right", ("int4", "openvino"): "right",
    }  # fmt: skip
    assert "SIGSEGV" in capsys.readouterr().out
    policies_fuzz.run(again, iter([0]), ["int4"], 1)
    assert len(started) == 2, "what the file tells is tried again"
