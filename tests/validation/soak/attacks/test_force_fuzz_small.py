"""A small part of the fuzz of --force, which runs with all tests."""

from __future__ import annotations

from pathlib import Path

from _full import small_or_full
from force_fuzz import Work, files_of, fuzz, run


def test_no_file_of_a_person_is_removed_or_changed(tmp_path: Path) -> None:
    told: list[str] = []
    assert fuzz(small_or_full(12, 25), 5000, tmp_path, told.append) == []
    assert any("exit 0" in line for line in told)
    assert any("exit 3" in line for line in told)


def test_the_commands_of_the_issue_delete_nothing(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    work = Work(tmp_path)
    project = tmp_path / "proj"
    (project / ".git").mkdir(parents=True)
    (project / ".git/config").write_text("[core]")
    (project / "manifest.json").write_text("{}")
    before = files_of(project), files_of(work.place / "policy")
    for words in (
        ["export", "onnx", "policy", "-o", "policy", "--force"],
        ["evaluate", "recorded", "bundle", "-o", "proj", "--force"],
        ["evaluate", "recorded", "bundle", "-o", "policy", "--force"],
        ["evaluate", "recorded", "bundle", "-o", ".", "--force"],
        ["evaluate", "recorded", "bundle", "-o", "bundle", "--force"],
        ["quantize", "dynamic-int8", "bundle", "-o", "bundle/sub", "--force"],
    ):
        code, said = run(words)
        assert code == 3, (words, said)
        assert "Traceback" not in said
    assert (files_of(project), files_of(work.place / "policy")) == before
    assert run(["evaluate", "recorded", "bundle", "-o", "report", "--force"])[0] == 0
