"""However a factory gets its weights, `hwselect` counts the policy from its source."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from vlatool.boards.answer import count_workload, open_bundle
from vlatool.stage.base import Context

YAML = """\
schema: 1
name: counted
version: 1.0.0
source: policy.py:make
spec:
  inputs: [{name: state, shape: [1, 6]}]
  outputs: [{name: action, shape: [1, 1, 2]}]
  control_hz: 10
"""
HEAD = """\
from pathlib import Path
import torch
from torch import nn
HERE = Path(__file__).parent

class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        self.body = nn.Linear(6, 8)
        self.head = nn.Linear(8, 2)

    def forward(self, state):
        return self.head(torch.relu(self.body(state)))[:, None]

"""
MAKES = {
    "weights of its own": "def make():\n    return Policy()\n",
    "load_state_dict": """\
def make():
    policy = Policy()
    policy.load_state_dict(torch.load(HERE / "weights.pt"))
    return policy
""",
    "assigned": """\
def make():
    policy = Policy()
    policy.load_state_dict(torch.load(HERE / "weights.pt"), assign=True)
    return policy
""",
    "safetensors, moved": """\
def make():
    from safetensors.torch import load_model
    policy = Policy().to("cpu")
    load_model(policy, str(HERE / "weights.safetensors"))
    return policy.to(torch.device("cpu"), torch.float32)
""",
    "a whole pickled module": """\
def make():
    torch.save(Policy(), HERE / "module.pt")
    return torch.load(HERE / "module.pt", weights_only=False)
""",
    "built on meta, then filled": """\
def make():
    with torch.device("meta"):
        policy = Policy()
    policy.to_empty(device="cpu")
    with torch.no_grad():
        for name, value in torch.load(HERE / "weights.pt").items():
            policy.get_parameter(name).copy_(value)
    return policy
""",
    "looks at values": """\
def make():
    policy = Policy()
    policy.load_state_dict(torch.load(HERE / "weights.pt"))
    policy.register_buffer("scale", torch.full((2,), 1 / policy.head.weight.abs().max().item()))
    if not torch.isfinite(policy.body.weight).all():
        raise ValueError("the weights are not finite")
    return policy
""",
}


@pytest.mark.parametrize("kind", MAKES)
def test_a_policy_is_counted_however_its_weights_are_loaded(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "policy"
    folder.mkdir()
    (folder / "policy.yaml").write_text(YAML)
    (folder / "policy.py").write_text(HEAD + MAKES[kind])
    weights = {
        "body.weight": torch.randn(8, 6), "body.bias": torch.zeros(8),
        "head.weight": torch.randn(2, 8), "head.bias": torch.zeros(2),
    }  # fmt: skip
    torch.save(weights, folder / "weights.pt")
    save_file(weights, str(folder / "weights.safetensors"))
    found = count_workload(open_bundle(str(folder), Context()), Context()).graphs["main"]
    assert found.macs == {"float32": 6 * 8 + 8 * 2}
    assert (found.weights, found.layers, found.unknown) == (6 * 8 + 8 * 2, 2, ())
