"""Which set a board needs, whether a host with planted flags can be confined to it, and what is said."""

from __future__ import annotations

from pathlib import Path

import pytest

from vlatool.hardware.profile import load_profile
from vlatool.machine import instruction_sets
from vlatool.machine.host import ISA_FEATURES, isa
from vlatool.machine.instruction_sets import (
    RUNGS,
    BoardSet,
    about_onnx_runtime,
    board_set,
    compare_sets,
    openvino_set,
    rung,
)

NUC = ("avx2", "fma", "f16c", "avx_vnni")
OLD = ("avx2", "fma", "f16c")
ZEN4 = ("avx2", "fma", "f16c", "avx512f", "avx512_vnni", "avx512_bf16")
ZEN5 = (*ZEN4, "avx_vnni")
SAPPHIRE = (*ZEN5, "amx_tile", "amx_int8", "amx_bf16")
ARM = ("asimd", "asimdhp", "asimddp")


@pytest.mark.parametrize(
    ("features", "name"),
    [
        (OLD, "AVX2"), (NUC, "AVX2_VNNI"), ((*NUC, "avx_vnni_int8"), "AVX2_VNNI_2"), ((*OLD, "avx512f"), "AVX512_CORE"),
        ((*OLD, "avx512f", "avx512_vnni"), "AVX512_CORE_VNNI"), (ZEN4, "AVX512_CORE_BF16"),
        (SAPPHIRE, "AVX512_CORE_AMX"), (ARM, ""), ((), ""),
    ],
)  # fmt: skip
def test_the_set_of_a_processor_is_its_highest(features: tuple[str, ...], name: str):
    assert rung(features) == name


def test_every_feature_that_tells_sets_apart_is_read_from_the_processor():
    assert set(RUNGS.values()) <= set(ISA_FEATURES)


@pytest.mark.parametrize(
    ("board", "host", "to_set", "lacks"),
    [
        (NUC, SAPPHIRE, "AVX2_VNNI", ""),
        (NUC, ZEN5, "AVX2_VNNI", ""),
        (NUC, ZEN4, "", "avx_vnni"),  # AVX512-VNNI is another instruction: oneDNN would fall to AVX2 in silence
        (NUC, OLD, "", "avx_vnni"),
        (NUC, NUC, "", ""),
        (OLD, ZEN4, "AVX2", ""),
        (OLD, NUC, "AVX2", ""),
        (OLD, OLD, "", ""),
        (ZEN4, SAPPHIRE, "AVX512_CORE_BF16", ""),
        (ZEN4, NUC, "", "avx512_bf16"),
        (OLD, ARM, "", "avx2"),
        (ARM, ZEN4, "", ""),
    ],
)
def test_a_host_is_confined_where_it_has_the_set_of_the_board(board, host, to_set: str, lacks: str):
    found = compare_sets("board", board, host)
    assert (found.to_set, found.lacks) == (to_set, lacks)
    assert found.plan() != "" or not found.wanted


@pytest.mark.parametrize(
    ("board", "host", "told", "confined"),
    [(OLD, ZEN4, "AVX2", True), (OLD, ZEN4, "", False), (OLD, ZEN4, "AVX512_CORE", False), (OLD, OLD, "AVX2", False),
     (NUC, ZEN5, "AVX2_VNNI", True), (NUC, ZEN4, "AVX2_VNNI", False)],
)  # fmt: skip
def test_a_process_is_confined_when_the_variable_says_so_and_the_processor_can(board, host, told: str, confined: bool):
    found = compare_sets("board", board, host, told)
    assert found.is_confined is confined
    assert not found.to_set or not told, "what a person set is not set again"


@pytest.mark.parametrize(
    ("host", "told", "warned"), [(NUC, "AVX512_CORE_AMX", False), (ZEN4, "AVX512_CORE_AMX", True), (NUC, "AVX2", True)]
)
def test_a_name_above_what_the_processor_has_confines_nothing(host, told: str, warned: bool):
    found = compare_sets("nuc", NUC, host, told)
    assert found.same_set is (host == NUC and told != "AVX2")
    assert bool(found.warnings()) is warned
    assert ("ONEDNN_MAX_CPU_ISA" in str(found.warnings())) is (told == "AVX2")


def test_what_is_said_of_a_confined_run():
    set_, engines = compare_sets("nuc", NUC, ZEN5, "AVX2_VNNI").sentences()
    assert "confined to AVX2_VNNI, the instruction set of nuc: its errors are of that set" in set_
    assert "of the same instruction set on another core; its milliseconds are not the board's" in set_
    assert "this host's own set (AVX512_CORE_BF16), and no ratio between the two engines is given." in engines
    assert "VNNI and the board has none" not in engines
    assert not compare_sets("nuc", NUC, ZEN5, "AVX2_VNNI").warnings()
    assert (
        "It has VNNI and the board has none: int8 gains less" in compare_sets("old", OLD, ZEN4, "AVX2").sentences()[1]
    )


