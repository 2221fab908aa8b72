"""Students of a flow that learn single turns of its loop: the teacher's velocity, and not what it adds up to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from _deep import write_deep
from _flow import write_flow
from _trainings import Killed, distilled, killed_after, raise_killed, training_of

from vlatool.bundle.bundle import Bundle
from vlatool.errors import RecipeError
from vlatool.module.batched_program import PATH, BatchedProgram
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.prune.neurons import Neurons
from vlatool.prune.steps import Steps
from vlatool.runtime.policy import relative_error
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform
from vlatool.training.flow import flow_loss
from vlatool.training.losses.l1 import L1
from vlatool.training.rounds import AFTER, BEFORE, LABEL, NOISE, NUMBER, write_labels

pytestmark = pytest.mark.usefixtures("in_this_process")
SAMPLE = Path(__file__).parents[2] / "sample_models/vln-babyai"
LONG = {"steps": 150, "batch": 32, "learning_rate": 0.01, "average": 0.9}


def source_of(folder: Path, out: Path) -> Bundle:
    return run_transform(TorchModule(policy=folder), None, out, Context()).bundle


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """A flow in four turns; read only."""
    place = tmp_path_factory.mktemp("flow")
    return source_of(write_flow(place / "policy"), place / "source")


@pytest.fixture(scope="module")
def narrow(whole: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """Half of the neurons of its head; read only."""
    return run_transform(Neurons(ratio=0.5), whole, tmp_path_factory.mktemp("narrow") / "out", Context()).bundle


def programs(bundle: Bundle) -> BatchedProgram:
    return BatchedProgram(bundle.manifest.program, load_modules(bundle))


def weights(made: Bundle) -> dict[str, str]:
    """Hashes of all weights."""
    return {name: file.sha256 for name, file in made.manifest.files.items() if name.endswith(".safetensors")}


def states(count: int) -> dict[str, torch.Tensor]:
    return {"state": torch.randn((count, 3), generator=torch.Generator().manual_seed(1))}


def noise(count: int) -> dict[str, torch.Tensor]:
    return {"x": torch.randn((count, 4, 2), generator=torch.Generator().manual_seed(2))}


def error(bundle: Bundle, teacher: Bundle) -> float:
    """The mean relative error of the whole loop's actions for new states, from the same noise."""
    ours, theirs = torch_policy(bundle, 0), torch_policy(teacher, 0)
    found = []
    for state in np.random.default_rng(1).standard_normal((32, 3)).astype(np.float32):
        for policy in (ours, theirs):
            policy.reset(3)
        found.append(relative_error(ours.infer({"state": state}).chunk, theirs.infer({"state": state}).chunk))
    return float(np.mean(found))


@pytest.mark.parametrize("alone", [False, True], ids=["batches", "row by row"])
def test_turns_one_after_the_other_are_the_loop(whole: Bundle, alone: bool):
    program = programs(whole)
    if alone:
        program._batches = False
    with torch.no_grad():
        found = program.path(states(5), noise(5))
        path = found[PATH + "x"]
        assert path.shape == (5, 5, 4, 2)
        assert torch.equal(path[:, 0], noise(5)["x"])
        assert torch.equal(path[:, -1], found["action"])
        assert torch.equal(found["action"], program.run(states(5), noise(5))["action"])
        turns = torch.tensor([3, 0, 2, 1, 3])
        after = program.turn(states(5), {"x": path[torch.arange(5), turns]}, turns)["x"]
    torch.testing.assert_close(after, path[torch.arange(5), turns + 1])


def test_each_row_is_labelled_with_a_turn_of_the_teachers(whole: Bundle, tmp_path: Path):
    count, teacher = 70, programs(whole)
    np.save(tmp_path / "state.npy", states(count)["state"].numpy())
    names = write_labels(tmp_path, ["state"], ["action"], teacher, (0, 0), Context(), turns=True)
    assert names == ["action", NUMBER, f"{BEFORE}x", f"{AFTER}x"]
    kept = {name: torch.from_numpy(np.load(tmp_path / f"{LABEL}{name}.npy")) for name in names}
    drawn = torch.from_numpy(np.load(tmp_path / f"{NOISE}x.npy"))
    with torch.no_grad():
        path = teacher.path(states(count), {"x": drawn})[PATH + "x"]
    rows = torch.arange(count)
    torch.testing.assert_close(kept[f"{BEFORE}x"], path[rows, kept[NUMBER]])
    torch.testing.assert_close(kept[f"{AFTER}x"], path[rows, kept[NUMBER] + 1])
    assert np.bincount(kept[NUMBER].numpy(), minlength=4).min() >= 8, "every turn is shown"


