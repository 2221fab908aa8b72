import shutil
from pathlib import Path

import pytest

from vlatool.bundle.bundle import LOCATION, Bundle, hash_file
from vlatool.errors import SourceError, SpecError
from vlatool.module.origin import origin_of
from vlatool.sources.torch_module import TorchModule
from vlatool.stage.base import Context


def build(folder: Path, out: Path, **options: str) -> Bundle:
    out.mkdir()
    return TorchModule(policy=folder, **options).run(None, out, Context()).bundle


def edit(folder: Path, old: str, new: str) -> None:
    path = folder / "policy.yaml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_the_bundle_holds_spec_assets_and_data_and_no_weights(policy_dir: Path, tmp_path: Path):
    bundle = build(policy_dir, tmp_path / "out")
    assert Bundle.open(bundle.path) == bundle
    assert set(bundle.manifest.files) == {
        "assets/statistics.json",
        "assets/vocabulary.json",
        "data/calibration.npz",
        "data/evaluation.npz",
    }
    assert bundle.manifest.graphs == {}
    assert bundle.manifest.source["factory"] == "policy.py:make"
    assert bundle.manifest.source["arguments"] == {"layers": 1}
    assert bundle.manifest.source["code"]["policy.py"] == hash_file(policy_dir / "policy.py")
    assert "weights.safetensors" in bundle.manifest.source["code"]


def test_the_place_of_the_policy_is_no_part_of_the_bundle(policy_dir: Path, tmp_path: Path):
    one = build(policy_dir, tmp_path / "one")
    moved = Path(shutil.copytree(policy_dir, tmp_path / "moved"))
    two = build(moved, tmp_path / "two")
    assert one.hash == two.hash
    assert (one.path / LOCATION).read_text() != (two.path / LOCATION).read_text()
    assert str(tmp_path) not in (one.path / "manifest.json").read_text()


def test_other_weights_make_another_bundle(policy_dir: Path, tmp_path: Path):
    one = build(policy_dir, tmp_path / "one")
    with (policy_dir / "weights.safetensors").open("r+b") as stream:
        stream.seek(-1, 2)
        stream.write(b"\x01")
    assert build(policy_dir, tmp_path / "two").hash != one.hash


def test_another_factory_may_be_given(policy_dir: Path, tmp_path: Path):
    (policy_dir / "other.py").write_text("def build(): ...\n")
    bundle = build(policy_dir, tmp_path / "out", factory="other.py:build")
    assert bundle.manifest.source["factory"] == "other.py:build"


def test_a_factory_of_a_package_has_no_code_beside_the_policy(policy_dir: Path, tmp_path: Path):
    bundle = build(policy_dir, tmp_path / "out", factory="torch.nn:Identity")
    assert bundle.manifest.source["code"] == {}


def with_batches(policy_dir: Path, named: str = "train.py:batches") -> Path:
    """Let the policy name a function that yields batches, in a file that imports a neighbour."""
    with (policy_dir / "policy.yaml").open("a") as stream:
        stream.write(f"training: {named}\n")
    file = policy_dir / named.partition(":")[0]
    file.parent.mkdir(exist_ok=True)
    file.write_text("import worlds\n\n\ndef batches(seed, size): ...\n")
    (file.parent / "worlds.py").write_text("SIZE = 3\n")
    return policy_dir


@pytest.mark.parametrize("factory", ["", "torch.nn:Identity"], ids=["beside", "of a package"])
def test_the_function_that_yields_batches_is_a_part_of_the_policy(policy_dir: Path, tmp_path: Path, factory: str):
    before = build(policy_dir, tmp_path / "before", factory=factory)
    policy = with_batches(policy_dir)
    first = build(policy, tmp_path / "first", factory=factory)
    assert {*first.manifest.source["code"]} - {*before.manifest.source["code"]} == {"train.py", "worlds.py"}
    stage = TorchModule(policy=policy, factory=factory)
    key = stage.key("")
    (policy / "worlds.py").write_text("SIZE = 4\n")
    assert stage.key("") != key
    assert build(policy, tmp_path / "second", factory=factory).hash != first.hash
    with pytest.raises(SourceError, match=r"worlds\.py has changed since the source bundle was made"):
        origin_of(first).check()


def test_batches_from_elsewhere_are_refused(policy_dir: Path):
    with pytest.raises(SourceError, match=r"says training: data/train.py:batches, which lies in .*tiny/data; the"):
        TorchModule(policy=with_batches(policy_dir, "data/train.py:batches")).inputs()


def test_a_policy_without_recorded_data(policy_dir: Path, tmp_path: Path):
    (policy_dir / "calibration.npz").unlink()
    (policy_dir / "evaluation.npz").unlink()
    assert not any(name.startswith("data/") for name in build(policy_dir, tmp_path / "out").manifest.files)


def test_no_factory(policy_dir: Path):
    edit(policy_dir, "source: policy.py:make\n", "")
    with pytest.raises(SourceError, match="names no factory") as caught:
        TorchModule(policy=policy_dir).check(None, None)
    assert "--factory" in caught.value.fix


def test_a_factory_file_that_does_not_exist(policy_dir: Path):
    edit(policy_dir, "policy.py:make", "polisy.py:make")
    with pytest.raises(SourceError, match=r"No such file: .*polisy.py"):
        TorchModule(policy=policy_dir).check(None, None)


@pytest.mark.parametrize("name", ["statistics.json", "vocabulary.json"])
def test_a_missing_asset(policy_dir: Path, tmp_path: Path, name):
    (policy_dir / name).unlink()
    with pytest.raises(SourceError, match=f"names {name}, which is not in"):
        build(policy_dir, tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("statistics.json", '"std"', '"sd"', "The statistics 'proprio' in {file} lack 'std'"),
        ("statistics.json", '"action"', '"acts"', "{file} has no statistics 'action'"),
        ("vocabulary.json", '"pad"', '"filler"', "The vocabulary {file} needs"),
    ],
)
def test_an_asset_that_does_not_fit_is_told_by_the_name_that_the_user_gave_it(
    policy_dir: Path, tmp_path: Path, name, old, new, message
):
    file = policy_dir / name
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(SpecError) as caught:
        build(policy_dir, tmp_path / "out")
    assert message.format(file=file) in caught.value.message
    assert str(tmp_path / "out") not in str(caught.value)


@pytest.mark.parametrize("place", ["../outside.json", "absolute"])
def test_an_asset_outside_the_policys_folder_is_refused_and_nothing_is_written_outside(
    policy_dir: Path, tmp_path: Path, place: str
):
    shutil.copyfile(policy_dir / "vocabulary.json", policy_dir.parent / "outside.json")
    named = str(policy_dir.parent / "outside.json") if place == "absolute" else place
    edit(policy_dir, "tokenizer: vocabulary.json", f"tokenizer: {named}")
    with pytest.raises((SourceError, SpecError), match=r"outside.json"):
        build(policy_dir, tmp_path / "out")
    assert not (tmp_path / "out/outside.json").exists()


def test_the_check_passes_for_a_good_policy(policy_dir: Path):
    TorchModule(policy=policy_dir).check(None, None)
    TorchModule(policy=policy_dir / "policy.yaml").check(None, None)
