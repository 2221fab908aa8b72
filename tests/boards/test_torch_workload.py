from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from vlatool.boards.report import work_sentence
from vlatool.boards.torch_workload import torch_workload
from vlatool.bundle.bundle import Bundle
from vlatool.errors import SourceError
from vlatool.export.onnx import ExportOnnx
from vlatool.graph.workload import workload
from vlatool.latency_model.board import work_of
from vlatool.samples._write import write_sample
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context


def test_a_source_counts_as_the_bundle_that_is_exported_from_it(source_bundle: Bundle, float_bundle: Bundle) -> None:
    found, wanted = torch_workload(source_bundle), workload(float_bundle)
    assert found.runs == wanted.runs
    assert set(found.graphs) == set(wanted.graphs) == {"main"}
    for name in ("macs", "layers", "activations", "weights", "traits", "activation_bytes", "parts"):
        assert getattr(found.graphs["main"], name) == getattr(wanted.graphs["main"], name), name
    assert wanted.graphs["main"].traits == {"attention", "branches"}
    assert set(wanted.graphs["main"].parts) == {"vision", "head", ""}


def test_nothing_is_unknown_and_memory_is_near_that_of_the_bundle(source_bundle: Bundle, float_bundle: Bundle) -> None:
    found, wanted = torch_workload(source_bundle).graphs["main"], workload(float_bundle).graphs["main"]
    assert found.unknown == ()
    assert not found.integer_ops
    assert found.weight_bytes == pytest.approx(wanted.weight_bytes, rel=0.1)
    assert 0.3 < found.peak_bytes / wanted.peak_bytes < 3


def test_counting_twice_gives_the_same(source_bundle: Bundle) -> None:
    assert torch_workload(source_bundle) == torch_workload(source_bundle)


def remade(policy: Path, out: Path) -> Bundle:
    out.mkdir()
    return TorchModule(policy=policy).run(None, out, Context()).bundle


def test_code_that_changed_since_is_refused(policy_dir: Path, tmp_path: Path) -> None:
    bundle = remade(policy_dir, tmp_path / "source")
    (policy_dir / "policy.py").write_text((policy_dir / "policy.py").read_text() + "\n# edited\n")
    with pytest.raises(SourceError, match=r"policy.py has changed since the source bundle was made"):
        torch_workload(bundle)


def test_a_policy_that_looks_at_values_says_what_to_do(policy_dir: Path, tmp_path: Path) -> None:
    text = (policy_dir / "policy.py").read_text()
    looks = "        if float(image.sum()) < 0:\n            raise ValueError\n"
    text = text.replace("        pixels =", f"{looks}        pixels =")
    (policy_dir / "policy.py").write_text(text)
    bundle = remade(policy_dir, tmp_path / "source")
    with pytest.raises(SourceError, match="cannot be run without its weights") as caught:
        torch_workload(bundle)
    assert "export it first" in caught.value.fix


def test_attention_of_torch_counts_as_its_two_products(policy_dir: Path, tmp_path: Path, float_bundle: Bundle) -> None:
    text = (policy_dir / "policy.py").read_text()
    old = "torch.softmax(scores, -1) @ self.value(normed)"
    projected = "(m(normed)[:, None] for m in (self.query, self.key, self.value))"
    new = f"nn.functional.scaled_dot_product_attention(*{projected})[:, 0]"
    assert old in text
    scores = next(line for line in text.splitlines() if "scores =" in line)
    (policy_dir / "policy.py").write_text(text.replace(old, new).replace(scores + "\n", ""))
    found = torch_workload(remade(policy_dir, tmp_path / "source")).graphs["main"]
    wanted = workload(float_bundle).graphs["main"]
    assert (found.macs, found.layers, found.traits) == (wanted.macs, wanted.layers, wanted.traits)


