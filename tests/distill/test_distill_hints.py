"""Students that learn from the inside of their teachers: what is compared, exactly as often as it is run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from _deep import write_deep
from _flow import write_flow
from _full import small_or_full
from _trainings import Killed, digest, distilled, killed_after, raise_killed, training_of
from safetensors.numpy import load_file

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.module.torch_policy import load_modules
from vlatool.prune.depth import Depth
from vlatool.prune.neurons import Neurons
from vlatool.prune.steps import Steps
from vlatool.prune.structured import Structured
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform
from vlatool.training.rounds import LABEL
from vlatool.training.stage import TrainingStage

pytestmark = pytest.mark.usefixtures("in_this_process")
HINTS = {"features": 0.5, "attention": 0.25}
MANY = ("reshape(1, 4, 2)", "reshape(-1, 4, 2)")
"""Lets the policy take batches."""


def source_of(folder: Path, out: Path) -> Bundle:
    return run_transform(TorchModule(policy=folder), None, out, Context()).bundle


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("deep")


@pytest.fixture(scope="module")
def shallow(place: Path) -> Bundle:
    """Two of four blocks; read only."""
    source = source_of(write_deep(place / "policy", MANY), place / "source")
    return run_transform(Depth(keep=(0, 2)), source, place / "shallow", Context()).bundle


@pytest.fixture(scope="module")
def wide(place: Path) -> Bundle:
    """A teacher that takes one observation at a time, with three wider blocks; read only."""
    return source_of(write_deep(place / "wide", layers=3, width=24), place / "wide-source")


def weights(made: Bundle) -> np.ndarray:
    tensors = load_file(made.path / "module/main.safetensors")
    return np.concatenate([value.ravel() for _, value in sorted(tensors.items())])


def test_they_pull_the_features_to_the_teachers(shallow: Bundle, tmp_path: Path):
    options = {"steps": 40, "batch": 16, "learning_rate": 0.01}
    plain = distilled(shallow, tmp_path / "plain", **options)
    hinted = distilled(shallow, tmp_path / "hinted", **options, features=5.0)
    far = [_far(bundle) for bundle in (shallow, plain, hinted)]
    assert far[2] < 0.5 * far[0]
    assert far[2] < 0.8 * far[1]
    training = training_of(hinted)
    assert training["loss"] == "l1, 5 features"
    assert training["hints"] == {
        "features": {"weight": 5.0, "blocks": [["main", "blocks", 0, 1], ["main", "blocks", 1, 3]]}
    }
    assert "hints" not in training_of(plain)
    names = load_modules(shallow)["main"].state_dict().keys()
    assert load_file(hinted.path / "module/main.safetensors").keys() == names
    lines = build_stage("distill.policy", {}).summarize(hinted)
    assert "features of blocks (student:teacher): main blocks 0:1 1:3" in lines


def _far(student: Bundle) -> float:
    """The term of the features alone."""
    _, objective = build_stage("distill.policy", {"features": 1.0}).prepare_objective(load_modules(student), student)
    with torch.no_grad():
        return float(objective.loss(recorded_rows()) - objective.judged(recorded_rows()))


def recorded_rows(count: int = 5) -> dict[str, np.ndarray]:
    """Encoded observations of the tiny policy, and labels."""
    random = np.random.default_rng(4)
    return {
        "image": random.integers(0, 256, (count, 8, 8, 3), np.uint8),
        "proprio": random.standard_normal((count, 3)).astype(np.float32),
        "instruction": random.integers(0, 9, (count, 4)),
        f"{LABEL}action": random.standard_normal((count, 4, 2)).astype(np.float32),
    }


def test_without_weights_nothing_is_different(shallow: Bundle, tmp_path: Path):
    made = [distilled(shallow, tmp_path / name, **options) for name, options in
            (("plain", {}), ("none", {"features": 0.0, "attention": 0.0}), ("some", {"features": 0.5}))]  # fmt: skip
    assert digest(made[0]) == digest(made[1]) != digest(made[2])


def test_a_run_that_is_killed_goes_on_to_the_bit_with_its_projections(
    shallow: Bundle, wide: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    options = {**HINTS, "teacher": str(wide.path), "seed": 3}
    whole = distilled(shallow, tmp_path / "whole", **options)
    settings = TrainingStage.settings
    monkeypatch.setattr(TrainingStage, "settings", lambda self: replace(settings(self), checkpoint_s=0.0))
    for step in (1, 5, 6, 11):
        with killed_after(step, raise_killed), pytest.raises(Killed):
            distilled(shallow, tmp_path / "killed", **options)
    (checkpoint,) = (tmp_path / "cache").rglob("checkpoint.safetensors")
    names = [name for name in load_file(checkpoint) if name.startswith("exp_avg.(hints)")]
    assert names == ["exp_avg.(hints).features.0.weight", "exp_avg.(hints).features.1.weight"]
    killed = distilled(shallow, tmp_path / "killed", **options)
    assert digest(killed) == digest(whole)
    assert training_of(killed) == training_of(whole)
    assert digest(distilled(shallow, tmp_path / "other", **{**options, "seed": 4})) != digest(whole)


def test_two_processes_and_parts_train_as_one_does(shallow: Bundle, wide: Bundle, tmp_path: Path):
    options = {**HINTS, "teacher": str(wide.path)}
    one = distilled(shallow, tmp_path / "one", **options)
    two = distilled(shallow, tmp_path / "two", **options, processes=2)
    parts = distilled(shallow, tmp_path / "parts", **options, accumulate=2, threads=1)
    curves = [np.array(training_of(made)["losses"]) for made in (one, two, parts)]
    assert float(np.abs(curves[1] / curves[0] - 1).max()) < 1e-3
    assert float(np.linalg.norm(weights(two) - weights(one)) / np.linalg.norm(weights(one))) < 1e-3
    assert curves[1].tolist() == curves[2].tolist(), "two halves, added in the same order"


def test_rows_that_are_held_out_are_judged_by_their_actions_alone(shallow: Bundle, tmp_path: Path):
    still = {"learning_rate": 1e-9, "patience": 3}
    plain = distilled(shallow, tmp_path / "plain", **still)
    hinted = distilled(shallow, tmp_path / "hinted", **still, **HINTS)
    scores = [training_of(made)["judged"]["scores"] for made in (plain, hinted)]
    assert scores[0] == pytest.approx(scores[1], rel=1e-4)
    assert training_of(hinted)["losses"][0] > training_of(plain)["losses"][0] + 1e-3


@pytest.mark.parametrize("batches", small_or_full([True], [True, False]))
def test_a_student_with_fewer_heads_and_neurons_is_compared_too(batches: bool, tmp_path: Path):
    folder = write_deep(tmp_path / "policy", *([MANY] if batches else []), layers=2)
    narrow = run_transform(
        Structured(ratio=0.3, samples=2, multiple=1), source_of(folder, tmp_path / "s"), tmp_path / "n", Context()
    ).bundle
    made = distilled(narrow, tmp_path / "out", **HINTS, steps=3)
    assert [each["blocks"] for each in training_of(made)["hints"].values()] == [
        [["main", "blocks", 0, 0], ["main", "blocks", 1, 1]]
    ] * 2
    assert all(np.isfinite(training_of(made)["losses"]))


def test_the_teacher_of_a_quantized_student_is_not_quantized(tmp_path: Path):
    """Student and teacher have the same weights: were both rounded, their features would be the same."""
    source = source_of(write_deep(tmp_path / "policy", MANY), tmp_path / "source")
    _, objective = build_stage("quantize.qat", {"features": 1.0}).prepare_objective(load_modules(source), source)
    with torch.no_grad():
        assert float(objective.loss(recorded_rows()) - objective.judged(recorded_rows())) > 1e-5


# ---- what cannot be compared

FLOW = """\
import torch
from torch import nn


