from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
from _examined import found as examined
from _examined import of, of_bundles

from vlatool.bundle.bundle import Bundle
from vlatool.gate.claims import memory
from vlatool.gate.claims.memory import Memory
from vlatool.gate.claims.size import Size
from vlatool.report import Measurement


@pytest.mark.parametrize(
    ("mine", "margin", "verdict"), [(110, 0.1, "pass"), (111, 0.1, "fail"), (50, 0.0, "pass"), (100, 0.0, "pass")]
)
def test_growth_up_to_the_margin_passes(mine: float, margin: float, verdict: str) -> None:
    claim = Memory(margin=margin)
    found = of("memory", claim.judge(Measurement("peak_rss", mine, "MB"), 100.0), claim)
    assert found.verdict == verdict
    assert found.sentence == f"{mine:.1f} MB, the baseline 100.0 MB ({mine - 100:+.1f}%; allowed: {margin:+.1%})"


def test_the_size_is_that_of_graphs_and_assets(float_bundle: Bundle, int8_bundle: Bundle) -> None:
    names = ("graphs/main.onnx", "assets/statistics.json", "assets/vocabulary.json")
    sizes = [sum((bundle.path / name).stat().st_size for name in names) / 1e6 for bundle in (float_bundle, int8_bundle)]
    found = examined(Size(margin=10), candidate=int8_bundle, baseline=float_bundle)
    assert found.measurements[0].value == pytest.approx(sizes[1])
    assert found.verdict == "pass"
    assert examined(Size(margin=0), candidate=float_bundle, baseline=float_bundle).verdict == "pass"


@pytest.mark.parametrize("place", ["graphs/more.bin", "assets/more.bin", "data/more.bin", "reports/more.json"])
def test_a_file_counts_wherever_it_lies_and_whoever_lists_it(float_bundle: Bundle, copied, place: str) -> None:
    larger = copied(float_bundle)
    (larger.path / place).parent.mkdir(exist_ok=True)
    (larger.path / place).write_bytes(bytes(1_000_000))
    found = examined(Size(margin=0.1), candidate=larger, baseline=float_bundle)
    assert found.verdict == "fail"
    assert found.measurements[0].value - found.baseline[0].value == pytest.approx(1.0)


def test_graphs_may_lie_anywhere_in_a_bundle(float_bundle: Bundle) -> None:
    files = {path.replace("graphs/", "g/"): record for path, record in float_bundle.manifest.files.items()}
    files["g/main.onnx.data"] = replace(files["g/main.onnx"], bytes=1000)
    files["g/weights.data"] = replace(files["g/main.onnx"], bytes=70)
    graphs = {"main": replace(float_bundle.manifest.graphs["main"], file="g/main.onnx")}
    moved = replace(float_bundle, manifest=replace(float_bundle.manifest, files=files, graphs=graphs))
    assert moved.graph_bytes == float_bundle.graph_bytes + 1070 > 1070


def test_graphs_beside_the_manifest_are_counted_alone(float_bundle: Bundle) -> None:
    files = {path.removeprefix("graphs/"): record for path, record in float_bundle.manifest.files.items()}
    graphs = {"main": replace(float_bundle.manifest.graphs["main"], file="main.onnx")}
    moved = replace(float_bundle, manifest=replace(float_bundle.manifest, files=files, graphs=graphs))
    assert moved.graph_bytes == float_bundle.graph_bytes == files["main.onnx"].bytes


def test_the_memory_is_that_of_fresh_processes(
    float_bundle: Bundle, int8_bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def probed(path, engine, threads, timeout, observations):
        assert observations.is_file(), "beside the golden one"
        asked.append((path, threads, timeout))
        return SimpleNamespace(peak_rss_mb=90.0 if path == float_bundle.path else 120.0 + len(asked))

    monkeypatch.setattr(memory, "cold_start", probed)
    found = of_bundles(int8_bundle, float_bundle, Memory(margin=0.1), threads=2, timeout=60)
    assert (found.verdict, found.measurements[0].value) == ("fail", 123.0)
    assert asked == [(path, 2, 60) for _ in range(3) for path in (int8_bundle.path, float_bundle.path)]


def test_a_bundle_takes_as_much_as_itself(float_bundle: Bundle) -> None:
    found = of_bundles(float_bundle, float_bundle, Memory(margin=0.5))
    assert found.verdict == "pass"
    assert found.measurements[0].value > 10
