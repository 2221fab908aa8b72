from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from vlatool import profile as module
from vlatool.errors import ProfileError
from vlatool.profile import GROUNDED, Profile, load_profile, names

SHIPPED = ("intel-nuc-13-pro", "jetson-orin-nano", "raspberry-pi-5")


@pytest.fixture
def valid() -> dict[str, Any]:
    path = Path(module.__file__).parent.parent / "profiles" / "raspberry-pi-5.yaml"
    return dict(yaml.safe_load(path.read_text()))


def write(folder: Path, data: Any, name: str = "mine") -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return path


def problems(folder: Path, data: Any) -> str:
    with pytest.raises(ProfileError) as caught:
        load_profile(write(folder, data))
    return caught.value.message


def figures(value: Any) -> list[Any]:
    """Everything in a profile that has a kind."""
    if isinstance(value, BaseModel):
        return ([value] if hasattr(value, "kind") else []) + figures(tuple(dict(value).values()))
    items = value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else ()
    return [figure for item in items for figure in figures(item)]


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_profiles_are_sound(name: str) -> None:
    found = load_profile(name)
    assert found.name == name in names()
    assert len(figures(found)) > 14
    assert not any("/work" in text or "/home" in text for text in found.sources.values())
    for unit in found.units.values():
        assert not {*unit.isa} & {*unit.absent}
    assert found.mode().bandwidth_gb_s == found.bandwidth_gb_s.value
    assert {figure.source for figure in figures(found)} == {*found.sources}, "a source that nothing cites"


def test_unverified_figures_are_marked() -> None:
    kinds = {figure.kind for name in SHIPPED for figure in figures(load_profile(name)) if figure.source == "recalled"}
    assert kinds == {"unverified"}
    assert "unverified" not in GROUNDED


def test_orin_nano_is_dense_not_sparse() -> None:
    orin = load_profile("jetson-orin-nano")
    assert orin.units["gpu"].peak_tops["int8"].value == pytest.approx(67 / 2, abs=0.15)
    assert orin.peak_tops("gpu", "int8", "MAXN_SUPER") == pytest.approx(33.4)
    assert orin.peak_tops("gpu", "int8", "15W_original") == pytest.approx(20.5, abs=0.05)
    assert orin.peak_tops("gpu", "int8", "7W") == pytest.approx(33.4 * 4 / 8 * 408 / 1020)
    assert orin.peak_tops("gpu", "float8") is None
    assert orin.units["gpu"].peak_tops["float16"].value == pytest.approx(33.4 / 2)
    assert orin.mode("15W").bandwidth_gb_s == 68
    assert orin.usable_memory_gb.value < 6
    assert {"float8", "float4", "dla"} <= {*orin.units["gpu"].absent}
    assert not orin.engines["ort_tensorrt"].integer_ops
    assert orin.int8_layout == "s8s8"


def test_pi_has_no_more_than_dot_product() -> None:
    cpu = load_profile("raspberry-pi-5").units["cpu"]
    assert cpu.peak_tops["float32"].value == pytest.approx(4 * 2.4 * 16 / 1000)
    assert cpu.peak_tops["int8"].value == pytest.approx(4 * cpu.peak_tops["float32"].value)
    assert "asimddp" in cpu.isa
    assert {"i8mm", "sve", "bf16"} <= {*cpu.absent}


def test_nuc_has_vnni_without_avx512() -> None:
    nuc = load_profile("intel-nuc-13-pro")
    assert "avx_vnni" in nuc.units["cpu"].isa
    assert not [name for name in nuc.units["cpu"].isa if name.startswith(("avx512", "amx"))]
    assert nuc.int8_layout == "u8s8"
    assert nuc.engine == "ort_cpu"
    assert {"ort_cpu", "openvino"} <= {*nuc.engines}


def test_unknown_name_and_mode_say_the_nearest() -> None:
    with pytest.raises(ProfileError, match="did you mean 'raspberry-pi-5'"):
        load_profile("rasberry-pi-5")
    with pytest.raises(ProfileError, match="no power mode '20W'"):
        load_profile("jetson-orin-nano").mode("20W")


def test_user_directory_comes_first(tmp_path: Path, valid: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, valid | {"title": "mine"}, "raspberry-pi-5")
    write(tmp_path, valid | {"name": "robot-arm"}, "robot-arm")
    monkeypatch.setenv("VLATOOL_PROFILES", f"{tmp_path / 'absent'}:{tmp_path}")
    assert {*SHIPPED, "robot-arm"} <= {*names()}
    assert load_profile("raspberry-pi-5").title == "mine"
    assert load_profile(str(tmp_path / "robot-arm.yaml")).name == "robot-arm"