class Block(nn.Module):
    def __init__(self):
        super().__init__()
        self.mix = nn.Linear(16, 16)

    def forward(self, x):
        return x + torch.tanh(self.mix(x))


class Prefix(nn.Module):
    def __init__(self):
        super().__init__()
        self.see = nn.Linear(3, 16)
        self.seeing = nn.ModuleList(Block() for _ in range(PREFIX))

    def forward(self, state):
        seen = self.see(state)
        for block in self.seeing:
            seen = block(seen)
        return seen


class Head(nn.Module):
    def __init__(self):
        super().__init__()
        self.into, self.out = nn.Linear(3, 16), nn.Linear(16, 2)
        self.acting = nn.ModuleList(Block() for _ in range(2))

    def forward(self, seen, x, t, dt):
        y = self.into(torch.cat([x, t[:, None, None].expand(-1, 4, 1)], -1)) + seen[:, None]
        for block in self.acting:
            y = block(y)
        return x + dt[:, None, None] * self.out(y)


def make():
    torch.manual_seed(0)
    return {"prefix": Prefix().eval(), "head": Head().eval()}
"""


def flow(place: Path, prefix: int = 2) -> Bundle:
    folder = write_flow(place / "flow")
    (folder / "policy.py").write_text(FLOW.replace("PREFIX", str(prefix)))
    return source_of(folder, place / "source")


def test_blocks_that_run_in_each_step_of_a_flow_are_compared_where_both_take_as_many(tmp_path: Path):
    source = flow(tmp_path)
    pruned = run_transform(Depth(keep=(0,), include=("acting",)), source, tmp_path / "pruned", Context()).bundle
    made = distilled(pruned, tmp_path / "out", **HINTS, steps=3)
    features, attention = training_of(made)["hints"].values()
    assert features["blocks"] == [["head", "acting", 0, 1], ["prefix", "seeing", 0, 0], ["prefix", "seeing", 1, 1]]
    assert attention["blocks"] == [["head", "acting", 0, 1]]
    assert attention["left_out"] == [
        ["prefix", "seeing", "they give [1, 16] for one observation, where tokens are [1, tokens, width]"]
    ]
    fewer = run_transform(Steps(to=1), source, tmp_path / "fewer", Context()).bundle
    made = distilled(fewer, tmp_path / "one", features=1.0, steps=3)
    features = training_of(made)["hints"]["features"]
    assert {stack for _, stack, *_ in features["blocks"]} == {"seeing"}
    assert features["left_out"][0][2] == "the student runs its blocks 1 time in an inference, the teacher 4"


def unlike(place: Path) -> Bundle:
    """A flow whose only stack runs four times in the teacher and once in the student."""
    return run_transform(Steps(to=1), flow(place, prefix=1), place / "fewer", Context()).bundle


def tiny(place: Path) -> Bundle:
    """A policy of one block."""
    source = source_of(write_deep(place / "p", layers=1), place / "s")
    return run_transform(Neurons(ratio=0.7), source, place / "n", Context()).bundle


def deep(place: Path, *swaps: tuple[str, str]) -> Bundle:
    return run_transform(
        Depth(keep=(0, 2)), source_of(write_deep(place / "p", *swaps), place / "s"), place / "d", Context()
    ).bundle


LOOP = "        return self.head(self.blocks(tokens).mean(1)).reshape(1, 4, 2)"
INSIDE = """\
        for block in self.blocks:
            tokens = tokens + block.mlp(tokens)
        return self.head(tokens.mean(1)).reshape(1, 4, 2)"""
POOLED = """\
        tokens = tokens.mean(1)[:, None]
        return self.head(self.blocks(tokens).mean(1)).reshape(1, 4, 2)"""
MAPS = (
    ("        self.mlp = nn.Sequential(nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 32), nn.GELU(), nn.Linear(32, WIDTH))",
     "        self.mlp = nn.Conv1d(WIDTH, WIDTH, 3, padding=1)"),
    ("        normed = self.norm(tokens)\n", "        return tokens + self.mlp(tokens)\n        normed = tokens\n"),
    ("self.blocks(tokens).mean(1)", "self.blocks(tokens.transpose(1, 2)).mean(2)"),
)  # fmt: skip
REFUSED: dict[str, tuple[Callable[[Path], Bundle], str, str]] = {
    "no blocks": (tiny, "features", "have no stack of blocks in common .* so --features would compare nothing"),
    "loops": (unlike, "features", "--features can compare no stack of blocks: acting: the student runs its blocks 1 "
              "time in an inference, the teacher 4"),
    "blocks that are not called": (lambda at: deep(at, (LOOP, INSIDE)), "attention",
                                   "blocks: its blocks are not called as modules"),
    "a single token": (lambda at: deep(at, (LOOP, POOLED)), "attention", r"they give a single token, \[1, 1, 16\]"),
    "maps": (lambda at: deep(at, *MAPS), "attention", r"they give \[1, 16, 9\] for one observation"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_compared_is_told(case: str, tmp_path: Path):
    make, option, says = REFUSED[case]
    source = make(tmp_path)
    with pytest.raises(RecipeError, match=says) as caught:
        distilled(source, tmp_path / "out", **{option: 1.0})
    assert caught.value.fix == f"leave --{option} out"
    assert not (tmp_path / "out").exists()


def test_maps_have_features_along_their_channels(tmp_path: Path):
    made = distilled(deep(tmp_path, *MAPS), tmp_path / "out", features=1.0, steps=2)
    assert training_of(made)["hints"]["features"]["blocks"] == [["main", "blocks", 0, 1], ["main", "blocks", 1, 3]]
