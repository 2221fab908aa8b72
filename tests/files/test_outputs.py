import os
from pathlib import Path

import pytest

from vlatool.errors import OutputError
from vlatool.files.directory_writer import write_directory
from vlatool.files.outputs import BUNDLE, REPORT, kind_of, refuse_inputs, refuse_replacing


@pytest.fixture
def work(tmp_path: Path, monkeypatch) -> Path:
    """A current directory that vlatool wrote, so that nothing else protects it."""
    place = tmp_path / "home/work"
    for folder in (place, place / "sub"):
        with write_directory(folder) as draft:
            (draft / "report.json").touch()
    monkeypatch.chdir(place / "sub")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return place


@pytest.mark.parametrize("out", [".", "..", "../..", "/", "../sub", "../../../home"])
@pytest.mark.parametrize("force", [True, False])
def test_what_holds_the_current_or_the_home_directory_is_never_replaced(work: Path, out: str, force: bool):
    with pytest.raises(OutputError, match=r"is the (current|home) directory, or holds it"):
        refuse_replacing(Path(out), force=force)


def test_what_holds_the_cache_is_never_replaced(work: Path, tmp_path: Path):
    with write_directory(tmp_path / "out") as draft:
        (draft / "report.json").touch()
    with pytest.raises(OutputError, match="is the cache, or holds it"):
        refuse_replacing(tmp_path / "out", force=True, protected={"the cache": tmp_path / "out/cache"})


@pytest.mark.parametrize("target", ["out", "nowhere"])
def test_nothing_is_replaced_through_a_link(tmp_path: Path, target: str):
    with write_directory(tmp_path / "out") as draft:
        (draft / "report.json").touch()
    (tmp_path / "link").symlink_to(target)
    with pytest.raises(OutputError, match="is a link"):
        refuse_replacing(tmp_path / "link", force=True)


def test_a_file_system_of_its_own_is_never_replaced(tmp_path: Path, monkeypatch):
    (tmp_path / "out").mkdir()
    monkeypatch.setattr(os.path, "ismount", lambda _path: True)
    with pytest.raises(OutputError, match="file system of its own"):
        refuse_replacing(tmp_path / "out", force=True)


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("bundle", "is an input"), (".", "holds bundle"), ("bundle/sub", "lies in bundle"), ("link", "is an input"),
        ("link/deep/sub", "lies in bundle"), ("bundle/graphs", "lies in bundle"),
    ],
)  # fmt: skip
def test_an_input_is_never_the_output(tmp_path: Path, monkeypatch, out: str, message: str):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bundle/graphs").mkdir(parents=True)
    (tmp_path / "bundle/manifest.json").touch()
    (tmp_path / "link").symlink_to("bundle")
    with pytest.raises(OutputError, match=message):
        refuse_inputs(Path(out), [None, "bundle"])


def test_a_policy_may_have_its_output_beside_it_and_the_recipe_of_an_output_may_be_used_again(tmp_path: Path):
    (tmp_path / "policy/out").mkdir(parents=True)
    for name in ("policy.py", "out/recipe.yaml", "out/other.yaml"):
        (tmp_path / "policy" / name).touch()
    out = tmp_path / "policy/out"
    refuse_inputs(out, [tmp_path / "policy", out / "recipe.yaml"])
    with pytest.raises(OutputError, match="an input of this command"):
        refuse_inputs(out, [tmp_path / "policy", out / "other.yaml"])


@pytest.mark.parametrize("given", ["policy/policy.py", "policy/policy.py:make", "./policy/../policy/policy.py:make"])
def test_a_directory_that_holds_an_input_file_is_never_the_output(tmp_path: Path, monkeypatch, given: str):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy/policy.py").touch()
    with pytest.raises(OutputError, match="an input of this command"):
        refuse_inputs(Path("policy"), [given])
    refuse_inputs(Path("policy/out"), [given])


def test_a_name_that_is_no_file_is_no_input(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refuse_inputs(Path("raspberry-pi-5"), ["raspberry-pi-5", "", None])


CONTENT = {BUNDLE: ("manifest.json", "manifest.sha256"), REPORT: ("report.json", "report.html"), "": ("policy.py",)}


def written(place: Path, kind: str) -> Path:
    with write_directory(place, force=True) as draft:
        for name in CONTENT[kind]:
            (draft / name).write_text(kind)
    return place


@pytest.mark.parametrize(
    ("there", "new", "says"),
    [
        (BUNDLE, REPORT, "it is a bundle, not a report"), (REPORT, BUNDLE, "it is a report, not a bundle"),
        (BUNDLE, "", "it is a bundle and nothing of that is to be"), (REPORT, "", "it is a report and nothing of that"),
    ],
)  # fmt: skip
def test_one_kind_does_not_replace_another(tmp_path: Path, there: str, new: str, says: str):
    place = written(tmp_path / "out", there)
    with pytest.raises(OutputError, match=says) as caught:
        refuse_replacing(place, force=True, kind=new)
    assert "give another -o" in caught.value.fix
    with pytest.raises(OutputError, match=says):
        written(place, new)
    assert kind_of(place) == there
    assert [each.name for each in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("kind", CONTENT)
def test_each_kind_replaces_itself(tmp_path: Path, kind: str):
    place = written(tmp_path / "out", kind)
    refuse_replacing(place, force=True, kind=kind)
    assert kind_of(written(place, kind)) == kind


def test_a_bundle_with_reports_in_it_is_a_bundle(tmp_path: Path):
    place = written(tmp_path / "out", BUNDLE)
    for name in ("report.json", "reports/report.json"):
        (place / name).parent.mkdir(exist_ok=True)
        (place / name).touch()
    assert kind_of(place) == BUNDLE
