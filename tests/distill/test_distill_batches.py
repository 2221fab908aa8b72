"""Training on batches of the user's own: ``training: train.py:batches`` in policy.yaml, and what can be wrong there."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _trainings import Killed, digest, distilled, killed_after, raise_killed, training_of

from vlatool.bundle.bundle import Bundle
from vlatool.data import recorded_observations
from vlatool.errors import DataError, MissingExtra, RecipeError, SourceError, VlatoolError
from vlatool.module.torch_policy import torch_policy
from vlatool.prune.neurons import Neurons
from vlatool.rebuild.rebuild import rebuild
from vlatool.report import read_report
from vlatool.runtime.policy import relative_error
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.run import run_transform
from vlatool.training.user_batches import DEFAULT_ROWS
from vlatool.user_code import trust

pytestmark = pytest.mark.usefixtures("in_this_process")
TRAIN = """\
import numpy as np

WORDS = ["go to the ball", "red ball"]


def batches(seed, size):
    random = np.random.default_rng(seed)
    while True:
        batch = {
            "image": random.integers(0, 256, (size, 8, 8, 3), np.uint8),
            "proprio": random.standard_normal((size, 3)),
            "instruction": [WORDS[row % 2] for row in range(size)],
            "action": np.zeros((size, 4, 2), np.float32),
        }
        yield batch
"""
ALONE = {"from_batches": 20, "episodes": 0, "student_episodes": 0}


def policy(folder: Path, *swaps: tuple[str, str], recorded: bool = False, plays: bool = False) -> Path:
    """Let the tiny policy name its batches, in the place of recordings and an environment unless it keeps them."""
    code = TRAIN
    for old, new in swaps:
        assert old in code, old
        code = code.replace(old, new)
    (folder / "train.py").write_text(code)
    described = (folder / "policy.yaml").read_text()
    environment = "environment:\n  make: environment.py:make\n  tasks: [reach, push]\n"
    assert environment in described
    kept = described if plays else described.replace(environment, "")
    (folder / "policy.yaml").write_text(f"{kept}training: train.py:batches\n")
    for name in () if recorded else ("calibration.npz", "evaluation.npz"):
        (folder / name).unlink()
    return folder


def pruned(folder: Path) -> Bundle:
    source = run_transform(TorchModule(policy=folder), None, folder.parent / "source", Context()).bundle
    return run_transform(Neurons(ratio=0.7), source, folder.parent / "pruned", Context()).bundle


def test_rows_of_the_function_are_what_the_student_learns_from(policy_dir: Path, tmp_path: Path, source_bundle: Bundle):
    source = pruned(policy(policy_dir))
    told: list[str] = []
    made = distilled(source, tmp_path / "out", Context(lambda what, _share: told.append(what)),
                     from_batches=300, steps=60, batch=16, average=0.9)  # fmt: skip
    assert training_of(made)["rounds"] == [{"step": 0, "actor": "teacher", "yielded": 300, "observations": 300}]
    assert "256 of 300 rows of train.py:batches" in told
    assert error(made, source_bundle) < 0.6 * error(source, source_bundle)
    (row,) = read_report(made.path / "reports").rows
    assert row.details["training: distill.policy"][0]["who acted"] == "batches"


def error(bundle: Bundle, whole: Bundle) -> float:
    ours, theirs = torch_policy(bundle, 0), torch_policy(whole, 0)
    observations = recorded_observations(whole, 16)
    return float(np.mean([relative_error(ours.infer(each).chunk, theirs.infer(each).chunk) for each in observations]))


def test_they_are_raw_observations(policy_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What is trained on is what the encoder makes of a row: normalised, and words as ids."""
    source = pruned(policy(policy_dir))
    session = importlib.import_module("vlatool.training.session")
    seen: dict[str, Any] = {}

    def label(folder: Path, names: list[str], *rest: Any, **options: Any) -> list[str]:
        seen.update({name: np.load(folder / f"{name}.npy") for name in names})
        return written(folder, names, *rest, **options)

    written = session.write_labels
    monkeypatch.setattr(session, "write_labels", label)
    distilled(source, tmp_path / "out", **ALONE, seed=5, steps=1)
    random = np.random.default_rng(5)
    assert np.array_equal(seen["image"], random.integers(0, 256, (20, 8, 8, 3), np.uint8))
    raw = random.standard_normal((20, 3)).astype(np.float32)
    wanted = (raw - np.float32([0.1, -0.2, 0.5])) / np.float32([0.5, 0.25, 2.0])
    np.testing.assert_allclose(seen["proprio"], wanted, rtol=1e-5, atol=1e-6)
    assert seen["instruction"].tolist() == [[2, 3, 4, 7], [5, 7, 0, 0]] * 10


