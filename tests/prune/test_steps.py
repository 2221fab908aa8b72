"""Fewer denoising steps: the program integrates the same span in larger steps, and distillation makes up for it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from _flow import write_flow
from safetensors.torch import save_file

from vlatool.bundle.bundle import Bundle
from vlatool.bundle.program import ProgramStep
from vlatool.cli import main
from vlatool.errors import DataError, RecipeError, SourceError
from vlatool.export.onnx import ExportOnnx
from vlatool.gate.claims.accuracy import Accuracy
from vlatool.gate.config import Gate
from vlatool.gate.same import check
from vlatool.module import sharded_weights, stage
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.prune.steps import Steps, with_fewer_steps
from vlatool.rebuild.rebuild import rebuild
from vlatool.runtime import load
from vlatool.runtime.policy import relative_error
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that integrates a flow in four steps; read only."""
    return write_flow(tmp_path_factory.mktemp("flow") / "flow")


@pytest.fixture(scope="module")
def source(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    return run_transform(TorchModule(policy=folder), None, tmp_path_factory.mktemp("source") / "out", Context()).bundle


@pytest.fixture(scope="module")
def one(source: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    return run_transform(Steps(to=1), source, tmp_path_factory.mktemp("one") / "out", Context()).bundle


def error(bundle: Bundle, whole: Bundle) -> float:
    """The mean relative error of the actions for new states, from the same noise."""
    ours, theirs = torch_policy(bundle, 0), torch_policy(whole, 0)
    states = np.random.default_rng(1).standard_normal((32, 3)).astype(np.float32)
    errors = []
    for state in states:
        ours.reset()
        theirs.reset()
        errors.append(relative_error(ours.infer({"state": state}).chunk, theirs.infer({"state": state}).chunk))
    return float(np.mean(errors))


def test_the_program_has_larger_steps_and_runs(one: Bundle, source: Bundle, folder: Path, tmp_path: Path):
    prefix, head = one.manifest.program
    assert (head.repeat, head.schedule) == (1, {"t": [1.0], "dt": [-1.0]})
    assert prefix == source.manifest.program[0]
    exported = run_transform(ExportOnnx(), one, tmp_path / "out", Context()).bundle
    state = {"state": np.ones(3, np.float32)}
    ours, wanted = load(exported.path, seed=0), torch_policy(one, 0)
    assert relative_error(ours.infer(state).chunk, wanted.infer(state).chunk) < 1e-5
    assert rebuild(exported, Context(), source=str(folder), cache=tmp_path / "cache").identical
    whole = run_transform(ExportOnnx(), source, tmp_path / "whole", Context()).bundle
    with pytest.raises(DataError, match="runs fewer steps than the baseline, and no claim is made of its accuracy"):
        check(exported, whole, Gate(accuracy=None))
    check(exported, whole, Gate(accuracy=Accuracy(data=tmp_path / "any.npz")))


@pytest.fixture
def sharded(folder: Path, source: Bundle, tmp_path: Path) -> Bundle:
    """The same policy with other weights, which are in two shards that its description names."""
    place = Path(shutil.copytree(folder, tmp_path / "sharded"))
    for graph, module in load_modules(source).items():
        save_file({f"{graph}.{name}": 1.5 * value for name, value in module.state_dict().items()},
                  place / f"{graph}.safetensors")  # fmt: skip
    description = place / "policy.yaml"
    description.write_text(description.read_text() + 'weights: "*.safetensors"\n')
    return run_transform(TorchModule(policy=place), None, tmp_path / "sharded-source", Context()).bundle


def test_weights_in_shards_stay_there(sharded: Bundle, one: Bundle, tmp_path: Path):
    made = run_transform(Steps(to=1), sharded, tmp_path / "out", Context()).bundle
    assert [name for name in made.manifest.files if name.startswith("module/")] == ["module/edits.json"]
    assert made.manifest.program == one.manifest.program
    got, wanted = load_modules(made), load_modules(sharded)
    for graph, module in wanted.items():
        assert all(torch.equal(got[graph].state_dict()[name], value) for name, value in module.state_dict().items())
    exported = run_transform(ExportOnnx(), made, tmp_path / "onnx", Context()).bundle
    assert error(made, sharded) > 0.01
    state = {"state": np.ones(3, np.float32)}
    actions = [policy.infer(state).chunk for policy in (load(exported.path, seed=0), torch_policy(made, 0))]
    assert relative_error(*actions) < 1e-5
    assert rebuild(made, Context(), source=str(tmp_path / "sharded"), cache=tmp_path / "cache").identical
    save_file({"see.weight": torch.zeros(16, 3), "see.bias": torch.zeros(16)}, tmp_path / "sharded/prefix.safetensors")
    with pytest.raises(SourceError, match=r"have changed since .* was made"):
        load_modules(made)


def test_weights_in_large_shards_are_not_read(sharded: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    read = list[str]()
    monkeypatch.setattr(sharded_weights, "read_tensor", lambda _reader, tensor, _dtype: read.append(tensor.name))
    monkeypatch.setattr("vlatool.module.torch_policy.shard_files", lambda *_: read.append("all") or [])
    monkeypatch.setattr(stage, "MAX_RUN_BYTES", 0)
    (tmp_path / "out").mkdir()
    made = Steps(to=2).run(sharded, tmp_path / "out", Context()).bundle
    assert made.manifest.program[1].repeat == 2
    assert not read


def test_what_many_steps_reached_is_learnt(one: Bundle, source: Bundle, tmp_path: Path):
    options = {"steps": 300, "batch": 32, "learning_rate": 0.01, "average": 0.9, "loss": "l2", "threads": 1}
    made = run_transform(build_stage("distill.policy", options), one, tmp_path / "out", Context()).bundle
    assert made.manifest.program == one.manifest.program
    assert error(made, source) < 0.5 * error(one, source)


@pytest.mark.parametrize(("schedule", "count", "wanted"), [
    ({"t": [1.0, 0.75, 0.5, 0.25], "dt": [-0.25] * 4}, 2, {"t": [1.0, 0.5], "dt": [-0.5, -0.5]}),
    ({"dt": [0.25] * 4, "t": [0.0, 0.25, 0.5, 0.75]}, 1, {"dt": [1.0], "t": [0.0]}),
    ({"t": [0, 250, 500, 750], "dt": [250] * 4}, 2, {"t": [0, 500], "dt": [500, 500]}),
    ({"t": [1.0, 0.75, 0.5, 0.25], "dt": [-0.25] * 4}, 3,
     {"t": [1.0, 1 - 1 / 3, 1 - 2 / 3], "dt": [-1 / 3] * 3}),
])  # fmt: skip
def test_times_and_sizes_span_the_same(schedule, count: int, wanted):
    step = ProgramStep("head", {"t": "t", "dt": "dt"}, {"x": "x"}, 4, {}, schedule)
    made = with_fewer_steps(step, count)
    assert made.repeat == count
    assert list(made.schedule) == list(wanted)
    for name, numbers in wanted.items():
        assert made.schedule[name] == pytest.approx(numbers)
        assert {type(number) for number in made.schedule[name]} == {type(number) for number in numbers}


@pytest.mark.parametrize(("schedule", "to", "says"), [
    ({"t": [1.0, 0.75, 0.5, 0.25]}, 2, r"has no schedule of the step size, .* \(t: -0\.25\)"),
    ({"t": [1.0, 0.9, 0.5, 0.25], "dt": [-0.25] * 4}, 2, "The schedule of 't' is neither constant nor evenly spaced"),
    ({"t": [1.0, 0.75, 0.5, 0.25], "dt": [-0.1] * 4}, 2, "has no schedule of the step size"),
    ({"dt": [-0.25] * 4}, 2, r"has no schedule of the step size, .* \(no times\)"),
    ({"t": [1.0, 0.75, 0.5, 0.25], "dt": [-0.25] * 4}, 4, "repeats 'head' 4 times; --to is 4"),
    ({"t": [0, 1, 2, 3], "dt": [1] * 4}, 3, "has integers"),
])  # fmt: skip
def test_what_cannot_have_fewer_steps_is_refused(schedule, to: int, says: str):
    step = ProgramStep("head", {name: name for name in schedule}, {"x": "x"}, 4, {}, schedule)
    with pytest.raises(RecipeError, match=says):
        with_fewer_steps(step, to)


def test_a_policy_without_repeats_is_refused(source_bundle: Bundle, tmp_path: Path):
    with pytest.raises(RecipeError, match="repeats no graph"):
        run_transform(Steps(to=1), source_bundle, tmp_path / "out", Context())


def test_what_changed_is_said_and_not_that_nothing_did(folder: Path, one: Bundle, tmp_path: Path, capsys):
    words = ["prune", "steps", str(folder), "--to", "1", "-o", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as left:
        main(words)
    assert not left.value.code
    told = capsys.readouterr().out
    assert "steps of 'head': 4 -> 1" in told
    assert "weights 0.00 MB, no structural edits, 1 denoising step; not exported yet:" in told
