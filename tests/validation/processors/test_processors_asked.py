"""Bundles that are asked in another process, which may refuse them or crash."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from _asked import CRASHED, ask, how_it_ended, parsed, run
from _planted import plant

from vlatool.bundle.bundle import replace_manifest
from vlatool.files.npz import open_npz
from vlatool.runtime import load
from vlatool.stage.finish import ENGINE_DIFFERENCE, GOLDEN, save_npz


@pytest.fixture
def observations(float_bundle, tmp_path):
    """Three observations in a file that numpy alone reads."""
    with np.load(float_bundle.path / "data/evaluation.npz") as stored:
        seen = {tensor.name: stored[tensor.name][:3] for tensor in float_bundle.manifest.spec.inputs}
    np.savez(tmp_path / "seen.npz", **seen)
    return tmp_path / "seen.npz"


@pytest.fixture
def wrong(float_bundle, copied, resealed):
    """A bundle whose golden action is another one."""
    bundle = copied(float_bundle)
    arrays = open_npz(bundle.path / GOLDEN)
    save_npz(bundle.path / GOLDEN, {**arrays, "out.action": arrays["out.action"] * 1.3})
    return resealed(bundle)


def quiet(line: str) -> None:
    """Take a line of progress."""


def test_a_bundle_answers_and_one_that_load_refuses_is_told_with_how_wrong_it_is(
    float_bundle, wrong, observations, tmp_path
):
    bundles = {"right": float_bundle.path, "wrong one": wrong.path, "none": tmp_path / "none"}
    found = ask([sys.executable], bundles, observations, tmp_path / "answers", tell=quiet)
    assert found["right"].refused == ""
    assert found["right"].actions.shape == (3, 4, 2)
    policy = load(float_bundle.path, threads=1)
    with np.load(observations) as stored:
        seen = {name: stored[name][1] for name in stored.files}
    wanted = policy.infer({**seen, "instruction": str(seen["instruction"])}).outputs["action"]
    np.testing.assert_allclose(found["right"].actions[1], wanted[0], rtol=1e-5)
    assert found["right"].engine.startswith("ort_cpu 1.")
    assert found["right"].arithmetic
    assert found["wrong one"].refused == "GraphError"
    assert "a different golden action" in found["wrong one"].why
    assert found["wrong one"].golden == pytest.approx(0.3 / 1.3, abs=1e-3)
    np.testing.assert_array_equal(found["wrong one"].actions, found["right"].actions)
    assert (found["none"].refused, found["none"].actions) == ("BundleError", None)


def test_a_finding_is_a_refusal_too(float_bundle, copied, observations, tmp_path):
    bundle = copied(float_bundle)
    finding = {"name": ENGINE_DIFFERENCE, "message": "another action", "stage": "quantize.x"}
    replace_manifest(bundle, replace(bundle.manifest, findings=(finding,)))
    found = ask([sys.executable], {"a": bundle.path}, observations, tmp_path / "answers", tell=quiet)["a"]
    assert found.refused == "GraphError"
    assert ENGINE_DIFFERENCE in found.why
    assert found.actions is not None


CRASHING = """\
import os, pathlib, signal, sys
sys.argv = sys.argv[1:]
sys.path.insert(0, str(pathlib.Path(sys.argv[0]).parent))
import answers
real = answers.answered
def answered(path, *more):
    if path.name == "second":
        os.kill(os.getpid(), signal.SIGSEGV)
    return real(path, *more)
answers.answered = answered
answers.main()
"""


def test_a_process_that_crashes_is_one_answer_and_the_others_are_asked_again(float_bundle, observations, tmp_path):
    crashing = tmp_path / "crashing.py"
    crashing.write_text(CRASHING)
    bundles = {"first": float_bundle.path, "second": tmp_path / "second", "third": tmp_path / "third"}
    found = ask([sys.executable, str(crashing)], bundles, observations, tmp_path / "answers", tell=quiet)
    assert [found[name].refused for name in bundles] == ["", CRASHED, "BundleError"]
    assert "SIGSEGV" in found["second"].why


def test_a_line_that_was_not_written_to_its_end_is_none():
    assert parsed('{"bundle": "a"}\nnoise\n{"bundle": "b", "ref') == [{"bundle": "a"}]


def test_how_a_process_ended_is_told():
    assert how_it_ended(-11, "") == "the process was killed: SIGSEGV"
    uncaught = "qemu: uncaught target signal 4 (Illegal instruction) - core dumped"
    assert how_it_ended(132, f"warning\n{uncaught}\n") == f"the process was killed: {uncaught}"
    assert how_it_ended(1, "Traceback\nImportError: numpy\n") == "the process left with 1: ImportError: numpy"
    assert how_it_ended(1, "") == "the process left with 1: it said nothing"


def test_one_that_was_interrupted_ends_the_whole_run():
    """Ctrl-C reaches the process that is asked, too: it is no crash, after which the next bundle would be asked."""
    code = "import os, signal as s; s.signal(s.SIGINT, s.SIG_DFL); os.kill(os.getpid(), s.SIGINT)"
    with pytest.raises(KeyboardInterrupt):
        run([sys.executable, "-c", code], {})


def test_a_process_that_takes_too_long_is_ended(monkeypatch):
    monkeypatch.setattr("_asked.SECONDS", 1.0)
    lines, ended = run([sys.executable, "-uc", 'import time; print(\'{"bundle": "a"}\'); time.sleep(100)'], {})
    assert lines in ([{"bundle": "a"}], [])
    assert "more than 1 s" in ended


def test_the_planted_bundle_is_right_where_it_was_made_and_holds_a_conversion_that_wraps(float_bundle, tmp_path):
    planted = plant(float_bundle.path, tmp_path / "planted")
    policy, plain = load(planted, threads=1), load(float_bundle.path, threads=1)
    assert policy.golden_error == pytest.approx(0, abs=1e-6)
    assert not policy.bundle.manifest.findings
    seen = next(iter(open_golden(plain)))
    added = policy.infer(seen).outputs["action"] - plain.infer(seen).outputs["action"]
    assert added.any(), "an action of the planted bundle has to be another one, here or on ARM"


def open_golden(policy):
    """Return the golden observations of an open bundle."""
    from vlatool.runtime.golden import load_goldens

    return [golden[0] for golden in load_goldens(policy.bundle)]