@pytest.mark.parametrize(
    ("board", "host", "says"),
    [
        (NUC, ZEN4, "no avx_vnni, and oneDNN would take an older set in silence"),
        (NUC, ZEN4, "this host's set (AVX512_CORE_BF16): int8 products are exact in both, so that errors are the near"),
        (NUC, OLD, "int8 products are exact on the board and may saturate here, so that errors do not carry over"),
        ((*OLD, "avx512f"), NUC, "may saturate on the board and are exact here, so that errors do not carry over"),
        ((*OLD, "avx512f"), OLD, "int8 products may saturate in both"),
        (NUC, ARM, "this host's set (another architecture): errors may differ"),
    ],
)
def test_a_host_without_the_set_says_so_and_what_its_figures_are_worth(board, host, says: str):
    found = compare_sets("nuc", board, host)
    (warning,) = found.warnings()
    assert says in warning
    assert "speed-ups are not those of the board" in warning
    assert f"Measure on nuc, or on a processor with {found.lacks}." in warning
    assert not found.sentences()
    assert not found.is_confined


def test_a_set_that_a_person_chose_is_kept_and_told():
    (warning,) = compare_sets("nuc", NUC, ZEN5, "AVX512_CORE").warnings()
    assert warning.startswith("ONEDNN_MAX_CPU_ISA=AVX512_CORE is set")


def test_a_host_of_the_same_set_needs_nothing_and_says_that_the_core_is_another():
    found = compare_sets("nuc", NUC, NUC)
    assert (found.to_set, found.warnings(), found.same_set) == ("", (), True)
    assert "milliseconds are this host's" in found.sentences()[0]


def test_nothing_is_said_where_there_is_nothing_to_compare():
    assert (BoardSet().to_set, BoardSet().plan(), BoardSet().sentences(), BoardSet().warnings()) == ("", "", (), ())
    assert not BoardSet().is_confined


def test_a_profile_says_its_set_where_it_runs_openvino(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    monkeypatch.setattr(instruction_sets, "isa", lambda: list(ZEN5))
    monkeypatch.setattr(instruction_sets, "fingerprint", lambda: {"cpu": "AMD EPYC"})
    nuc = load_profile("intel-nuc-13-pro")
    assert board_set(nuc).to_set == "AVX2_VNNI"
    assert board_set(nuc).where == "this host, OpenVINO confined to AVX2_VNNI"
    for name in ("raspberry-pi-5", "rtx-4060-pc"):
        assert board_set(load_profile(name)) == BoardSet()
    assert board_set(None) == BoardSet()
    monkeypatch.setattr(instruction_sets, "fingerprint", lambda: {"cpu": "13th Gen Intel(R) Core(TM) i7-1360P"})
    assert board_set(nuc) == BoardSet(), "on the board itself"


@pytest.mark.parametrize(
    ("board", "host", "says"),
    [(OLD, ZEN4, "in this host's own set (AVX512_CORE_BF16), which has it: its speed-ups do not carry over."),
     (OLD, OLD, "int8 may be slower than float32 there."), (OLD, ARM, "than float32 there."), (NUC, ZEN4, "")],
)  # fmt: skip
def test_a_board_of_onnx_runtime_alone_is_told_what_it_lacks(monkeypatch, board, host, says: str):
    monkeypatch.setattr(instruction_sets, "isa", lambda: list(host))
    nuc = load_profile("intel-nuc-13-pro")
    units = {"cpu": nuc.units["cpu"].model_copy(update={"isa": board})}
    alone = nuc.model_copy(update={"units": units, "engines": {"ort_cpu": nuc.engines["ort_cpu"]}})
    assert "".join(about_onnx_runtime(alone)).endswith(says)
    assert bool(about_onnx_runtime(alone)) == bool(says)
    both = nuc.model_copy(update={"units": units})
    assert (
        about_onnx_runtime(both) == about_onnx_runtime(load_profile("raspberry-pi-5")) == about_onnx_runtime(None) == ()
    )


def test_flags_of_every_core_count(tmp_path: Path):
    (tmp_path / "proc").mkdir()
    text = "flags\t\t: fpu lm avx2 fma avx512f avx512_vnni\n\nflags\t\t: fpu lm avx2 fma avx_vnni\n"
    (tmp_path / "proc/cpuinfo").write_text(text)
    assert rung(isa(tmp_path) or ()) == "AVX2"


def test_what_openvino_computes_in_is_the_variable_or_the_processor(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ONEDNN_MAX_CPU_ISA", raising=False)
    monkeypatch.setattr(instruction_sets, "isa", lambda: list(NUC))
    assert openvino_set() == "AVX2_VNNI"
    monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", "AVX2")
    assert openvino_set() == "AVX2"
