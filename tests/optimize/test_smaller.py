"""A recipe whose candidates are pruned and trained before they are exported and quantized."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from _full import small_or_full

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main

STAGES = {
    "pruned": [{"prune.neurons": {"ratio": 0.5}}],
    "smaller": [
        {"prune.neurons": {"ratio": 0.5}},
        {"distill.policy": {"steps": 30, "batch": 8, "episodes": 0, "student_episodes": 0, "learning_rate": 0.003}},
        {"quantize.static_int8": {}},
    ],
}


def run(*words: str) -> None:
    with pytest.raises(SystemExit) as left:
        main([*words])
    assert not left.value.code


@pytest.fixture(scope="module")
def out(policy_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What is made of the tiny policy with its episodes; read only."""
    return optimized(policy_template, tmp_path_factory.mktemp("smaller"))


def optimized(policy: Path, folder: Path) -> Path:
    (folder / "recipe.yaml").write_text(json.dumps({"schema": 1, "candidates": STAGES, "search": False}))
    limits = ["--max-drop", "90%", "--episodes", "30", "--iterations", "20"]
    run("optimize", str(policy), "--recipe", str(folder / "recipe.yaml"), "-o", str(folder / "out"), *limits)
    return folder / "out"


def test_candidates_are_pruned_trained_exported_and_quantized(out: Path):
    report = json.loads((out / "reports/report.json").read_text())
    rows = {row["name"]: row for row in report["rows"]}
    assert list(rows) == ["float32", "pruned", "smaller"]
    sizes = {name: number(row, "size") for name, row in rows.items()}
    assert sizes["smaller"] < sizes["pruned"] < sizes["float32"]
    assert all(number(rows[name], "latency_p50") > 0 for name in rows)
    assert number(rows["smaller"], "relative_error") > 0
    assert Bundle.open(out).manifest.graphs
    trained = "training: distill.policy"
    assert len(rows["smaller"]["raw"][trained]) == 30
    assert rows["smaller"]["details"][trained][0]["who acted"] == "recordings"
    assert number(rows["smaller"], "training_time.distill.policy") > 0
    assert [name for name, row in rows.items() if trained in row["raw"]] == ["smaller"]
    page = (out / "reports/report.html").read_text()
    assert page.count("Loss of smaller: distill.policy") == 2, "for a screen and a phone"


@pytest.mark.parametrize("listens", small_or_full([True], [True, False]))
def test_what_was_trained_is_told_the_wrong_instruction(listens: bool, out: Path, policy_dir: Path, tmp_path: Path):
    """Beside float32, on the first of the same seeds; nothing is said where the environment knows no wrong one."""
    if not listens:
        code = policy_dir / "environment.py"
        code.write_text(code.read_text().replace('make(task="reach", instruction="right")', 'make(task="reach")')
                        .replace("Environment(task, instruction)", 'Environment(task, "right")'))  # fmt: skip
        out = optimized(policy_dir, tmp_path)
    rows = {row["name"]: row for row in json.loads((out / "reports/report.json").read_text())["rows"]}
    (teacher,) = rows["smaller"]["details"]["training: distill.policy, and its teacher"]
    if not listens:
        assert "with the wrong instruction" not in teacher
        return
    assert teacher["with the wrong instruction"] == "30.0% of 20 episodes succeed (float32: 30.0%)"
    told = next(item for item in rows["smaller"]["measurements"] if item["name"] == "success_wrong_instruction")
    assert (told["samples"], told["low"] < 0.3 < told["high"]) == (20, True)
    assert [name for name, row in rows.items() if "success_wrong_instruction" in str(row)] == ["smaller"]
    assert teacher["with the wrong instruction"] in (out / "reports/report.html").read_text()


def number(row: dict[str, Any], name: str) -> float:
    return next(item["value"] for item in row["measurements"] if item["name"] == name)
