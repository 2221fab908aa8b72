from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import BaseModel

from vlatool.errors import OutputError, ProfileError
from vlatool.hardware import profile as module
from vlatool.hardware.profile import Profile, copy_profile, load_profile, profile_names

SHIPPED = (
    "a100-80gb", "h100-80gb", "intel-nuc-12-pro", "intel-nuc-13-pro", "intel-nuc-14-pro", "jetson-agx-orin-32gb",
    "jetson-agx-orin-64gb", "jetson-agx-thor", "jetson-nano", "jetson-orin-nano", "jetson-orin-nano-4gb",
    "jetson-orin-nano-original", "jetson-orin-nx-16gb", "jetson-orin-nx-8gb", "jetson-t4000", "jetson-xavier-nx",
    "raspberry-pi-4", "raspberry-pi-5", "raspberry-pi-5-hailo8", "raspberry-pi-5-hailo8l", "rtx-4060-laptop",
    "rtx-4060-pc", "rtx-4090-pc",
)  # fmt: skip
ORIN = [name for name in SHIPPED if "orin" in name]
HEADLINES = {67, 40, 100, 117, 157, 200, 275, 1035, 1200, 2070, 3958}
"""What vendors print in 10^12 operations per second, with 2:4 sparsity; half of each is dense."""


@pytest.fixture
def valid() -> dict[str, Any]:
    path = Path(module.__file__).parents[2] / "profiles" / "raspberry-pi-5.yaml"
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


def unit_names(profile: Profile) -> list[str]:
    return [*profile.units, *(unit for mode in profile.modes.values() for unit in (*mode.cores, *mode.clock_mhz))]


def test_the_shipped_profiles_are_these() -> None:
    assert profile_names() == sorted(SHIPPED)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_profiles_are_sound(name: str) -> None:
    found = load_profile(name)
    assert found.name == name in profile_names()
    assert len(figures(found)) > 14
    for text in found.sources.values():
        assert not re.search(r"(^|[\s(\"'])(~|/work|/home|/root|/tmp|/mnt|/usr|file:|[A-Z]:\\)", text), text
        assert len(text) > 10
    for unit in found.units.values():
        assert not {*unit.isa} & {*unit.absent}
    assert found.mode().bandwidth_gb_s <= found.bandwidth_gb_s.value
    assert max(mode.bandwidth_gb_s for mode in found.modes.values()) == found.bandwidth_gb_s.value
    assert found.usable_memory_gb.value < found.memory_gb.value
    assert not {*unit_names(found)} - {"cpu", "gpu", "npu"}
    assert {figure.source for figure in figures(found)} == {*found.sources}, "a source that nothing cites"


def test_unverified_figures_are_marked() -> None:
    kinds = {figure.kind for name in SHIPPED for figure in figures(load_profile(name)) if figure.source == "recalled"}
    assert kinds == {"unverified"}


@pytest.mark.parametrize("name", SHIPPED)
def test_no_peak_is_a_headline_that_counts_sparsity(name: str) -> None:
    for unit in load_profile(name).units.values():
        for dtype, peak in unit.peak_tops.items():
            dense = name == "jetson-agx-thor" and dtype == "float4"  # 2070 sparse is 1035 dense
            assert dense or dtype == "float32" or not any(abs(peak.value - headline) < 0.5 for headline in HEADLINES), (
                dtype,
                peak,
            )


@pytest.mark.parametrize("name", SHIPPED)
def test_narrower_types_are_not_slower_and_at_most_twice_as_fast(name: str) -> None:
    for kind, unit in load_profile(name).units.items():
        peaks = {dtype: peak.value for dtype, peak in unit.peak_tops.items()}
        for wide, narrow in () if kind == "cpu" else (("float16", "int8"), ("float16", "float8"), ("float8", "float4")):
            if {wide, narrow} <= {*peaks}:
                assert 0.9 <= peaks[narrow] / peaks[wide] <= 2.1, (wide, narrow)
        assert not {*peaks} & {*unit.absent}, "a peak of what is not there"


@pytest.mark.parametrize("name", SHIPPED)
def test_engines_rest_on_a_runtime_that_was_published(name: str) -> None:
    from vlatool.latency_model.published_latencies import RUNTIMES

    profile = load_profile(name)
    for engine in profile.engines.values():
        assert engine.runtime in {"", *(known for _, known in RUNTIMES)}
        assert len({*engine.dtypes}) == len(engine.dtypes)
    assert profile.engine in ("ort_cpu", "openvino", "ort_tensorrt", "ort_cuda"), "one that vlatool has"


