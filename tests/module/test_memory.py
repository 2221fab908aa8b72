"""What forward() remembers is found, whenever it takes effect; what nothing depends on is left alone."""

import dataclasses
import types
from collections import deque

import numpy as np
import pytest
import torch
from torch import nn

from vlatool.bundle.program import ProgramStep
from vlatool.errors import SourceError
from vlatool.module.changed_buffers import refuse_changed_buffers
from vlatool.module.memory import refuse_kept_values
from vlatool.module.to_onnx import exported_by_torch

STEP = ProgramStep("main", {"x": "x"}, {"y": "y"})
FEEDS = [{"x": np.random.default_rng(seed).standard_normal((1, 3)).astype(np.float32)} for seed in (1, 2)]


class Remembering(nn.Module):
    """A linear layer, and something that forward() keeps."""

    def __init__(self, kept, forward):
        super().__init__()
        torch.manual_seed(0)
        self.linear = nn.Linear(3, 2)
        self.part = nn.Identity()
        if isinstance(kept, torch.Tensor):
            self.register_buffer("kept", kept)
        else:
            self.kept = kept() if callable(kept) else kept
        self.body = forward

    def forward(self, x):
        return self.body(self, x)


def counted(self, x):
    self.kept += 1
    return self.linear(x if self.kept < 700 else 2 * x)


def counted_in_a_part(self, x):
    self.part.turns = getattr(self.part, "turns", 0) + 1
    return self.linear(x * (self.part.turns < 100))


def counted_tensor(self, x):
    self.kept += 1
    return self.linear(torch.where(self.kept > 5000, -x, x))


def smoothed(self, x):
    self.kept = 0.9 * self.kept + 0.1 * x
    return self.linear(x + self.kept)


def last_action(self, x):
    y = self.linear(x)
    y, self.kept = (y if self.kept is None else y + 0.1 * self.kept), y
    return y


def history(self, x):
    self.kept.append(x)
    return self.linear(sum(self.kept) if len(self.kept) > 4 else x)


def in_a_dict(self, x):
    before = self.kept.get("x", x)
    self.kept["x"] = x
    return self.linear(x - 0.5 * before)


def toggled(self, x):
    self.kept = not self.kept
    return self.linear(x) if self.kept else -self.linear(x)


def rate(self, x):
    self.kept = 0.5 * (self.kept + float(x.mean()))
    return self.linear(x * min(1.0, 10.0 + self.kept))


@dataclasses.dataclass
class State:
    """What a policy may keep, under names."""

    memory: torch.Tensor = dataclasses.field(default_factory=lambda: torch.zeros(1, 3))
    step: int = 0


def in_a_record(self, x):
    self.kept.memory = 0.5 * self.kept.memory + x
    return self.linear(self.kept.memory)


def counted_in_a_record(self, x):
    self.kept = dataclasses.replace(self.kept, step=self.kept.step + 1)
    return self.linear(x if self.kept.step < 700 else 2 * x)


def counted_in_a_dict(self, x):
    self.kept["step"] += 1
    return self.linear(x if self.kept["step"] < 700 else 2 * x)


REMEMBER = {
    "a counter in a mapping": (lambda: {"step": 0}, counted_in_a_dict),
    "a field of a dataclass": (State, in_a_record),
    "a counter in a dataclass": (State, counted_in_a_record),
    "a field of a namespace": (lambda: types.SimpleNamespace(memory=torch.zeros(1, 3)), in_a_record),
    "a counter": (0, counted),
    "a counter in a part": (0, counted_in_a_part),
    "a counter that is a tensor": (torch.zeros(()), counted_tensor),
    "an average": (lambda: torch.zeros(1, 3), smoothed),
    "the last action": (None, last_action),
    "a history": (lambda: deque(maxlen=8), history),
    "an entry of a mapping": (dict, in_a_dict),
    "a switch": (False, toggled),
    "a number": (0.0, rate),
}


@pytest.mark.parametrize("name", REMEMBER)
def test_what_a_module_remembers_is_named(name):
    module = Remembering(*REMEMBER[name])
    with pytest.raises(SourceError, match=r"changes '(kept|part\.turns)' from call to call") as caught:
        refuse_kept_values(module, STEP, FEEDS)
    assert "'keep' in the program" in caught.value.fix


def logged(self, x):
    self.kept += 1
    return self.linear(x)


def shown(self, x):
    y = self.linear(x)
    self.kept = y.detach()
    return y


def cached(self, x):
    if "scale" not in self.kept:
        self.kept["scale"] = torch.ones(1, x.shape[1])
    return self.linear(x * self.kept["scale"])


def appended(self, x):
    self.kept.append(float(x.mean()))
    return self.linear(x)


def logged_in_a_record(self, x):
    self.kept.step += 1
    return self.linear(x)


HARMLESS = {
    "a counter for the log in a dataclass": (State, logged_in_a_record),
    "a counter for the log": (0, logged),
    "what is shown": (None, shown),
    "a table that is made once": (dict, cached),
    "a list for the log": (list, appended),
    "a buffer that is a log": (torch.zeros((), dtype=torch.int64), logged),
}


@pytest.mark.parametrize("name", HARMLESS)
def test_what_no_output_depends_on_is_left_as_it_was(name):
    module = Remembering(*HARMLESS[name])
    refuse_kept_values(module, STEP, FEEDS)
    refuse_kept_values(module, STEP, FEEDS[:1])
    if name == "a counter for the log":
        assert module.kept == 2


def test_a_buffer_that_changes_is_found_in_the_trace():
    for buffer, body in ((torch.zeros(()), counted_tensor), (torch.zeros(1, 3), smoothed)):
        with pytest.raises(SourceError, match="changes the buffer 'kept' from call to call") as caught:
            exported_by_torch(Remembering(buffer, body), [torch.ones(1, 3)], STEP, 20)
        assert caught.value.fix.startswith("let forward() take it as an input and return it")


def test_a_normalisation_in_training_mode_is_to_leave_it():
    with pytest.raises(SourceError, match="would forget") as caught:
        exported_by_torch(nn.Sequential(nn.BatchNorm1d(3)).train(), [torch.ones(4, 3)], STEP, 20)
    assert caught.value.fix.startswith("leave the module in evaluation mode")


def test_a_buffer_that_is_only_written_is_no_memory():
    def written(self, x):
        self.kept.copy_(x)
        return self.linear(self.kept)

    for buffer, body in ((torch.zeros((), dtype=torch.int64), logged), (torch.zeros(1, 3), written)):
        exported_by_torch(Remembering(buffer, body), [torch.ones(1, 3)], STEP, 20)
    norm = nn.Sequential(nn.Linear(3, 2), nn.Flatten()).eval()
    refuse_changed_buffers(torch.export.export(norm, (torch.ones(1, 3),)), "main")
