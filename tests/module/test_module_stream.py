"""A safetensors file that is written one tensor at a time is read as any other."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from vlatool.module.edits import stream_tensors, write_module


def test_what_is_streamed_is_read_again(tmp_path: Path):
    tensors = {
        "wide": torch.randn(3, 5, dtype=torch.float64), "weight": torch.randn(4, 3), "step": torch.tensor(7.0),
        "empty": torch.zeros(0, 3), "half": torch.randn(3).to(torch.bfloat16),
    }  # fmt: skip
    forms = {name: (value.dtype, list(value.shape)) for name, value in tensors.items()}
    stream_tensors(tmp_path / "file", forms, iter(tensors.values()), {"step": "3"})
    read = load_file(tmp_path / "file")
    assert all(torch.equal(read[name], value) for name, value in tensors.items())
    with safe_open(tmp_path / "file", "pt") as opened:
        assert opened.metadata() == {"step": "3"}


def test_a_full_disk_is_told(tmp_path: Path):
    with pytest.raises(OSError, match="No space left"):
        stream_tensors(Path("/dev/full"), {"a": (torch.float32, [99999])}, iter([torch.zeros(99999)]), {})


def test_tensors_that_share_memory_are_written_apart(tmp_path: Path):
    module = torch.nn.ModuleDict({"a": torch.nn.Linear(2, 2), "b": torch.nn.Linear(2, 2)})
    module["b"].weight = module["a"].weight
    write_module(tmp_path, (), {"main": module})
    read = load_file(tmp_path / "module/main.safetensors")
    assert {*read} == {"a.weight", "a.bias", "b.bias"}, "what is tied is stored once"
