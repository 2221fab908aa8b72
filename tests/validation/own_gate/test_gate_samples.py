"""The gate on the sample policies: what it is held against, and when there is nothing to measure."""

import subprocess

import gate_samples
import pytest

from vlatool.gate.config import read_gate


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository of two commits."""
    monkeypatch.setattr(gate_samples, "ROOT", tmp_path)
    for words in (["init", "-q"], ["config", "user.email", "a@b"], ["config", "user.name", "a"]):
        subprocess.run(["git", "-C", tmp_path, *words], check=True)
    for number in (1, 2):
        (tmp_path / "file").write_text(str(number))
        subprocess.run(["git", "-C", tmp_path, "add", "."], check=True)
        subprocess.run(["git", "-C", tmp_path, "commit", "-q", "-m", str(number)], check=True)
    return tmp_path


def test_the_base_is_the_commit_before_or_where_the_branch_left_main(repository):
    first, second = gate_samples.git("rev-parse", "HEAD~1"), gate_samples.git("rev-parse", "HEAD")
    assert gate_samples.base_commit() == first
    subprocess.run(["git", "-C", repository, "update-ref", "refs/remotes/origin/main", first], check=True)
    assert gate_samples.base_commit() == first
    subprocess.run(["git", "-C", repository, "update-ref", "refs/remotes/origin/main", second], check=True)
    assert gate_samples.base_commit() == first, "on main itself the commit before"


def test_a_first_commit_has_nothing_before_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gate_samples, "ROOT", tmp_path)
    monkeypatch.setattr(gate_samples.sys, "argv", ["gate_samples.py"])
    assert gate_samples.main() == 0
    assert "nothing to gate" in capsys.readouterr().out


def test_a_tree_is_there_for_a_while(repository):
    with gate_samples.checked_out("HEAD~1") as tree:
        assert (tree / "file").read_text() == "1"
    assert not tree.exists()
    assert len(gate_samples.git("worktree", "list").splitlines()) == 1


def test_the_same_graphs_need_no_measurement_and_other_ones_do(float_bundle, int8_bundle, copied, tmp_path, capsys):
    again = copied(float_bundle)
    assert gate_samples.gated(again.path, float_bundle.path, tmp_path / "x/gate.yaml", tmp_path, False) == 0
    assert "byte for byte" in capsys.readouterr().out
    assert gate_samples.graphs(float_bundle.path) != gate_samples.graphs(int8_bundle.path)


def test_a_gate_that_cannot_run_ends_the_run(float_bundle, int8_bundle, tmp_path):
    with pytest.raises(SystemExit) as ended:
        gate_samples.gated(int8_bundle.path, float_bundle.path, tmp_path / "none.yaml", tmp_path, False)
    assert ended.value.code == 3


@pytest.mark.parametrize("sample", ["vln-babyai", "vla-metaworld", "vla-flow"])
def test_every_sample_has_a_gate(sample):
    from pathlib import Path

    gate = read_gate(Path(__file__).parents[3] / "sample_models" / sample / "gate.yaml")
    assert gate.latency
    assert gate.accuracy
    assert gate.memory
    assert gate.size
