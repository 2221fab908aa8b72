"""Commands that torchrun starts: trainings take its number of processes, all others are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from vlatool.bundle.bundle import Bundle

SAID = {"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "1", "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": "1"}  # fmt: skip


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    for name, value in SAID.items():
        monkeypatch.setenv(name, value)
    return monkeypatch


@pytest.mark.parametrize("line", [
    ("export", "onnx", "POLICY", "-o", "OUT"),
    ("prune", "depth", "POLICY", "-o", "OUT"),
    ("benchmark", "latency", "POLICY"),
    ("optimize", "POLICY", "-o", "OUT"),
])  # fmt: skip
def test_what_is_no_training_is_refused(
    vlatool: Any, said: pytest.MonkeyPatch, source_bundle: Bundle, tmp_path: Path, line: tuple[str, ...]
):
    places = {"POLICY": str(source_bundle.path), "OUT": str(tmp_path / "out")}
    code, _, told = vlatool(*(places.get(word, word) for word in line))
    assert code == 2
    assert f"torchrun started 2 processes of vlatool {line[0]}" in told
    assert "unset RANK and WORLD_SIZE" in told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("options", "name", "value", "code", "words"), [
    (("--processes", "3"), "RANK", "0", 2, "torchrun started 2 processes, and --processes asks for 3"),
    ((), "MASTER_ADDR", "", 3, "MASTER_ADDR is 'not set'"),
    ((), "RANK", "2", 3, "RANK=2 of WORLD_SIZE=2"),
    ((), "MASTER_PORT", "1", 3, "The store of torchrun at 127.0.0.1:1 does not answer"),
])  # fmt: skip
def test_a_training_that_torchrun_did_not_start_so_is_refused(
    vlatool: Any, said: pytest.MonkeyPatch, source_bundle: Bundle, tmp_path: Path, options: Any, name: str, value: str,
    code: int, words: str,
):  # fmt: skip
    said.setenv(name, value)
    said.setattr("vlatool.training.torchrun.START_S", 0.3)
    said.setenv("TORCHELASTIC_USE_AGENT_STORE", "True")
    ended, _, told = vlatool("distill", "policy", source_bundle.path, "-o", tmp_path / "out", *options)
    assert words in told
    assert ended == code
