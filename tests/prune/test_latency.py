"""Pruning to a latency: what is measured decides what goes, and the result is made again without measuring."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from _tiny import deepen

from vlatool.bundle.bundle import Bundle
from vlatool.errors import DataError, RecipeError
from vlatool.export.onnx import ExportOnnx
from vlatool.module.edits import Edit, apply, read_edits
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.prune import latency
from vlatool.prune._clock import Clock
from vlatool.prune.latency import LatencyPruning
from vlatool.rebuild.rebuild import rebuild
from vlatool.runtime import load
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context, build_stage
from vlatool.stage.run import run_transform

FINE = {"samples": 4, "multiple": 1}
HEAD, TRUNK = 1e-2, 1e-3
"""Milliseconds for a weight, by part."""


class Counted(Clock):
    """A clock that counts weights, those of the trunk as slower."""

    def __init__(self, source: Bundle, *_rest: object) -> None:
        self.source = source
        self.runs = 0

    def times(self, pruned: Sequence[Sequence[Edit]]) -> tuple[float, list[float]]:
        self.runs += 1
        return self.ms(()), [self.ms(edits) for edits in pruned]

    def ms(self, edits: Sequence[Edit]) -> float:
        module = apply(load_modules(self.source), edits, self.source)["main"]
        return 1.0 + sum(value.numel() * (TRUNK if "blocks" in name else HEAD / 100)
                         for name, value in module.named_parameters())  # fmt: skip


@pytest.fixture
def deep(policy_dir: Path, tmp_path: Path) -> Bundle:
    """The tiny policy with three blocks."""
    deepen(policy_dir)
    return run_transform(TorchModule(policy=policy_dir), None, tmp_path / "deep", Context())


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latency, "Clock", Counted)
    monkeypatch.setattr("vlatool.stage.run.run_apart", lambda stage, *rest: stage.run(*rest))


@pytest.mark.parametrize("share", [0.9, 0.7, 0.5])
def test_the_target_is_met_and_made_again_without_measuring(
    counted: None, deep: Bundle, policy_dir: Path, tmp_path: Path, share: float, monkeypatch: pytest.MonkeyPatch
):
    clock = Counted(deep)
    target = share * clock.ms(())
    stage = build_stage("prune.latency", {"target_ms": target, **FINE})
    pruned = run_transform(stage, deep, tmp_path / "out", Context())
    assert 0.96 * target <= clock.ms(read_edits(pruned)) <= target
    assert json.loads(pruned.manifest.made_by["options"]["chosen"])
    exported = run_transform(ExportOnnx(), pruned, tmp_path / "onnx", Context())
    monkeypatch.setattr(latency, "Clock", None)
    assert rebuild(exported, Context(), source=str(policy_dir), cache=tmp_path / "cache").identical


def test_a_block_goes_where_it_matters_least(counted: None, deep: Bundle, tmp_path: Path):
    modules = load_modules(deep)
    stage = LatencyPruning(target_ms=0.6 * Counted(deep).ms(()), **FINE)
    edits = stage.change(modules, deep, Context()).edits
    assert [edit.module for edit in edits if edit.axis == "blocks"] == ["blocks"]
    kept = next(edit.keep for edit in edits if edit.axis == "blocks")
    assert all(edit.module.split(".")[1] in {str(number) for number in range(len(kept))}
               for edit in edits if edit.module.startswith("blocks."))  # fmt: skip
    assert all(edit.axis != "blocks" for edit in
               LatencyPruning(target_ms=0.6 * Counted(deep).ms(()), blocks=False, **FINE)
               .change(load_modules(deep), deep, Context()).edits)  # fmt: skip


@pytest.mark.parametrize(("target", "says"), [
    (1e5, r"It takes \d.* ms here already; asked for 100000 ms"),
    (0.01, r"No less than about .* ms can be reached here; asked for 0\.01"),
])  # fmt: skip
def test_a_target_that_makes_no_sense_is_refused(counted: None, deep: Bundle, tmp_path: Path, target: float, says: str):
    with pytest.raises(RecipeError, match=says):
        run_transform(build_stage("prune.latency", {"target_ms": target, **FINE}), deep, tmp_path / "out", Context())
    assert not (tmp_path / "out").exists()


def test_a_latency_that_jumps_is_not_called_met(
    counted: None, deep: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    class Jumping(Counted):
        def times(self, pruned: Sequence[Sequence[Edit]]) -> tuple[float, list[float]]:
            whole, others = super().times(pruned)
            return whole, others if self.runs == 1 else [ms * (2.0 if self.runs % 2 else 0.5) for ms in others]

    monkeypatch.setattr(latency, "Clock", Jumping)
    target = 0.7 * Counted(deep).ms(())
    with pytest.raises(DataError, match="was not met within 4%; measured: "):
        run_transform(build_stage("prune.latency", {"target_ms": target, **FINE}), deep, tmp_path / "out", Context())


def test_the_clock_runs_what_is_exported(deep: Bundle, tmp_path: Path):
    clock = Clock(deep, tmp_path, "", 1, dict(deep.manifest.made_by), Context())
    whole, (shallow,) = clock.times([(Edit("main", "blocks", "blocks", (0,)),)])
    assert whole > 0 < shallow
    exported = Bundle.open(tmp_path / "2-graphs")
    assert exported.graph_bytes < Bundle.open(tmp_path / "1-graphs").graph_bytes
    assert load(exported.path).spec == torch_policy(deep, 0).spec
