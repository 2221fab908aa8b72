"""A student that is derived from the policy: what a person writes, and the same bundle as from the stages alone."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from _full import full
from _tiny import deepen, observations, with_expert
from _trainings import RECORDED, training_of
from safetensors.torch import load_file, save_file

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.distill._student import student_steps
from vlatool.distill.policy import PolicyDistillation
from vlatool.errors import FallsShort, RecipeError
from vlatool.module.edits import read_edits
from vlatool.module.torch_policy import load_modules
from vlatool.optimize.plan import transforms
from vlatool.prune.neurons import Neurons
from vlatool.rebuild.rebuild import rebuild
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.build import build_stage
from vlatool.stage.chain import run_chain
from vlatool.stage.run import run_transform
from vlatool.training.supervision import parameters

STUDENT = "depth=0.5,width=0.75"
SHORT = {**RECORDED, "steps": 3, "threads": 1}
STAGES = ["prune.depth", "prune.structured", "distill.policy"]

pytestmark = pytest.mark.usefixtures("in_this_process")


@pytest.fixture
def deep(policy_dir: Path) -> Path:
    """The folder of the tiny policy with three blocks, which its expert has, too."""
    return with_three_blocks(policy_dir)


def with_three_blocks(policy_dir: Path) -> Path:
    deepen(policy_dir)
    code = policy_dir / "policy.py"
    code.write_text(code.read_text().replace("def make(layers=1)", "def make(layers=3)"))
    for number, (name, count) in enumerate((("calibration", 24), ("evaluation", 16)), 1):
        np.savez(policy_dir / f"{name}.npz", **with_expert(observations(count, seed=number), policy_dir))
    return policy_dir


@dataclass(frozen=True)
class Short:
    """A student made in one command: of what, the bundle, and what was printed."""

    policy: Path
    made: Bundle
    printed: str


@pytest.fixture(scope="module")
def short(policy_template: Path, tmp_path_factory: pytest.TempPathFactory) -> Short:
    """Read only."""
    place = tmp_path_factory.mktemp("short")
    deep = with_three_blocks(Path(shutil.copytree(policy_template, place / "tiny")))
    with pytest.MonkeyPatch.context() as patched, contextlib.redirect_stdout(io.StringIO()) as printed:
        patched.setenv("VLATOOL_CACHE", str(place / "cache"))
        patched.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))
        ran("distill", "policy", deep, "--student", STUDENT, "-o", place / "out", *flags())
    return Short(deep, Bundle.open(place / "out"), printed.getvalue())


def ran(*words: object) -> None:
    with pytest.raises(SystemExit) as left:
        main([str(word) for word in words])
    assert not left.value.code


def flags(**options: object) -> list[str]:
    return [
        word for name, value in {**SHORT, **options}.items() for word in (f"--{name.replace('_', '-')}", str(value))
    ]


@pytest.mark.parametrize(("text", "ratios"), [
    ("", {}), ("depth=0.5", {"depth": 0.5}), ("width=.75", {"structured": 0.25}), ("depth=1,width=0.9",
    {"structured": 0.1}), (" width = 0.75 , depth=0.5", {"depth": 0.5, "structured": 0.25}),
    ("depth=0.9", {"depth": 0.1}), ("depth=1e-3", {"depth": 0.999}),
])  # fmt: skip
def test_what_stays_becomes_what_goes_blocks_first(text: str, ratios: dict[str, float]):
    assert student_steps(text) == tuple((f"prune.{name}", {"ratio": ratio}) for name, ratio in ratios.items())


@pytest.mark.parametrize(("text", "says"), [
    ("half", "such as depth=0.5,width=0.75"), ("depth", "got 'depth'"), ("=0.5", "got '=0.5'"),
    ("depth=", "got 'depth='"), (",", "got ','"), ("depth=0.5,", "got 'depth=0.5,'"),
    ("dept=0.5", "knows no 'dept'; did you mean 'depth'"), ("depth=0.5,depth=0.4", "names depth twice"),
    ("depth=0", "depth=0: what stays is a share above 0, at most 1"), ("width=1.5", "width=1.5: what stays"),
    ("width=-1", "width=-1: what stays"), ("width=nan", "width=nan: what stays"),
    ("width=inf", "width=inf: what stays"), ("width=half", "width=half: what stays"),
    ("width=1e-9", "above 0, at most 1"), ("width=0.5=0.6", "width=0.5=0.6: what stays"),
    ("depth=1,width=1", "takes nothing away"), ("depth=1", "takes nothing away"),
])  # fmt: skip
def test_what_is_no_student_is_refused(text: str, says: str):
    with pytest.raises(RecipeError) as caught:
        PolicyDistillation(student=text).check(None, None)
    assert says in str(caught.value)


def test_it_is_what_the_stages_make_one_by_one_and_is_made_again(short: Short, tmp_path: Path):
    """Three blocks: half of them is one and a half, so two stay, and one goes."""
    deep = short.policy
    ran("prune", "depth", deep, "--ratio", 0.5, "-o", tmp_path / "d")
    ran("prune", "structured", tmp_path / "d", "--ratio", 0.25, "-o", tmp_path / "w", "--trust", deep)
    ran("distill", "policy", tmp_path / "w", "-o", tmp_path / "long", "--trust", deep, *flags())
    assert short.made.hash == Bundle.open(tmp_path / "long").hash
    assert [entry["stage"] for entry in short.made.manifest.build][1:] == STAGES
    blocks, *units = read_edits(short.made)
    assert (blocks.axis, len(blocks.keep)) == ("blocks", 2)
    assert units
    assert rebuild(short.made, Context(), source=str(deep), cache=tmp_path / "none").identical


def test_its_size_is_told_beside_that_of_the_teacher(short: Short, tmp_path: Path):
    made = short.made
    whole = run_transform(TorchModule(policy=short.policy), None, tmp_path / "whole", Context()).bundle
    counted = {"student": parameters(load_modules(made)), "teacher": parameters(load_modules(whole))}
    assert training_of(made)["parameters"] == counted
    share = 100 * counted["student"] / counted["teacher"]
    assert f"  {counted['student']:,} of {counted['teacher']:,} parameters ({share:.0f} %)" in short.printed
    assert share < 75


def test_a_policy_that_was_edited_has_students_too(deep: Path, tmp_path: Path):
    source = run_transform(TorchModule(policy=deep), None, tmp_path / "source", Context()).bundle
    pruned = run_transform(Neurons(ratio=0.5), source, tmp_path / "pruned", Context()).bundle
    ran("distill", "policy", pruned.path, "--student", "depth=0.5", "--trust", deep, "-o", tmp_path / "out", *flags())
    made = Bundle.open(tmp_path / "out")
    assert [entry["stage"] for entry in made.manifest.build][1:] == ["prune.neurons", "prune.depth", "distill.policy"]
    assert training_of(made)["parameters"]["teacher"] == parameters(load_modules(source))


@pytest.mark.soak("the stages one by one: test_it_is_what_the_stages_make_one_by_one_and_is_made_again")
def test_a_candidate_of_a_recipe_is_the_same(deep: Path, tmp_path: Path):
    entries = ({"distill.policy": {**SHORT, "student": STUDENT, "control": "noise"}},)
    assert [stage.name() for stage in transforms(entries)] == STAGES
    recipe = {"schema": 1, "candidates": {"smaller": entries}, "search": False}
    (tmp_path / "recipe.yaml").write_text(json.dumps(recipe))
    limits = ["--max-drop", "relative_error=100", "--episodes", 0, "--iterations", 20]
    ran("optimize", deep, "--recipe", tmp_path / "recipe.yaml", "-o", tmp_path / "out", *limits)
    made = Bundle.open(tmp_path / "out")
    report = json.loads((tmp_path / "out/reports/report.json").read_text())
    (row,) = (row for row in report["rows"] if row["name"] == "smaller")
    (record,) = row["details"]["training: distill.policy, and its teacher"]
    assert record["gradient from the teacher"] == "100 % (alpha 1, the loss has no other term)"
    assert "100 % (alpha 1" in (tmp_path / "out/reports/report.html").read_text()
    assert any(line.startswith("smaller: a control, not for a robot") for line in report["warnings"])
    if made.manifest.made_by["candidate"] == "smaller":
        assert [entry["stage"] for entry in made.manifest.build][1:4] == STAGES
    assert f"student: {STUDENT}" in (tmp_path / "out/recipe.yaml").read_text()


def test_as_one_stage_it_is_refused_with_the_way_to_run_it(deep: Path, tmp_path: Path):
    source = run_transform(TorchModule(policy=deep), None, tmp_path / "source", Context()).bundle
    stage = build_stage("distill.policy", {**SHORT, "student": STUDENT})
    with pytest.raises(RecipeError, match=r"is several stages: prune\.depth, prune\.structured, distill\.policy"):
        run_transform(stage, source, tmp_path / "out", Context())
    assert not (tmp_path / "out").exists()
    result, pruned = run_chain(stage, source, None, tmp_path / "out", tmp_path / "cache", Context())
    made_by = [each.manifest.made_by["stage"] for each in (pruned, result.bundle)]
    assert made_by == ["prune.structured", "distill.policy"]


def test_wrong_options_are_refused_before_anything_is_pruned(deep: Path, tmp_path: Path):
    source = run_transform(TorchModule(policy=deep), None, tmp_path / "source", Context()).bundle
    stage = build_stage("distill.policy", {**SHORT, "student": STUDENT, "loss": "hubert"})
    with pytest.raises(RecipeError, match="Unknown loss 'hubert'"):
        run_chain(stage, source, None, tmp_path / "out", tmp_path / "cache", Context())
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize(("student", "says"), [
    ("depth=0.5", "has no stack of blocks"), ("width=0.01", "no more than .* of the multiply-accumulates can go"),
])  # fmt: skip
def test_what_cannot_be_pruned_so_is_told_with_the_stage(
    source_bundle: Bundle, tmp_path: Path, student: str, says: str
):
    stage = build_stage("distill.policy", {**SHORT, "student": student})
    with pytest.raises((RecipeError, FallsShort), match=says) as caught:
        run_chain(stage, source_bundle, None, tmp_path / "out", tmp_path / "cache", Context())
    assert "distill.policy starts with prune." in caught.value.fix
    assert "run it first: vlatool prune " in caught.value.fix


def test_protected_blocks_may_go_where_they_are_named(deep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The trunk of many policies is called transformer.encoder and transformer.decoder."""
    code = deep / "policy.py"
    code.write_text(
        code.read_text()
        .replace("self.blocks", "self.decoder")
        .replace(
            'str(Path(__file__).with_name("weights.safetensors"))', 'str(Path(__file__).with_name("w.safetensors"))'
        )
    )
    weights = load_file(str(deep / "weights.safetensors"))
    save_file({name.replace("blocks.", "decoder."): value for name, value in weights.items()}, deep / "w.safetensors")
    with pytest.raises(SystemExit) as left:
        main(["distill", "policy", str(deep), "--student", STUDENT, "-o", str(tmp_path / "no"), *map(str, flags())])
    assert left.value.code == RecipeError.exit_code
    told = capsys.readouterr().err
    assert "name the stacks that may lose blocks: --include NAME" in told
    assert "prune.depth (ratio 0.5)" in told
    ran("distill", "policy", deep, "--student", STUDENT, "--include", "decoder", "-o", tmp_path / "short", *flags())
    assert "kept 2 of 3 blocks of decoder" in capsys.readouterr().out
    _, *entries = Bundle.open(tmp_path / "short").manifest.build
    included = {entry["stage"]: entry["options"].get("include") for entry in entries}
    assert included == {**dict.fromkeys(STAGES), "prune.depth": ["decoder"]}, "as the stages one by one would have it"
    if not full():
        return
    ran("prune", "depth", deep, "--include", "decoder", "-o", tmp_path / "d")
    ran("prune", "structured", tmp_path / "d", "--ratio", 0.25, "-o", tmp_path / "w", "--trust", deep)
    ran("distill", "policy", tmp_path / "w", "-o", tmp_path / "long", "--trust", deep, *flags())
    assert Bundle.open(tmp_path / "short").hash == Bundle.open(tmp_path / "long").hash


@pytest.mark.parametrize("student", ["", "width=0.5"])
def test_stacks_are_named_for_a_student_that_loses_blocks(student: str):
    with pytest.raises(RecipeError, match=r"--include names stacks .*, and the student loses none") as caught:
        PolicyDistillation(student=student, include=("blocks",)).check(None, None)
    assert "--student depth=0.5" in caught.value.fix
