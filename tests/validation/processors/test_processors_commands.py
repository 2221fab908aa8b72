"""``make arm64`` and ``make ladder``: what they say, and with which status they leave."""

import contextlib
import io

import _variants
import arm64
import ladder
import numpy as np
import onnxruntime
import pytest
from _asked import Answer
from _emulation import EmulationError, Emulators, Unreachable
from _rungs import RUNGS
from _variants import FLOAT, FOR_ARM, FOR_X86, Made, Variant, make, observations
from arm64 import PLANTED, compared

from vlatool.cli import main
from vlatool.runtime.arithmetic import EXACT, EXACT_BY_OPTION, SATURATING

ACTIONS = np.arange(1.0, 7.0).reshape(2, 3)


def fails(monkeypatch, error: Exception) -> None:
    """Let the first thing that is fetched fail."""

    def fetch(self, *names):
        raise error

    for name in ("board", "qemu"):
        monkeypatch.setattr(Emulators, name, fetch)


def test_arm64_is_skipped_in_one_line_where_a_registry_does_not_answer(monkeypatch, tmp_path, capsys):
    fails(monkeypatch, Unreachable("Debian's mirror does not answer: Could not connect"))
    assert arm64.main(["-o", str(tmp_path)]) == 0
    told = capsys.readouterr()
    assert told.out == "make arm64: skipped, nothing was tried: Debian's mirror does not answer: Could not connect\n"
    assert told.err == ""


def test_arm64_fails_where_anything_else_does(monkeypatch, tmp_path, capsys):
    fails(monkeypatch, EmulationError("qemu-aarch64 is no program for x86_64."))
    assert arm64.main(["-o", str(tmp_path)]) == 1
    assert "is no program" in capsys.readouterr().err


def test_a_bundle_has_to_load_on_arm_and_the_planted_one_must_not():
    here = {name: Answer(ACTIONS) for name in ("float32", "ort uint8", "int4", PLANTED)}
    there = {
        "float32": Answer(ACTIONS * (1 + 1e-6)), "ort uint8": Answer(ACTIONS * 1.1),
        "int4": Answer(ACTIONS, "GraphError", "another golden action"), PLANTED: Answer(ACTIONS * 2, "GraphError"),
    }  # fmt: skip
    rows = {row.bundle: row for row in compared(("core",), here, there)}
    assert {name: row.verdict for name, row in rows.items()} == {
        "float32": "ok", "ort uint8": "WRONG", "int4": "WRONG", PLANTED: "refused",
    }  # fmt: skip
    assert rows["float32"].limit == FLOAT.limit
    assert compared(("core",), here, {**there, PLANTED: Answer(ACTIONS)})[-1].verdict == "NOT REFUSED"
    assert compared(("core",), here, {"float32": Answer(None, "crash")})[0].verdict == "WRONG"


def test_what_this_host_refuses_itself_shows_nothing_about_arm():
    here = {"float32": Answer(ACTIONS, "GraphError", "a finding")}
    assert compared(("core",), here, {"float32": Answer(ACTIONS)})[0].verdict == "WRONG"


def test_a_bundle_that_was_not_made_is_wrong(tmp_path):
    made = Made("policy", {}, {"int4": "no layer"}, tmp_path, 1, 1)
    assert [row.verdict for row in arm64.unmade(made)] == ["WRONG"]


def test_a_rung_that_the_host_lacks_is_named_and_not_tried(monkeypatch, tmp_path):
    monkeypatch.setattr(Emulators, "qemu", lambda self, arch: tmp_path)
    monkeypatch.setattr(ladder, "architecture", lambda: "x86_64")
    told = {rung.name: why for rung, why in ladder.tried(frozenset({"avx2"}), Emulators(tmp_path)).items()}
    assert told["AVX2"] == ""
    assert told["AVX2_VNNI"] == "this host lacks avx_vnni"
    assert "avx512_vnni" in told["AVX512_CORE_VNNI"]


def test_an_x86_processor_is_emulated_on_x86_alone(monkeypatch, tmp_path):
    """QEMU runs the host's own Python, which elsewhere is of another architecture."""
    monkeypatch.setattr(ladder, "architecture", lambda: "aarch64")
    fails(monkeypatch, AssertionError("nothing is fetched"))
    told = {rung: why for rung, why in ladder.tried(frozenset(), Emulators(tmp_path)).items() if rung.cpu}
    assert {*told.values()} == {"this host is aarch64"}