@pytest.mark.soak("the counts of smaller policies in this file")
def test_a_large_policy_is_counted_without_its_memory(tmp_path: Path) -> None:
    folder = tmp_path / "large"
    folder.mkdir()
    (folder / "policy.py").write_text(
        "from torch import nn\n"
        "class Policy(nn.Module):\n"
        "    def __init__(self):\n"
        "        super().__init__()\n"
        "        self.layers = nn.Sequential(*(nn.Linear(16384, 16384) for _ in range(4)))\n"
        "    def forward(self, state):\n"
        "        return self.layers(state)[:, None, :2]\n"
        "def make():\n    return Policy()\n"
    )
    (folder / "policy.yaml").write_text(
        "schema: 1\nname: large\nversion: 1.0.0\nsource: policy.py:make\nspec:\n"
        "  inputs: [{name: state, shape: [1, 16384]}]\n"
        "  outputs: [{name: action, shape: [1, 1, 2]}]\n"
        "  control_hz: 10\n"
    )
    bundle = remade(folder, tmp_path / "source")
    code = (
        "import json, resource, sys\nfrom pathlib import Path\nimport torch\n"
        "from vlatool.user_code import trust\nfrom vlatool.bundle.bundle import Bundle\n"
        "from vlatool.boards.torch_workload import torch_workload\ntrust.allow(Path(sys.argv[2]))\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "found = torch_workload(Bundle.open(Path(sys.argv[1]))).graphs['main']\n"
        "grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before\n"
        "print(json.dumps([found.macs, found.weights, found.weight_bytes, grown]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(bundle.path), str(folder)], capture_output=True, text=True, check=True
    )
    macs, weights, stored, grown = json.loads(done.stdout)
    assert macs == {"float32": 4 * 16384**2}
    assert weights == 4 * 16384**2
    assert stored == 4 * 4 * (16384**2 + 16384)
    assert grown < 600_000, "kB; the weights would be 4.3 GB"


STRIDED = """\
from torch import nn

class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(6, 8, bias=False)

    def forward(self, state):
        return self.layer(state.transpose(1, 2))

def make():
    return Policy()
"""
STRIDED_YAML = """\
schema: 1
name: strided
version: 1.0.0
source: policy.py:make
spec:
  inputs: [{name: state, shape: [1, 6, 5]}]
  outputs: [{name: action, shape: [1, 5, 8]}]
  control_hz: 10
  chunk: 5
"""


def test_the_weight_of_a_linear_layer_over_strided_rows_counts_once(tmp_path: Path) -> None:
    """torch writes it as a batched product with the weight expanded over the batch."""
    folder = tmp_path / "strided"
    folder.mkdir()
    (folder / "policy.py").write_text(STRIDED)
    (folder / "policy.yaml").write_text(STRIDED_YAML)
    found = torch_workload(remade(folder, tmp_path / "source")).graphs["main"]
    assert (found.weights, found.macs, found.traits) == (48, {"float32": 5 * 48}, frozenset())


def test_a_sample_is_counted_with_its_attention(tmp_path: Path) -> None:
    (tmp_path / "sample").mkdir()
    write_sample("action_expert", tmp_path / "sample", 0)
    found = torch_workload(remade(tmp_path / "sample", tmp_path / "source"))
    graph = found.graphs["main"]
    assert found.runs == {"main": 1}
    assert 120e6 < graph.weights < 128e6, "127 M parameters, says its description"
    assert "attention" in graph.traits


LOOPED = """\
import torch
from torch import nn

class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        self.step = nn.Linear(6, 6)
        self.mix = nn.Conv1d(1, 1, 3, padding=1, bias=False)

    def forward(self, state):
        for _ in range(5):
            state = state + torch.tanh(self.mix(self.step(state)[:, None])[:, 0])
        return state[:, None]

def make():
    torch.manual_seed(0)
    return Policy()
"""
LOOPED_YAML = """\
schema: 1
name: looped
version: 1.0.0
source: policy.py:make
spec:
  inputs: [{name: state, shape: [1, 6]}]
  outputs: [{name: action, shape: [1, 1, 6]}]
  control_hz: 10
"""


def test_the_weights_of_a_loop_count_once_and_are_read_in_each_turn(tmp_path: Path) -> None:
    folder = tmp_path / "looped"
    folder.mkdir()
    (folder / "policy.py").write_text(LOOPED)
    (folder / "policy.yaml").write_text(LOOPED_YAML)
    source = remade(folder, tmp_path / "source")
    (tmp_path / "exported").mkdir()
    for found in (torch_workload(source), workload(ExportOnnx().run(source, tmp_path / "exported", Context()).bundle)):
        graph = found.graphs["main"]
        assert (graph.weights, graph.reads, graph.layers) == (36 + 3, 5 * 39, 10)
        assert work_of(graph).weights == 5 * 39, "a turn of the loop reads its weights again, which takes time"
        assert "with 39 weights" in work_sentence(found)
