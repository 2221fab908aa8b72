"""Bundles that cheat on the gate: the fast ones of ``tests/validation/soak/attacks/gate_cheats.py``."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest
from _full import small_or_full

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.gate import run as run_gate_module
from vlatool.gate.inputs import TIMING, Inputs
from vlatool.measurement import turns
from vlatool.measurement.agreement import run_agreement
from vlatool.measurement.cold_start import cold_start
from vlatool.measurement.pairs import PairJob
from vlatool.measurement.turns import run_job

sys.path.insert(0, str(Path(__file__).parents[1] / "validation/soak/attacks"))

import gate_cheats
from gate_bundles import bases

UNTIMED = [
    name
    for name, cheat in gate_cheats.CHEATS.items()
    if cheat.gate.get("latency", 1) is None and "deadline" not in cheat.gate and cheat.found_by != "memory"
]
SLOW = ["fast on images of one colour", "slow on texts that were not recorded",
        "slow on all states but those exactly as they were recorded",
        "slow on states with a gripper that is exactly open or closed",
        *small_or_full([], ["fast on the empty instruction", "slow on a tenth of the states",
                            "slow on states exactly as they were recorded"])]  # fmt: skip


@pytest.fixture(scope="session")
def cheated(float_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Bundle]:
    """The policies that are cheated on; read only."""
    return bases(float_bundle, tmp_path_factory.mktemp("cheated"))


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys):
    """Run the command line without further processes, and without memory; return exit code and claims that fail."""

    def run(candidate: Path, baseline: Path, claims: dict) -> tuple[int, str]:
        monkeypatch.setattr(run_gate_module, "measure_agreement", lambda job, timeout: run_agreement(job))
        config = gate_cheats.gate_file({**claims, "memory": None}, tmp_path / "gate.yaml")
        line = ["gate", str(candidate), "--baseline", str(baseline), "--config", str(config), "--json"]
        with pytest.raises(SystemExit) as left:
            main(line)
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return left.value.code or 0, gate_cheats.failed(out) if out else err

    return run


@pytest.mark.parametrize("name", UNTIMED)
def test_a_cheat_fails_or_is_refused(cheated, gate, tmp_path: Path, name: str) -> None:
    cheat = gate_cheats.CHEATS[name]
    cheat.make(cheated[cheat.policy], tmp_path / "candidate")
    code, why = gate(tmp_path / "candidate", cheated[cheat.policy].path, cheat.gate)
    assert code == (1 if cheat.found_by else 3), why
    assert cheat.found_by in why


@pytest.mark.parametrize("policy", ["tiny", "gripper", "discrete", "two outputs", "noise", "recurrent"])
def test_the_same_bundle_passes(cheated, gate, policy: str) -> None:
    accuracy = None if policy == "noise" else {"max_drop": 0.5}  # what is recorded is another policy's
    assert gate(cheated[policy].path, cheated[policy].path, {"latency": None, "accuracy": accuracy}) == (0, "")


def test_int8_passes(float_bundle: Bundle, int8_bundle: Bundle, gate) -> None:
    claims = {"latency": None, "accuracy": {"max_drop": 0.2}, "size": {"margin": 1.0}}
    assert gate(int8_bundle.path, float_bundle.path, claims) == (0, "")


@pytest.mark.parametrize("name", SLOW)
def test_what_is_slow_on_some_observations_is_found_in_one_process(cheated, tmp_path: Path, monkeypatch, name) -> None:
    """One process of a gate: the slow path costs twenty times the policy, so that any machine tells it."""
    monkeypatch.setattr(turns, "WARMUP_MS", 0.0)
    monkeypatch.setattr(turns.gc, "freeze", lambda: None)
    cheat = gate_cheats.CHEATS[name]
    base = cheated[cheat.policy]
    made = cheat.make(base, tmp_path / "candidate")
    with Inputs(base, None, seed=1).file(20, TIMING) as path:
        found = run_job(PairJob(str(base.path), str(made.path), warmup=1, pairs=60, seed=1, observations=str(path)))
    assert found.mean_log_ratio > 0.02
    assert len(found.slow) == turns.CONFIRM
    assert sorted(found.slow)[5] > math.log(1.5)


def test_more_memory_on_any_text_shows(cheated, tmp_path: Path) -> None:
    made = gate_cheats.CHEATS["more memory on any text"].make(cheated["tiny"], tmp_path / "candidate")
    with Inputs(cheated["tiny"], None, seed=1).file(8, TIMING) as path:
        probed = [cold_start(bundle.path, "", 1, observations=path).peak_rss_mb
                  for bundle in (made, cheated["tiny"])]  # fmt: skip
    assert probed[0] > probed[1] + 60


def test_the_command_line_itself_leaves_with_1_or_3(cheated, tmp_path: Path) -> None:
    config = gate_cheats.gate_file({"latency": None, "memory": None}, tmp_path / "gate.yaml")
    fails, refused = ("negated logits, with data of its own", 1), ("golden action that load refuses", 3)
    for name, code in small_or_full((fails,), (fails, refused)):
        cheat = gate_cheats.CHEATS[name]
        made = cheat.make(cheated[cheat.policy], tmp_path / cheat.policy)
        got, why = gate_cheats.run(made.path, cheated[cheat.policy].path, config)
        assert got == code, why


def test_the_report_says_on_what_it_was_judged(cheated, tmp_path: Path, gate) -> None:
    from vlatool.bundle.bundle import hash_file
    from vlatool.gate.config import read_gate
    from vlatool.gate.run import run_gate
    from vlatool.stage.base import Context

    base = cheated["discrete"]
    made = gate_cheats.CHEATS["negated logits, with data of its own"].make(base, tmp_path / "candidate")
    config = gate_cheats.gate_file({"latency": None, "memory": None}, tmp_path / "gate.yaml")
    reports = [run_gate(made, base, read_gate(config), Context(), seed) for seed in (None, None, 5)]
    told = [{each["what"]: each["value"] for each in report.rows[1].details["measured with"]} for report in reports]
    assert told[0]["evaluation data"] == f"sha256:{hash_file(base.path / 'data/evaluation.npz')}"
    assert told[0]["evaluation data"] != f"sha256:{hash_file(made.path / 'data/evaluation.npz')}"
    assert told[0]["seed"] != told[1]["seed"], "nobody can know it before"
    assert told[2]["seed"] == 5
    assert reports[2].summary[-1].endswith("with the seed 5; --seed 5 draws them again.")