@pytest.mark.parametrize(("options", "rows"), [
    ({}, 24 + 30), ({"from_batches": 5}, 24 + 5), ({"from_batches": 0}, 24),
    ({"plays": True, "episodes": 2}, None), ({"plays": True, "episodes": 2, "from_batches": 6}, 6),
])  # fmt: skip
def test_how_many_rows_are_taken(
    policy_dir: Path, tmp_path: Path, options: dict[str, Any], rows: int | None, monkeypatch: pytest.MonkeyPatch
):
    """With recordings beside them; where the teacher plays, only those that are asked for."""
    assert DEFAULT_ROWS == 8192
    monkeypatch.setattr("vlatool.training.user_batches.DEFAULT_ROWS", 30)
    plays = options.pop("plays", False)
    source = pruned(policy(policy_dir, recorded=not plays, plays=plays))
    made = distilled(source, tmp_path / "out", **options, steps=1)
    (first,) = training_of(made)["rounds"]
    if not plays:
        assert (first["observations"], first.get("yielded")) == (rows, options.get("from_batches", 30) or None)
        return
    assert first["episodes"] == 2
    assert first.get("yielded") == rows
    assert first["observations"] > (rows or 0)


def test_a_run_that_is_killed_goes_on_and_two_processes_do_as_one(policy_dir: Path, tmp_path: Path):
    source = pruned(policy(policy_dir))
    whole = distilled(source, tmp_path / "whole", **ALONE, patience=9)
    for step in (2, 5, 8):
        with killed_after(step, raise_killed), pytest.raises(Killed):
            distilled(source, tmp_path / "killed", **ALONE, patience=9)
    killed = distilled(source, tmp_path / "killed", **ALONE, patience=9)
    assert digest(killed) == digest(whole)
    assert training_of(killed)["judged"]["by"] == "held-out loss", "on rows of another seed"
    two = distilled(source, tmp_path / "two", **ALONE, patience=9, processes=2)
    curves = [np.array(training_of(made)["losses"]) for made in (whole, two)]
    assert float(np.abs(curves[1] / curves[0] - 1).max()) < 1e-3
    assert digest(distilled(source, tmp_path / "seed", **ALONE, patience=9, seed=1)) != digest(whole)


def test_the_bundle_is_made_again_from_the_same_file_alone(policy_dir: Path, tmp_path: Path):
    source = pruned(policy(policy_dir))
    made = distilled(source, tmp_path / "out", **ALONE, steps=3, threads=1)
    assert rebuild(made, Context(), source=str(policy_dir), cache=tmp_path / "cache").identical
    with (policy_dir / "train.py").open("a") as stream:
        stream.write("# another one\n")
    with pytest.raises(SourceError, match=r"is not what .* was made from: train.py: got"):
        rebuild(made, Context(), source=str(policy_dir), cache=tmp_path / "cache")
    with pytest.raises(SourceError, match=r"train\.py has changed since the source bundle was made"):
        distilled(source, tmp_path / "again", **ALONE)


def test_the_file_runs_only_where_its_folder_is_named(policy_dir: Path, tmp_path: Path):
    source = pruned(policy(policy_dir))
    ran = policy_dir.parent / "ran"
    (policy_dir / "train.py").write_text(f"open({str(ran)!r}, 'w').close()\n")
    with trust.forget_named(), pytest.raises(SourceError, match="which you did not name"):
        distilled(source, tmp_path / "out", **ALONE)
    with pytest.raises(SourceError, match="has changed since"):
        distilled(source, tmp_path / "out", **ALONE)
    assert not ran.exists()


def test_rows_are_asked_for_where_nothing_yields_them(pruned_once: Bundle, tmp_path: Path):
    with pytest.raises(RecipeError, match="that of tiny names none"):
        distilled(pruned_once, tmp_path / "out", from_batches=5)
    assert build_stage("distill.policy", {}).from_batches is None