@pytest.mark.parametrize("name", SHIPPED)
def test_platforms_of_a_profile_exist(name: str) -> None:
    from vlatool.hardware.platforms import platform_names

    assert {*load_profile(name).platforms} <= {*platform_names()}


@pytest.mark.parametrize("name", SHIPPED)
def test_a_mode_caps_and_never_raises(name: str) -> None:
    profile = load_profile(name)
    for mode_name, mode in profile.modes.items():
        for unit, part in profile.units.items():
            assert mode.cores.get(unit, 0) <= part.cores.value, mode_name
            assert mode.clock_mhz.get(unit, 0) <= part.clock_mhz.value * 1.01, mode_name
        assert mode.power_w is None or mode.power_w <= profile.power_w.value * 1.01, mode_name


def test_h100_is_dense() -> None:
    peaks = load_profile("h100-80gb").units["gpu"].peak_tops
    assert peaks["float16"].value == pytest.approx(989.4)
    assert peaks["float8"].value == pytest.approx(2 * peaks["float16"].value, rel=1e-3)


def test_thor_is_dense_and_large() -> None:
    thor, small = load_profile("jetson-agx-thor"), load_profile("jetson-t4000")
    assert (thor.memory_gb.value, small.memory_gb.value) == (128, 64)
    assert (thor.units["gpu"].cores.value, small.units["gpu"].cores.value) == (20, 12)
    assert thor.units["gpu"].peak_tops["float8"].value < 600
    assert small.units["gpu"].peak_tops["float8"].value < 350
    assert thor.bandwidth_gb_s.value == 273


@pytest.mark.parametrize("name", ORIN)
def test_orin_has_neither_float8_nor_float4(name: str) -> None:
    gpu = load_profile(name).units["gpu"]
    assert not {"float8", "float4"} & {*gpu.peak_tops}
    assert {"float8", "float4"} <= {*gpu.absent}
    assert not any({"float8", "float4"} & {*engine.dtypes} for engine in load_profile(name).engines.values())


def test_the_oldest_jetson_has_no_int8_on_its_gpu() -> None:
    nano = load_profile("jetson-nano")
    assert "int8" in nano.units["gpu"].absent
    assert "int8" not in nano.units["gpu"].peak_tops
    for engine in nano.engines.values():
        assert engine.unit == "cpu" or ("int8" not in engine.dtypes and engine.int8_layout == "")


@pytest.mark.parametrize("name", [name for name in SHIPPED if "nuc" in name])
def test_nucs_have_a_gpu_and_no_avx512(name: str) -> None:
    nuc = load_profile(name)
    assert "gpu" in nuc.units
    assert not [feature for feature in nuc.units["cpu"].isa if feature.startswith(("avx512", "amx"))]
    assert {"avx512f", "amx_int8"} <= {*nuc.units["cpu"].absent}


def test_an_older_pi_has_no_dot_product() -> None:
    cpu = load_profile("raspberry-pi-4").units["cpu"]
    assert "asimddp" not in cpu.isa
    assert {"asimddp", "asimdhp"} <= {*cpu.absent}
    assert cpu.peak_tops["int8"].value <= 2 * cpu.peak_tops["float32"].value
    assert "float16" not in cpu.peak_tops


def test_only_rented_machines_have_a_price_for_an_hour() -> None:
    rented = {name for name in SHIPPED if load_profile(name).price_usd_per_hour}
    assert rented == {"a100-80gb", "h100-80gb"}


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
    assert {*SHIPPED, "robot-arm"} <= {*profile_names()}
    assert load_profile("raspberry-pi-5").title == "mine"
    assert load_profile(str(tmp_path / "robot-arm.yaml")).name == "robot-arm"


def test_wheel_layout_comes_before_the_checkout(
    tmp_path: Path, valid: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "_profiles").mkdir()
    write(tmp_path / "_profiles", valid | {"name": "wheeled"}, "wheeled")
    monkeypatch.setattr(module, "__file__", str(tmp_path / "hardware/profile.py"))
    monkeypatch.delenv("VLATOOL_PROFILES", raising=False)
    assert profile_names() == ["wheeled"]


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
    valid["engines"]["ort_cpu"]["efficiency"] = {}
    valid["engines"]["ort_cpu"]["dtypes"] = ["int8", "itn8"]
    release = {"release": "1", "os": "Linux", "kind": "vendor", "source": "geerling"}
    valid["software"] = [release | {"python": "3.x"}, release | {"python": 3.1}]
    text = problems(tmp_path, valid)
    for line in (
        "price_usd: is missing\n",
        "memory_gb.value: must be above 0; got -8\n",
        "bandwidth_gb_s.kind: must be 'vendor', 'measured', 'derived', 'estimate' or 'unverified'; got 'guess'",
        "bandwith: is not a known key; did you mean 'bandwidth_gb_s'?",
        "zzzzzz: is not a known key",
        "power_w: must be a mapping; got 5",
        "model_strings: needs at least one entry",
        "usable_memory_gb.value: must be a number; got 'much'",
        "units.cpu.clock_mhz.value: must be a finite number; got nan",
        "units.cpu.peak_tops.flaot32: is not a dtype; did you mean 'float32'?",
        "engines.ort_cpu.efficiency: is not a known key",
        "engines.ort_cpu.dtypes.1: is not what an engine computes in; did you mean 'int8'?",
        "software.0.python: must be a version like '3.10'; got '3.x'",
        "software.1.python: must be a valid string; got 3.1",
    ):
        assert line in text
    assert "pydantic" not in text
    assert "input_value" not in text


