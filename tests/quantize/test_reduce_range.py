"""Weights of which no pair saturates are written where the board, or without one this host, has no VNNI."""

import json
from pathlib import Path

import pytest

from vlatool.cli import main
from vlatool.hardware.profile import Profile, load_profile
from vlatool.quantize.dynamic_int8 import DynamicInt8
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime.arithmetic import EXACT, EXACT_BY_OPTION, SATURATING
from vlatool.runtime.engine import UNKNOWN
from vlatool.runtime.engines.openvino import OpenvinoSession
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.runtime.weight_pairs import weights_fit

STAGES = [StaticInt8(), StaticInt8(layout="openvino"), DynamicInt8()]


@pytest.fixture
def products(monkeypatch):
    """A function that lets both engines say how they compute integer products."""

    def say(how: str) -> None:
        for engine in (OrtCpuSession, OpenvinoSession):
            monkeypatch.setattr(engine, "arithmetic", staticmethod(lambda: how))
        monkeypatch.setattr("vlatool.quantize._base.int8_arithmetic", lambda engine: how)

    return say


def board(tmp_path: Path, isa: str) -> Profile:
    text = (Path(__file__).parents[2] / "profiles/intel-nuc-13-pro.yaml").read_text(encoding="utf-8")
    (tmp_path / "board.yaml").write_text(text.replace("[avx2, fma, f16c, avx_vnni]", isa), encoding="utf-8")
    return load_profile(tmp_path / "board.yaml")


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name())
@pytest.mark.parametrize(("how", "reduced"), [
    (SATURATING, True), (EXACT_BY_OPTION, True), (EXACT, False), (UNKNOWN, False)
])  # fmt: skip
def test_without_a_board_the_host_decides(stage, how: str, reduced: bool, products) -> None:
    products(how)
    assert stage.on(None).reduce_range is reduced
    for given in (True, False):
        assert stage.model_copy(update={"reduce_range": given}).on(None).reduce_range is given


def test_the_standard_layout_may_be_for_any_board_and_stays(products) -> None:
    products(SATURATING)
    assert not StaticInt8(layout="qdq").on(None).reduce_range


@pytest.mark.parametrize("stage", STAGES, ids=lambda stage: stage.name())
@pytest.mark.parametrize(("isa", "reduced"), [
    ("[avx2, fma, f16c]", True), ("[avx2, fma, f16c, avx_vnni]", False), ("[avx2, avx512f]", True),
    ("[avx2, avx512f, avx512_vnni]", False), ("[asimd]", False),
])  # fmt: skip
def test_a_board_decides_whatever_the_host_is(stage, isa: str, reduced: bool, tmp_path: Path, products) -> None:
    products(EXACT if reduced else SATURATING)
    assert stage.on(board(tmp_path, isa)).reduce_range is reduced
    given = stage.model_copy(update={"reduce_range": not reduced})
    assert given.on(board(tmp_path, isa)).reduce_range is not reduced


@pytest.mark.parametrize("command", [("static-int8",), ("dynamic-int8",), ("static-int8", "--layout", "openvino")])
def test_the_command_line_says_what_it_wrote(command, float_bundle, tmp_path: Path, products, capsys) -> None:
    pytest.importorskip("openvino")
    products(SATURATING)
    with pytest.raises(SystemExit) as ended:
        main(["quantize", *command, str(float_bundle.path), "-o", str(tmp_path / "made")])
    assert ended.value.code in (0, None)
    assert "no pair of products saturates" in capsys.readouterr().out
    assert weights_fit(tmp_path / "made/graphs/main.onnx")
    options = json.loads((tmp_path / "made/manifest.json").read_text())["made_by"]["options"]
    assert options["reduce_range"] is True, "the record makes the same bundle on any host"


def test_all_bits_are_kept_when_asked_for(float_bundle, tmp_path: Path, products, capsys) -> None:
    products(SATURATING)
    with pytest.raises(SystemExit):
        main(["quantize", "static-int8", str(float_bundle.path), "-o", str(tmp_path / "made"), "--no-reduce-range"])
    assert "saturates" not in capsys.readouterr().out
    assert not weights_fit(tmp_path / "made/graphs/main.onnx")
