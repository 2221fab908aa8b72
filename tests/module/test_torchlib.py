"""Torch's table of ONNX functions is built once, and each export has its own."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from vlatool.bundle.program import ProgramStep
from vlatool.module import torchlib
from vlatool.module.to_onnx import OPSET, exported_by_torch
from vlatool.module.torchlib import build, shared_table

STEP = ProgramStep(graph="main", feeds={"x": "x"}, gives={"y": "y"})


def exported() -> bytes:
    torch.manual_seed(0)
    module = nn.Sequential(nn.Linear(3, 4), nn.GELU(), nn.LayerNorm(4)).eval()
    model: bytes = exported_by_torch(module, [torch.zeros(1, 3)], STEP, OPSET).model_proto.SerializeToString()
    return model


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The options of each table that is built; none was before."""
    from torch.onnx._internal.exporter._registration import ONNXRegistry

    original, seen = ONNXRegistry.__dict__["from_torchlib"], []

    def counted(kind: Any, **options: Any) -> Any:
        seen.append(options)
        return original.__get__(None, kind)(**options)

    monkeypatch.setattr(ONNXRegistry, "from_torchlib", classmethod(counted))
    monkeypatch.setattr(torchlib, "_tables", {})
    return seen


def test_exports_share_the_table_and_are_what_they_were(builds: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    build(OPSET)
    assert len(builds) == 1
    first, second = exported(), exported()
    assert len(builds) == 1
    monkeypatch.setattr(torchlib, "_registry", lambda: None)
    assert exported() == first == second
    assert len(builds) == 2


def test_a_table_is_the_callers_own(builds: list[Any]) -> None:
    registry = torchlib._registry()
    with shared_table():
        one = registry.from_torchlib(opset_version=OPSET)
        name, functions = next(iter(one.functions.items()))
        functions.append("added")
        one.functions["new"] = []
        other = registry.from_torchlib(opset_version=OPSET)
        assert "new" not in other.functions
        assert "added" not in other.functions[name]
        registry.from_torchlib(opset_version=18)
    assert [options["opset_version"] for options in builds] == [OPSET, 18]


def test_a_torch_without_such_a_table_exports_as_it_did(monkeypatch: pytest.MonkeyPatch) -> None:
    from torch.onnx._internal.exporter import _registration

    monkeypatch.setattr(_registration, "ONNXRegistry", type("Other", (), {}))
    assert torchlib._registry() is None
    with shared_table():
        build(OPSET)
