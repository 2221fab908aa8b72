"""Teachers that are policies, not bundles: what is read of them, and when their code may run."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from _deep import write_deep

from vlatool.cli import main
from vlatool.distill.policy import PolicyDistillation
from vlatool.errors import BundleError, SourceError
from vlatool.module.source import trust_policies
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform
from vlatool.training.teacher import check_teacher, teacher_bundle
from vlatool.user_code import trust


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    with trust.forget_named():
        yield write_deep(tmp_path / "wide", layers=3, width=24)


@pytest.mark.parametrize("name", ["", "policy.yaml"])
def test_a_policy_teaches_as_its_bundle_does(folder: Path, name: str, tmp_path: Path):
    stage = PolicyDistillation(teacher=folder / name)
    trust_policies(stage)
    check_teacher(folder / name)
    made = run_transform(TorchModule(policy=folder), None, tmp_path / "bundle", Context()).bundle
    assert teacher_bundle(folder / name).hash == made.hash == teacher_bundle(made.path).hash
    assert folder / "policy.py" in [path.resolve() for path in stage.inputs()]
    assert PolicyDistillation(teacher=made.path).inputs() == (made.path / "manifest.json",)


def test_its_code_runs_where_the_user_named_it(folder: Path):
    stage = PolicyDistillation(teacher=folder)
    for read in (check_teacher, teacher_bundle, lambda _path: stage.check(None, None)):
        with pytest.raises(SourceError, match=r"the code of the teacher in .*wide, which you did not name") as caught:
            read(folder)
        assert f"--trust {folder.resolve()}" in caught.value.fix
    assert not trust.is_named(folder)
    trust_policies(stage)
    stage.check(None, None)


def test_what_it_is_made_of_is_part_of_the_key(folder: Path):
    stage = PolicyDistillation(teacher=folder)
    before = stage.key("source")
    assert stage.key("source") == before != stage.key("other")
    code = folder / "policy.py"
    code.write_text(code.read_text() + "\n# changed\n")
    assert stage.key("source") != before


@pytest.mark.parametrize(("made", "says"), [(None, "No bundle at"), ("notes.txt", "is not a bundle")])
def test_neither_is_refused_before_anything_is_made(made: str | None, says: str, tmp_path: Path):
    place = tmp_path / "place"
    if made:
        place.mkdir()
        (place / made).write_text("")
    with pytest.raises(BundleError, match=f"The teacher cannot be opened: .*{says}") as caught:
        PolicyDistillation(teacher=place).check(None, None)
    assert "a folder with a policy.yaml" in caught.value.fix


def test_a_policy_of_the_users_learns_from_another_one(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Both typed as folders, with nothing else named or trusted."""
    monkeypatch.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))
    student, out = write_deep(tmp_path / "narrow"), tmp_path / "out"
    short = ("--steps", "30", "--batch", "8", "--average", "0", "--learning-rate", "0.01", "--threads", "1",
             "--episodes", "0", "--student-episodes", "0")  # fmt: skip
    with pytest.raises(SystemExit) as caught:
        main(["distill", "policy", str(student), "--teacher", str(folder), "-o", str(out), *short])
    assert caught.value.code == 0, capsys.readouterr().err
    losses = json.loads((out / "module/training.json").read_text())["losses"]
    assert losses[-1] < 0.8 * losses[0]
    about = json.loads((out / "module/training.json").read_text())["parameters"]
    assert about["teacher"] > about["student"]