def test_the_loss_is_what_the_end_is_off_where_every_turn_errs_alike(whole: Bundle, tmp_path: Path):
    """A student that moves by 0.01 too far in each of four turns ends 0.04 too far."""
    np.save(tmp_path / "state.npy", states(8)["state"].numpy())
    write_labels(tmp_path, ["state"], ["action"], programs(whole), (0, 0), Context(), turns=True)
    rows = {path.name.removesuffix(".npy"): np.load(path) for path in tmp_path.glob("*.npy")}
    student = programs(whole)
    assert float(flow_loss(student, L1(), torch.no_grad)(rows)) == pytest.approx(0.0, abs=1e-6)
    student.modules["head"].register_forward_hook(lambda _module, _given, gives: gives + 0.01)
    assert float(flow_loss(student, L1(), torch.no_grad)(rows)) == pytest.approx(0.04, rel=1e-4)


def test_a_student_learns_the_whole_loop_from_its_turns(narrow: Bundle, whole: Bundle, tmp_path: Path):
    learnt = distilled(narrow, tmp_path / "learnt", targets="flow", **LONG)
    assert training_of(learnt)["loss"] == "flow l1"
    losses = training_of(learnt)["losses"]
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:10])
    assert error(learnt, whole) < 0.5 * error(narrow, whole)


def test_a_teacher_whose_turns_are_exchanged_teaches_nothing(narrow: Bundle, whole: Bundle, tmp_path: Path):
    learnt = distilled(narrow, tmp_path / "learnt", targets="flow", **LONG)
    control = distilled(narrow, tmp_path / "control", targets="flow", control="noise", **LONG)
    assert error(control, whole) > 2 * error(learnt, whole)


def test_a_training_that_was_killed_ends_with_the_same_weights(narrow: Bundle, tmp_path: Path):
    options = {"targets": "flow", "steps": 8, "batch": 16}
    undisturbed = distilled(narrow, tmp_path / "one", **options)
    with pytest.raises(Killed), killed_after(5, raise_killed):
        distilled(narrow, tmp_path / "two", Context(), seed=0, **options)
    assert weights(distilled(narrow, tmp_path / "two", **options)) == weights(undisturbed)


def test_what_is_held_out_is_judged_at_the_end_of_the_loop(narrow: Bundle, tmp_path: Path):
    made = distilled(narrow, tmp_path / "made", targets="flow", patience=2, steps=12)
    assert training_of(made)["judged"]["by"] == "held-out loss"


def test_fewer_turns_than_the_teachers_cannot_be_compared(whole: Bundle, tmp_path: Path):
    two = run_transform(Steps(to=2), whole, tmp_path / "two", Context()).bundle
    with pytest.raises(RecipeError, match="its loop has 2 turns, the teacher's 4"):
        distilled(two, tmp_path / "out", targets="flow")


def test_a_policy_without_a_loop_has_no_turns(tmp_path: Path):
    source = source_of(write_deep(tmp_path / "policy"), tmp_path / "source")
    pruned = run_transform(Neurons(ratio=0.5), source, tmp_path / "pruned", Context()).bundle
    with pytest.raises(RecipeError, match="repeats no graph: --targets flow compares turns"):
        distilled(pruned, tmp_path / "out", targets="flow")


@pytest.mark.parametrize(
    ("options", "says"),
    [({"features": 1.0}, "--features compares what blocks give"), ({"attention": 0.5}, "--attention compares")],
)
def test_what_needs_whole_inferences_is_refused(narrow: Bundle, options: dict[str, float], says: str):
    with pytest.raises(RecipeError, match=says):
        build_stage("distill.policy", {"targets": "flow", **options}).check(narrow, None)


def test_discrete_actions_have_no_turns(tmp_path: Path):
    source = source_of(SAMPLE, tmp_path / "source")
    with pytest.raises(RecipeError, match="compares continuous actions"):
        build_stage("quantize.qat", {"targets": "flow"}).check(source, None)
