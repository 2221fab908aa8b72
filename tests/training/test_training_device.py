"""What a training computes on: which device is taken, and that nothing of a objective stays behind on another one.

No GPU is needed: on torch's ``meta`` device operations check that all tensors are on one device, and compute nothing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from _deep import write_deep
from _flow import write_flow
from torch import nn

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.module.torch_policy import load_modules
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform
from vlatool.training import device as device_module
from vlatool.training.device import CPU, Device, device_in_use, device_of, on_device
from vlatool.training.rounds import LABEL, NOISE
from vlatool.training.stage import TrainingStage

MANY = ("reshape(1, 4, 2)", "reshape(-1, 4, 2)")


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: not including_emulation)


@pytest.mark.parametrize(("asked", "precision", "processes", "device"), [
    ("auto", "auto", 1, Device("cuda", True)),
    ("auto", "float32", 1, Device("cuda", False)),
    ("cuda", "bfloat16", 1, Device("cuda", True)),
    ("cuda", "bfloat16", 2, Device("cuda", True)),
    ("auto", "float32", 2, Device("cpu", False)),
    ("cpu", "float32", 1, CPU),
])  # fmt: skip
def test_a_gpu_is_taken_where_there_is_one(gpu: None, asked: Any, precision: str, processes: int, device: Device):
    assert device_of(asked, precision, processes) == device


def test_a_gpu_that_is_not_there_or_would_be_shared_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert device_of("auto", "float32") == CPU
    with pytest.raises(RecipeError, match="--device cuda was asked for, and this torch finds no GPU"):
        device_of("cuda", "auto")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(RecipeError, match=r"takes a GPU for each process of a machine; asked for 2, torch finds 1"):
        device_of("cuda", "auto", 2)
    with pytest.raises(RecipeError, match=r"asked for 3, torch finds 1"):
        device_of("cuda", "auto", 6, 3)


@pytest.mark.parametrize(("features", "native"), [(("avx512_bf16",), True), (("avx2",), False), (None, False)])
def test_bfloat16_is_for_processors_that_multiply_it(monkeypatch: pytest.MonkeyPatch, features: Any, native: bool):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(device_module.host, "isa", lambda: features)
    assert device_of("auto", "auto") == Device("cpu", native)
    assert device_of("auto", "bfloat16").precision == "bfloat16"


def test_modules_come_back_whatever_happens():
    class Moved(nn.Module):
        places: tuple[str, ...] = ()

        def to(self, place: str) -> Moved:
            self.places += (place,)
            if place == "gone":
                raise RuntimeError("out of memory")
            return self

    first, second = Moved(), Moved()
    with contextlib.suppress(KeyboardInterrupt), Device("cuda").holding({"a": first}, {"b": second}):
        assert first.places == second.places == ("cuda",)
        raise KeyboardInterrupt
    assert first.places == second.places == ("cuda", "cpu")
    with pytest.raises(RuntimeError, match="out of memory"), Device("gone").holding({"a": first}):
        pass
    assert first.places[-1] == "cpu"
    with CPU.holding({"a": second}):
        assert len(second.places) == 2


def test_tensors_are_made_on_the_device_and_settings_come_back(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv(device_module.WORKSPACE, raising=False)
    array = np.zeros(3, np.float32)
    with Device("meta").computing():
        assert on_device(array).device.type == torch.zeros(1).device.type == device_in_use().name == "meta"
        assert torch.are_deterministic_algorithms_enabled()
    assert not torch.are_deterministic_algorithms_enabled()
    on_device(array)[0] = 1
    assert array[0] == 1
    assert device_in_use() == CPU


def test_a_gpu_without_memory_is_named():
    with (
        pytest.raises(RecipeError, match="memory of the GPU is full: tried to allocate") as caught,
        Device("meta").computing(),
    ):
        raise torch.OutOfMemoryError("tried to allocate 2 GiB")
    assert "--accumulate" in str(caught.value)
    with pytest.raises(torch.OutOfMemoryError), CPU.computing():
        raise torch.OutOfMemoryError("of somebody else")


@contextlib.contextmanager
def on_meta(*programs: Mapping[str, nn.Module]) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched, torch.device("meta"):
        patched.setattr(Device, "casting", lambda *_, **__: contextlib.nullcontext())  # meta has no autocast
        for module in (module for modules in programs for module in modules.values()):
            module.to("meta")
        yield


@pytest.mark.parametrize(("kind", "stage", "options"), [
    ("deep", "distill.policy", {"student": "", "loss": "l1"}),
    ("deep", "distill.policy", {"loss": "huber", "features": 1.0, "attention": 1.0}),
    ("deep", "distill.policy", {"loss": "l2", "alpha": 0.5}),
    ("deep", "quantize.qat", {"weights": "int8"}),
    ("deep", "quantize.qat", {"weights": "int4"}),
    ("flow", "distill.policy", {"loss": "l1"}),
])  # fmt: skip
def test_nothing_of_a_lesson_stays_on_another_device(tmp_path: Path, kind: str, stage: str, options: dict[str, Any]):
    folder = write_deep(tmp_path / "policy", MANY) if kind == "deep" else write_flow(tmp_path / "policy")
    source = run_transform(TorchModule(policy=folder), None, tmp_path / "source", Context()).bundle
    training = build_stage(stage, options)
    assert isinstance(training, TrainingStage)
    modules = load_modules(source)
    teacher, objective = training.prepare_objective(modules, source)
    rows = rows_of(source, teacher.program.noise)
    expert = {"expert." + name[len(LABEL) :]: value for name, value in rows.items() if name.startswith(LABEL)}
    losses = [(objective.loss, rows)] + ([(objective.expert, rows | expert)] if objective.expert else [])
    for loss, given in losses:
        assert loss(given).device.type == "cpu", "and looked whether modules take batches"
    with on_meta(objective.trainable, teacher.program.modules):
        for loss, given in losses:
            far = loss(given)
            assert far.device.type == "meta"
            far.backward()
    weights = [value for module in objective.modules.values() for value in module.parameters()]
    assert any(value.grad is not None and value.grad.device.type == "meta" for value in weights)


def rows_of(source: Bundle, noise: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Three rows of every input, label and noise."""
    random = np.random.default_rng(0)
    spec = source.manifest.spec

    def values(shape: Any, dtype: str) -> Any:
        return random.integers(0, 3, (3, *shape[1:])).astype(dtype)

    return {
        **{tensor.name: values(tensor.shape, tensor.dtype) for tensor in spec.inputs},
        **{LABEL + tensor.name: values(tensor.shape, "float32") for tensor in spec.outputs},
        **{NOISE + name: values(wanted["shape"], "float32") for name, wanted in noise.items()},
    }
