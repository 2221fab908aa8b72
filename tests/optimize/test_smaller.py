"""A recipe whose candidates are pruned and trained before they are exported and quantized."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

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


def test_candidates_are_pruned_trained_exported_and_quantized(policy_dir: Path, tmp_path: Path):
    (tmp_path / "recipe.yaml").write_text(json.dumps({"schema": 1, "candidates": STAGES, "search": False}))
    limits = ["--max-drop", "90%", "--episodes", "0", "--iterations", "20"]
    run("optimize", str(policy_dir), "--recipe", str(tmp_path / "recipe.yaml"), "-o", str(tmp_path / "out"), *limits)
    report = json.loads((tmp_path / "out/reports/report.json").read_text())
    rows = {row["name"]: row for row in report["rows"]}
    assert list(rows) == ["float32", "pruned", "smaller"]
    sizes = {name: number(row, "size") for name, row in rows.items()}
    assert sizes["smaller"] < sizes["pruned"] < sizes["float32"]
    assert all(number(rows[name], "latency_p50") > 0 for name in rows)
    assert number(rows["smaller"], "relative_error") > 0
    assert Bundle.open(tmp_path / "out").manifest.graphs
    trained = "training: distill.policy"
    assert len(rows["smaller"]["raw"][trained]) == 30
    assert rows["smaller"]["details"][trained][0]["who acted"] == "recordings"
    assert number(rows["smaller"], "training_time.distill.policy") > 0
    assert [name for name, row in rows.items() if trained in row["raw"]] == ["smaller"]
    page = (tmp_path / "out/reports/report.html").read_text()
    assert page.count("Loss of smaller: distill.policy") == 2, "for a screen and a phone"


def number(row: dict[str, Any], name: str) -> float:
    return next(item["value"] for item in row["measurements"] if item["name"] == name)
