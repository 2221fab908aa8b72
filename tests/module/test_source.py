"""Which source reads what a person names."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from vlatool import registry
from vlatool.bundle.bundle import Bundle
from vlatool.errors import SourceError
from vlatool.module.source import claimed_source, describe, is_bundle, source_of_policy
from vlatool.registry import Claim
from vlatool.sources import open_source
from vlatool.user_code import trust


@pytest.mark.parametrize(
    ("typed", "torch", "onnx"),
    [
        ("tiny", Claim.CERTAIN, Claim.NONE), ("tiny/policy.yaml", Claim.CERTAIN, Claim.NONE),
        ("none/policy.yaml", Claim.CERTAIN, Claim.NONE), ("other.yaml", Claim.MAYBE, Claim.NONE),
        ("tiny/policy.py:make", Claim.CERTAIN, Claim.NONE), ("tiny/policy.py", Claim.NONE, Claim.NONE),
        ("none.onnx", Claim.NONE, Claim.CERTAIN), ("graphs", Claim.NONE, Claim.MAYBE), (".", Claim.NONE, Claim.NONE),
        ("", Claim.NONE, Claim.NONE), ("a:b", Claim.NONE, Claim.NONE), ("tiny/policy.npz", Claim.NONE, Claim.NONE),
    ],
)  # fmt: skip
def test_each_source_says_how_sure_it_is(policy_dir: Path, monkeypatch, typed: str, torch: Claim, onnx: Claim):
    monkeypatch.chdir(policy_dir.parent)
    Path("graphs").mkdir()
    Path("graphs/a.onnx").touch()
    claims = {name: source.claims(typed) for name, source in registry.loadable("sources")}
    expected = {"torch_module": torch, "onnx": onnx}
    assert claims == {name: expected.get(name, Claim.NONE) for name in claims}
    assert claims.keys() >= expected.keys()


def test_a_description_beside_an_onnx_file_is_a_policy(policy_dir: Path):
    (policy_dir / "a.onnx").touch()
    assert source_of_policy(policy_dir).name() == "sources.torch_module"
    assert describe(policy_dir).environment["tasks"] == ["reach", "push"]
    graphs = source_of_policy(policy_dir / "a.onnx")
    assert graphs.has_graphs
    assert graphs.describe() is not None
    assert graphs.describe().graphs == {"main": policy_dir / "a.onnx"}


def test_describing_lets_no_code_run_and_opening_does(policy_dir: Path):
    with trust.forget_named():
        describe(policy_dir)
        assert not trust.is_named(policy_dir)
        open_source(str(policy_dir))
        assert trust.is_named(policy_dir)


def test_a_bundle_is_what_has_a_manifest(float_bundle: Bundle, tmp_path: Path):
    bundle = Path(shutil.copytree(float_bundle.path, tmp_path / "bundle"))
    (bundle / "policy.yaml").write_text("name: a\n")
    assert is_bundle(bundle)
    assert claimed_source(bundle) is None
    assert isinstance(open_source(str(float_bundle.path)), Bundle)
    assert not is_bundle(tmp_path)
    with pytest.raises(SourceError, match="is a bundle; the policy that it was made from is needed"):
        source_of_policy(bundle)


def test_a_manifest_of_another_format_makes_no_bundle(policy_dir: Path, tmp_path: Path):
    (policy_dir / "manifest.json").write_text('{"format": "of another tool"}')
    assert not is_bundle(policy_dir)
    assert source_of_policy(policy_dir).name() == "sources.torch_module"
    (policy_dir / "policy.yaml").unlink()
    assert not is_bundle(policy_dir)
    with pytest.raises(SourceError, match="it looks like a package of another tool, of the format 'of another tool'"):
        source_of_policy(policy_dir)


def test_what_has_no_description_is_told(tmp_path: Path):
    with pytest.raises(SourceError, match=r"a\.onnx has no description") as caught:
        describe(tmp_path / "a.onnx")
    assert "policy.yaml" in caught.value.fix