def test_without_a_mirror_the_emulated_rung_alone_is_not_tried(monkeypatch, tmp_path):
    monkeypatch.setattr(ladder, "architecture", lambda: "x86_64")
    fails(monkeypatch, Unreachable("Debian's mirror does not answer: timed out"))
    told = ladder.tried(frozenset({"avx2"}), Emulators(tmp_path))
    assert [why for rung, why in told.items() if rung.cpu] == ["Debian's mirror does not answer: timed out"]
    assert not any(why for rung, why in told.items() if rung.name == "host")
    fails(monkeypatch, EmulationError("no apt"))
    with pytest.raises(SystemExit):
        ladder.tried(frozenset(), Emulators(tmp_path))


@pytest.mark.parametrize(
    ("arithmetic", "by", "verdict"),
    [(SATURATING, 1.2, "warned"), (EXACT, 1.2, "WRONG"), (EXACT_BY_OPTION, 1.2, "WRONG"), (SATURATING, 1.01, "ok")],
)
def test_doctor_warns_of_int8_where_products_saturate(int8_bundle, arithmetic, by, verdict):
    variant = next(each for each in FOR_X86 if each.name == "openvino")
    answer = Answer(ACTIONS[:1] * by, arithmetic=arithmetic)
    assert ladder.row(("openvino",), variant, answer, ACTIONS, int8_bundle.path).verdict == verdict


def test_what_cannot_be_made_is_wrong_unless_the_processor_may_lack_what_it_needs():
    verdicts = {each.name: ladder.unmade(("openvino",), each, "no such processor").verdict for each in FOR_X86}
    assert {name for name, verdict in verdicts.items() if verdict == "not tried"} == {"openvino bfloat16", "bfloat16"}
    assert {*verdicts.values()} == {"not tried", "WRONG"}


def test_doctor_warns_of_no_float32(float_bundle):
    answer = Answer(ACTIONS * 1.2, arithmetic=SATURATING)
    assert ladder.row(("openvino",), FLOAT, answer, ACTIONS, float_bundle.path).verdict == "WRONG"


def test_what_the_graphs_say_is_held_against_as_many_observations_as_were_asked(float_bundle, tmp_path):
    seen, count = observations(float_bundle.path, 3)
    assert {len(values) for values in seen.values()} == {3}
    assert len(observations(float_bundle.path, 0)[0]["image"]) == count
    np.savez(tmp_path / "observations.npz", **seen)
    first = ladder.some_of(tmp_path / "observations.npz", 2)
    whole, some = (ladder.reference(float_bundle.path, file) for file in (tmp_path / "observations.npz", first))
    assert (len(whole), len(some)) == (3, 2)
    np.testing.assert_array_equal(whole[:2], some)


def test_variants_have_names_and_folders_of_their_own_and_every_rung_has_some():
    for variants in (FOR_ARM, FOR_X86):
        assert len({variant.name.replace(" ", "-") for variant in variants}) == len(variants)
        assert all(0 < variant.limit <= 0.045 for variant in variants)
    assert all(any(rung.engine in variant.engines for variant in FOR_X86) for rung in RUNGS)


def in_this_process(*words: str) -> str:
    """Run a command line as ``_variants.vlatool`` does, without an interpreter of its own."""
    with contextlib.redirect_stderr(io.StringIO()) as said, pytest.raises(SystemExit) as left:
        main([*words, "--force"])
    return said.getvalue() if left.value.code else ""


def test_a_policy_becomes_bundles_and_what_cannot_be_made_is_told(policy_dir, tmp_path, monkeypatch):
    monkeypatch.setattr(_variants, "vlatool", in_this_process)
    variants = (
        FLOAT,
        Variant("dynamic int8", ("quantize", "dynamic-int8")),
        Variant("no such", ("quantize", "dynamic-int8", "--bits", "3")),
    )
    made = make(str(policy_dir), variants, tmp_path / "out", 2)
    assert {name: path.name for name, path in made.bundles.items()} == {
        "float32": "float32", "dynamic int8": "dynamic-int8",
    }  # fmt: skip
    assert "--bits" in made.refused["no such"]
    assert (made.chosen, made.name) == (2, policy_dir.name)
    with np.load(made.observations, allow_pickle=False) as stored:
        assert stored["instruction"].dtype.kind == "U"


def test_a_command_that_fails_is_told_in_one_line():
    assert _variants.vlatool("samples", "make", "--help") == ""
    assert "--force" in _variants.vlatool("samples", "list")


def test_the_newest_is_what_this_host_runs():
    assert arm64.parsed(["--newest"]).onnxruntime == (onnxruntime.__version__,)
    assert arm64.parsed([]).onnxruntime == (arm64.OLDEST, onnxruntime.__version__)