YIELD = "        yield batch\n"
FEW = ("    random =", "    size = 6\n    random =")
SECOND = "        batch['proprio'][2, 0] = np.inf\n" + YIELD
WRONG: dict[str, tuple[type[VlatoolError], str, list[tuple[str, str]]]] = {
    "no such function": (SourceError, "has no function 'batches'; did you mean 'batch'", [("batches(", "batch(")]),
    "no file that Python reads": (SourceError, "failed: SyntaxError", [("import numpy as np", "import numpy as")]),
    "a package that is absent": (MissingExtra, "needs the package 'no_such_package'",
                                 [("import numpy as np", "import numpy as np, no_such_package")]),
    "no size": (SourceError, "unexpected keyword argument 'size'", [("batches(seed, size)", "batches(seed)")]),
    "a number": (SourceError, "gives a value of type int; it must yield", [(TRAIN[TRAIN.index("    random"):],
                                                                            "    return 3\n")]),
    "nothing": (DataError, "yields nothing; wanted 20 rows", [(YIELD, "        return\n        yield\n")]),
    "too few": (DataError, "ends after 12 rows; wanted 20", [FEW, ("while True", "for _ in range(2)")]),
    "a tuple": (DataError, "Batch 1 of 'train.py:batches' is a tuple; it must be a mapping of names to arrays: the "
                "policy takes image, proprio, instruction", [("yield batch", "yield batch['image'], 3")]),
    "another name": (DataError, r"Batch 1 of .* has no 'proprio' \(it has: image, state, instruction, action\); the "
                     "policy takes image, pro", [('"proprio":', '"state":')]),
    "another shape": (DataError, r"Row 0 of batch 1 of 'train.py:batches': The input 'proprio' has the shape \[1, 4\]; "
                      r"the policy takes \[1, 3\]", [("(size, 3)", "(size, 4)")]),
    "another type": (DataError, "The input 'image' is float64; the policy takes uint8",
                     [(", np.uint8)", ").astype(float)")]),
    "no text": (DataError, "The input 'instruction' is text; got int64", [("WORDS[row % 2] for", "row % 2 for")]),
    "not a number": (DataError, "Row 5 of batch 1 of 'train.py:batches': The input 'proprio' holds 1 NaN of 3 values",
                     [(YIELD, "        batch['proprio'][5, 1] = np.nan\n" + YIELD)]),
    "infinity in a later batch": (DataError, "Row 2 of batch 2 of 'train.py:batches': .* holds infinity in 1 of 3",
                                  [FEW, (YIELD, YIELD + SECOND)]),
    "no rows": (DataError, "different numbers of rows: image 20, proprio 3, instruction 20", [("(size, 3)", "3")]),
    "a single value": (DataError, "'proprio' in batch 1 of 'train.py:batches' is a single value; wanted a row",
                       [("random.standard_normal((size, 3))", "0.5")]),
    "ragged": (DataError, "'proprio' in batch 1 .* is a list, which cannot be converted to a numpy array",
               [("random.standard_normal((size, 3))", "[[1.0], [1.0, 2.0]]")]),
    "an empty batch": (DataError, "has 0 rows; allowed: 1 to 20", [("    random =", "    size = 0\n    random =")]),
    "more rows than asked for": (DataError, "has 21 rows; allowed: 1 to 20, the 'size' that it was asked for",
                                 [("    random =", "    size += 1\n    random =")]),
    "it raises": (SourceError, "'train.py:batches' failed: OSError: no such disk",
                  [("        yield batch", "        raise OSError('no such disk')\n        yield")]),
    "it leaves": (SourceError, r"'train.py:batches' called sys.exit\(0\)",
                  [FEW, (YIELD, YIELD + "        raise SystemExit(0)\n")]),
    "it ends the process": (SourceError, r"train\.py ended its process with exit code 3",
                            [FEW, (YIELD, YIELD + "        import os\n        os._exit(3)\n")]),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_with_batches_is_told(case: str, policy_dir: Path, tmp_path: Path):
    kind, says, swaps = WRONG[case]
    source = pruned(policy(policy_dir, *swaps))
    with pytest.raises(kind, match=says):
        distilled(source, tmp_path / "out", **ALONE)
    assert not (tmp_path / "out").exists()