def test_wheel_layout_comes_before_the_checkout(
    tmp_path: Path, valid: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "_profiles").mkdir()
    write(tmp_path / "_profiles", valid | {"name": "wheeled"}, "wheeled")
    monkeypatch.setattr(module, "__file__", str(tmp_path / "profile.py"))
    monkeypatch.delenv("VLATOOL_PROFILES", raising=False)
    assert names() == ["wheeled"]


def test_each_problem_is_a_readable_line(tmp_path: Path, valid: dict[str, Any]) -> None:
    del valid["price_usd"]
    valid["memory_gb"]["value"] = -8
    valid["bandwidth_gb_s"]["kind"] = "guess"
    valid["bandwith"] = 3
    valid["zzzzzz"] = 3
    valid["power_w"] = 5
    valid["model_strings"] = []
    valid["usable_memory_gb"]["value"] = "much"
    valid["units"]["cpu"]["clock_mhz"]["value"] = float("nan")
    valid["units"]["cpu"]["peak_tops"]["flaot32"] = valid["memory_gb"]
    valid["engines"]["ort_cpu"]["efficiency"]["int8"]["compute"] = 1.5
    text = problems(tmp_path, valid)
    for line in (
        "price_usd: is missing\n",
        "memory_gb.value: must be above 0; got -8\n",
        "bandwidth_gb_s.kind: must be 'vendor', 'measured', 'derived', 'estimate' or 'unverified'; got 'guess'",
        "bandwith: is not a known key; did you mean 'bandwidth'?",
        "zzzzzz: is not a known key",
        "power_w: must be a mapping; got 5",
        "model_strings: needs at least one entry",
        "usable_memory_gb.value: must be a number; got 'much'",
        "units.cpu.clock_mhz.value: must be a finite number; got nan",
        "units.cpu.peak_tops.flaot32: is not a dtype; did you mean 'float32'?",
        "engines.ort_cpu.efficiency.int8.compute: must be less than or equal to 1; got 1.5",
    ):
        assert line in text
    assert "pydantic" not in text
    assert "input_value" not in text


def test_references_inside_a_profile_must_exist(tmp_path: Path, valid: dict[str, Any]) -> None:
    valid["memory_gb"]["source"] = "geerlin"
    valid["default_mode"] = "fast"
    valid["usable_memory_gb"]["value"] = 9
    valid["engines"]["second"] = valid["engines"]["ort_cpu"] | {"unit": "gpu"}
    valid["engines"]["third"] = valid["engines"]["ort_cpu"] | {
        "efficiency": {"int4": valid["engines"]["ort_cpu"]["efficiency"]["int8"]}
    }
    valid["modes"]["default"]["cores"]["npu"] = 1
    text = problems(tmp_path, valid)
    assert "memory_gb.source: 'geerlin' is not in sources; did you mean 'geerling'?" in text
    assert "default_mode: 'fast' is not in modes" in text
    assert "usable_memory_gb.value: is more than memory_gb" in text
    assert "engines.second.unit: 'gpu' is not in units" in text
    assert "engines.third.efficiency.int4: cpu has no peak_tops.int4" in text
    assert "modes.default: 'npu' is not in units" in text


@pytest.mark.parametrize(
    ("content", "words"), [("- a\n- b\n", "must be a mapping; got list"), ("a: [1", "not valid YAML"), ("", "NoneType")]
)
def test_what_is_no_profile_is_refused(tmp_path: Path, content: str, words: str) -> None:
    assert words in problems(tmp_path, content)


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="cannot be read: No such file"):
        load_profile(tmp_path / "absent.yaml")
    (tmp_path / "folder.yaml").mkdir()
    with pytest.raises(ProfileError, match="cannot be read"):
        load_profile(tmp_path / "folder.yaml")
    (tmp_path / "bytes.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ProfileError, match="not valid YAML"):
        load_profile(tmp_path / "bytes.yaml")


def test_profiles_are_frozen() -> None:
    found = load_profile("raspberry-pi-5")
    assert isinstance(found, Profile)
    with pytest.raises(ValueError, match="frozen"):
        found.title = "other"  # type: ignore[misc]


def test_listing_and_reading_load_no_inference_library() -> None:
    code = (
        "import sys; from vlatool.profile import names, load_profile; [load_profile(name) for name in names()]; "
        "print(sorted({'torch', 'onnx', 'onnxruntime'} & {*sys.modules}))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