def test_references_inside_a_profile_must_exist(tmp_path: Path, valid: dict[str, Any]) -> None:
    valid["memory_gb"]["source"] = "geerlin"
    valid["default_mode"] = "fast"
    valid["usable_memory_gb"]["value"] = 9
    valid["engines"]["second"] = valid["engines"]["ort_cpu"] | {"unit": "gpu"}
    valid["engines"]["third"] = valid["engines"]["ort_cpu"] | {"dtypes": ["float8", "w4", "int8"]}
    valid["modes"]["default"]["cores"]["npu"] = 1
    text = problems(tmp_path, valid)
    assert "memory_gb.source: 'geerlin' is not in sources; did you mean 'geerling'?" in text
    assert "default_mode: 'fast' is not in modes" in text
    assert "usable_memory_gb.value: is more than memory_gb" in text
    assert "engines.second.unit: 'gpu' is not in units" in text
    assert "engines.third.dtypes: cpu has no peak_tops.float8" in text
    assert "peak_tops.w4" not in text, "weights alone in few bits need no peak of their own"
    assert "modes.default: 'npu' is not in units" in text


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("- a\n- b\n", "must be a mapping; got list"),
        ("a: [1", "not valid YAML"),
        ("", "is empty; it must be a mapping"),
    ],
)
def test_what_is_no_profile_is_refused(tmp_path: Path, content: str, words: str) -> None:
    assert words in problems(tmp_path, content)


@pytest.mark.parametrize("truth", [True, False])
def test_a_truth_value_is_no_number(tmp_path: Path, valid: dict[str, Any], truth: bool) -> None:
    valid["memory_gb"]["value"] = truth
    valid["price_usd"]["year"] = truth
    valid["memory_options_gb"] = [2, truth]
    valid["modes"]["default"]["cores"]["cpu"] = truth
    valid["modes"]["default"]["bandwidth_gb_s"] = truth
    text = problems(tmp_path, valid)
    for field in (
        "memory_gb.value", "price_usd.year", "memory_options_gb", "modes.default.cores", "modes.default.bandwidth_gb_s"
    ):  # fmt: skip
        assert f"  {field}: must be a number, not a truth value; got " in text


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="cannot be read: No such file"):
        load_profile(tmp_path / "absent.yaml")
    (tmp_path / "folder.yaml").mkdir()
    with pytest.raises(ProfileError, match="cannot be read"):
        load_profile(tmp_path / "folder.yaml")
    (tmp_path / "bytes.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ProfileError, match="not valid YAML"):
        load_profile(tmp_path / "bytes.yaml")


@pytest.mark.parametrize("like", ["raspberry-pi-5", "jetson-orin-nano"])
def test_a_copy_is_the_same_board_under_another_name(like: str, tmp_path: Path) -> None:
    copy_profile(like, "robot-arm-2", tmp_path / "mine.yaml")
    made = load_profile(tmp_path / "mine.yaml")
    assert made.name == "robot-arm-2"
    assert made == load_profile(like).model_copy(update={"name": "robot-arm-2", "aliases": ()})


def test_a_copy_of_a_file_of_ones_own(tmp_path: Path, valid: dict[str, Any]) -> None:
    copy_profile(str(write(tmp_path, valid)), "other", tmp_path / "other.yaml")
    assert load_profile(tmp_path / "other.yaml").name == "other"


@pytest.mark.parametrize("name", ["Robot", "my board", "", "-x", "a/b", "../x", "a\n"])
def test_a_copy_needs_a_good_name(name: str, tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="is not a valid profile name"):
        copy_profile("raspberry-pi-5", name, tmp_path / "mine.yaml")
    assert not (tmp_path / "mine.yaml").exists()


def test_a_copy_replaces_a_file_only_when_told(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("precious")
    with pytest.raises(OutputError, match="exists"):
        copy_profile("raspberry-pi-5", "mine", tmp_path / "mine.yaml")
    assert (tmp_path / "mine.yaml").read_text() == "precious"
    with pytest.raises(OutputError, match="was not written by vlatool, or was changed since"):
        copy_profile("raspberry-pi-5", "mine", tmp_path / "mine.yaml", force=True)
    assert (tmp_path / "mine.yaml").read_text() == "precious"
    with pytest.raises(OutputError, match="cannot be written: Is a directory"):
        copy_profile("raspberry-pi-5", "mine", tmp_path, force=True)


def test_a_copy_that_nobody_changed_is_replaced_when_told(tmp_path: Path) -> None:
    copy_profile("raspberry-pi-5", "first", tmp_path / "mine.yaml")
    copy_profile(str(tmp_path / "mine.yaml"), "mine", tmp_path / "mine.yaml", force=True)
    assert load_profile(tmp_path / "mine.yaml").name == "mine"
    assert (tmp_path / "mine.yaml").read_text().count("written by vlatool") == 1
    with (tmp_path / "mine.yaml").open("a") as stream:
        stream.write("# measured by me\n")
    with pytest.raises(OutputError, match="was changed since"):
        copy_profile("raspberry-pi-5", "mine", tmp_path / "mine.yaml", force=True)


def test_profiles_are_frozen() -> None:
    found = load_profile("raspberry-pi-5")
    assert isinstance(found, Profile)
    with pytest.raises(ValueError, match="frozen"):
        found.title = "other"  # type: ignore[misc]


def test_listing_and_reading_load_no_inference_library() -> None:
    code = (
        "import sys; from vlatool.hardware.profile import load_profile, profile_names; "
        "[load_profile(name) for name in profile_names()]; "
        "print(sorted({'torch', 'onnx', 'onnxruntime'} & {*sys.modules}))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize(("typed", "board"), [
    ("thor", "jetson-agx-thor"), ("orin-nano", "jetson-orin-nano"), ("agx-orin", "jetson-agx-orin-64gb"),
    ("jetson-agx-orin", "jetson-agx-orin-64gb"), ("nuc", "intel-nuc-13-pro"), ("pi5", "raspberry-pi-5"),
    ("pi-5", "raspberry-pi-5"), ("rpi5", "raspberry-pi-5"), ("Raspberry Pi 5", "raspberry-pi-5"),
    ("Jetson_Orin_Nano", "jetson-orin-nano"), ("orin-nx", "jetson-orin-nx-16gb"), ("rpi4", "raspberry-pi-4"),
])  # fmt: skip
def test_a_board_has_other_names(typed: str, board: str) -> None:
    assert load_profile(typed).name == board


def test_no_two_boards_have_one_name() -> None:
    listed = [alias for name in profile_names() for alias in (name, *load_profile(name).aliases)]
    assert len(listed) == len(set(listed))


@pytest.mark.parametrize(("typed", "board"), [
    ("jetson-agx-orinn", "jetson-agx-orin-64gb"), ("rpi-55", "raspberry-pi-5"),
])  # fmt: skip
def test_a_suggestion_is_the_board_that_has_the_nearest_name(typed: str, board: str) -> None:
    with pytest.raises(ProfileError, match=f"did you mean '{board}'"):
        load_profile(typed)


def test_a_copy_does_not_take_the_other_names(tmp_path: Path) -> None:
    copy_profile("pi5", "my-board", tmp_path / "my-board.yaml")
    assert load_profile(tmp_path / "my-board.yaml").aliases == ()


def test_a_users_profile_may_have_the_name_that_a_board_goes_by(
    tmp_path: Path, valid: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path, valid | {"name": "thor"}, "thor")
    monkeypatch.setenv("VLATOOL_PROFILES", str(tmp_path))
    assert load_profile("thor").name == "thor"


@pytest.mark.parametrize("aliases", [
    "aliases: [one, two]\n", "aliases:\n  - one\n  - two\n", "aliases:\n- one\n", "aliases: [\n  one,\n  two,\n]\n",
])  # fmt: skip
def test_a_copy_has_no_other_names(aliases: str, tmp_path: Path, valid: dict[str, Any]) -> None:
    path = write(tmp_path, {key: value for key, value in valid.items() if key != "aliases"})
    path.write_text(aliases + path.read_text())
    assert load_profile(path).aliases
    copy_profile(str(path), "mine", tmp_path / "copied.yaml")
    wanted = load_profile(path).model_copy(update={"name": "mine", "aliases": ()})
    assert load_profile(tmp_path / "copied.yaml") == wanted
