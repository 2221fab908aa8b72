from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from _full import small_or_full
from onnx import helper, numpy_helper

from vlatool.boards import answer as select_boards_module
from vlatool.boards.answer import (
    Asked,
    _change,
    carry_count,
    count_workload,
    open_bundle,
    select_boards,
    simulate,
    simulation_lines,
)
from vlatool.boards.simulate import Change
from vlatool.boards.torch_workload import torch_workload
from vlatool.bundle.bundle import Bundle
from vlatool.errors import BundleError, DataError, OutputError, SourceError, UsageError
from vlatool.graph.workload import workload
from vlatool.graph.workload_file import LAYOUT_VERSION, digest, read_workload
from vlatool.hardware.profile import load_profile, profile_names
from vlatool.latency_model.board import Candidate, outcomes
from vlatool.latency_model.model import load_model
from vlatool.machine.host import cache_directory
from vlatool.prune.neurons import Neurons
from vlatool.render.sections.boards import limit_ms
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

SAMPLES = Path(__file__).parents[2] / "sample_models"


@pytest.fixture(autouse=True)
def _apart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("VLATOOL_CALIBRATIONS", str(tmp_path / "kept"))


def kept() -> list[Path]:
    return list((cache_directory() / "workloads").glob("*"))


def test_a_count_is_kept_and_read_again(float_bundle: Bundle) -> None:
    first = count_workload(float_bundle, Context())
    assert first == workload(float_bundle)
    (file,) = kept()
    assert file.suffix == ".json"
    file.write_text(file.read_text().replace('"layers": ', '"layers": 1'))
    assert count_workload(float_bundle, Context()).layers > first.layers, "it was read, not counted"


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"3", b'{"layout": 99}', b'{"layout": 4}', b'{"layout": 4, "graphs": 3, "runs": {}}',
                b'{"layout": 4, "graphs": {"m": {"colour": 1}}, "runs": {}}', b"\xff\xfe"]
)  # fmt: skip
def test_a_damaged_count_is_made_again(float_bundle: Bundle, content: bytes) -> None:
    wanted = count_workload(float_bundle, Context())
    kept()[0].write_bytes(content)
    assert count_workload(float_bundle, Context()) == wanted
    assert json.loads(kept()[0].read_text())["layout"] == LAYOUT_VERSION


def test_a_cache_that_cannot_be_written_costs_time_alone(float_bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VLATOOL_CACHE", "/proc/none")
    assert count_workload(float_bundle, Context()) == workload(float_bundle)


def forget() -> None:
    for file in kept():
        file.unlink()


def test_a_policy_that_carries_its_count_is_not_counted_again(
    policy_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = carry_count(str(policy_dir), Context())
    assert file == policy_dir / "workload.json"
    wanted = count_workload(open_bundle(str(policy_dir), Context()), Context())
    forget()
    monkeypatch.setattr(select_boards_module, "counted_apart", None)
    assert count_workload(open_bundle(str(policy_dir), Context()), Context()) == wanted
    file.write_text(file.read_text().replace('"layers": ', '"layers": 1'))
    assert count_workload(open_bundle(str(policy_dir), Context()), Context()).layers > wanted.layers, "it was read"


@pytest.mark.parametrize("change", ["code", "spec", "damage", "another version"])
def test_a_count_of_something_else_is_made_again(
    change: str, policy_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = carry_count(str(policy_dir), Context())
    wrong = file.read_text().replace('"layers": ', '"layers": 1')
    file.write_text("{" if change == "damage" else wrong)
    forget()
    description = policy_dir / "policy.yaml"
    if change == "code":
        (policy_dir / "policy.py").write_text((policy_dir / "policy.py").read_text() + "\n# edited\n")
    elif change == "spec":
        description.write_text(description.read_text().replace("control_hz: 10", "control_hz: 20"))
    elif change == "another version":
        monkeypatch.setattr("vlatool.graph.workload_file.VERSION", "99")
    bundle = open_bundle(str(policy_dir), Context())
    assert count_workload(bundle, Context()) == torch_workload(bundle)


@pytest.mark.parametrize(
    "change",
    [{"macs": 3}, {"macs": {"float32": "many"}}, {"layers": -1}, {"weights": None}, {"parts": {"head": [1, 2]}}],
)
def test_a_carried_count_with_odd_values_is_made_again(change: dict[str, Any], policy_dir: Path) -> None:
    file = carry_count(str(policy_dir), Context())
    wanted = count_workload(open_bundle(str(policy_dir), Context()), Context())
    forget()
    data = json.loads(file.read_text())
    data["graphs"]["main"] |= change
    file.write_text(json.dumps(data))
    assert count_workload(open_bundle(str(policy_dir), Context()), Context()) == wanted


def test_a_pruned_policy_does_not_take_the_count_of_the_whole_one(policy_dir: Path, tmp_path: Path) -> None:
    carry_count(str(policy_dir), Context())
    whole = open_bundle(str(policy_dir), Context())
    pruned = run_transform(Neurons(ratio=0.5), whole, tmp_path / "pruned", Context()).bundle
    assert count_workload(pruned, Context()) == torch_workload(pruned)
    assert (
        count_workload(pruned, Context()).graphs["main"].weights
        < count_workload(whole, Context()).graphs["main"].weights
    )
    with pytest.raises(UsageError, match="is a bundle; only a policy with code carries a count"):
        carry_count(str(pruned.path), Context())


def test_only_a_policy_with_code_carries_a_count(float_bundle: Bundle, policy_dir: Path) -> None:
    with pytest.raises(UsageError, match="is counted without torch"):
        carry_count(str(float_bundle.path), Context())
    (policy_dir / "workload.json").mkdir()
    with pytest.raises(OutputError, match=r"workload\.json was not written by vlatool"):
        carry_count(str(policy_dir), Context())


@pytest.mark.parametrize("sample", sorted(path.parent.name for path in SAMPLES.glob("*/policy.yaml")))
def test_the_sample_policies_carry_true_counts(sample: str) -> None:
    """After a change of their code: vlatool hwselect sample_models/NAME --carry-count."""
    bundle = open_bundle(str(SAMPLES / sample), Context())
    carried = read_workload(SAMPLES / sample / "workload.json", digest(bundle))
    assert carried is not None, "it is of another code, weights, spec or version"
    assert carried == torch_workload(bundle)


def test_a_policy_and_an_onnx_file_are_opened_as_sources(policy_template: Path, float_bundle: Bundle) -> None:
    assert open_bundle(str(float_bundle.path), Context()).hash == float_bundle.hash
    source = open_bundle(str(policy_template), Context())
    assert not source.manifest.graphs
    assert "factory" in source.manifest.source


def test_a_damaged_bundle_is_not_answered_for(float_bundle: Bundle, copied: Callable[[Bundle], Bundle]) -> None:
    damaged = copied(float_bundle)
    file = damaged.path / "graphs/main.onnx"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.raises(BundleError, match=r"main\.onnx"):
        open_bundle(str(damaged.path), Context())


def test_an_unknown_precision_is_refused_before_anything_is_read() -> None:
    with pytest.raises(UsageError, match="did you mean 'int8'"):
        select_boards("nothing", Asked(precisions=("itn8",)), Context())


def test_the_report_names_the_work_and_what_to_run_next(float_bundle: Bundle) -> None:
    told: list[str] = []
    report = select_boards(
        str(float_bundle.path), Asked(boards=("raspberry-pi-5",), hz=5.0), Context(lambda what, _: told.append(what))
    )
    macs = sum(workload(float_bundle).macs.values())
    assert any(f"main {macs / 1e3:.3g} k multiply-accumulates" in sentence for sentence in report.summary)
    assert not any(sentence.startswith("Next: vlatool optimize ") for sentence in report.summary), "it is a bundle"
    assert any("measure before you buy many" in warning for warning in report.warnings)
    assert told == ["predicting"]


@pytest.mark.parametrize("per_chunk", [False, True])
def test_the_report_tells_what_a_chunk_and_a_tick_cost(per_chunk: bool, float_bundle: Bundle) -> None:
    """The policy gives 4 actions, of which 2 are executed, at 10 Hz."""
    asked = Asked(boards=("raspberry-pi-5",), per_chunk=per_chunk)
    report = select_boards(str(float_bundle.path), asked, Context())
    predicted = {item.name: item.value for item in report.rows[0].measurements}
    for whole, each in (("latency_p50", "latency_per_action"), ("energy", "energy_per_action")):
        assert predicted[each] == pytest.approx(predicted[whole] / 2)
    told = next(each for each in report.summary if "2 actions are executed: with one inference for each chunk" in each)
    assert told.endswith("--per-chunk.") == (not per_chunk)
    assert limit_ms(report) == (200 if per_chunk else 100)


def test_actions_per_chunk_need_a_rate(float_bundle: Bundle) -> None:
    with pytest.raises(UsageError, match="--per-chunk asks how often the loop ticks"):
        select_boards(str(float_bundle.path), Asked(latency_ms=3.0, per_chunk=True), Context())


@pytest.mark.parametrize(("platform", "has"), [("arm", False), ("quadcopter", True)])
def test_a_platform_on_mains_power_has_no_battery_life(platform: str, has: bool, float_bundle: Bundle) -> None:
    asked = Asked(boards=("raspberry-pi-5",), platform=platform, hz=1.0)
    (row,) = select_boards(str(float_bundle.path), asked, Context()).rows
    assert row.get("average_watts", "predicted") is not None
    assert (row.get("battery_life", "predicted") is not None) == has


def tried(board: str, engine: str, precision: str, source: str) -> dict[str, Any] | None:
    """Simulate; None where there is no ground."""
    try:
        return simulate(source, board, None, engine, precision, Context())
    except DataError as error:
        if board in error.message and error.fix:
            return None
        raise


@functools.cache
def turns() -> dict[str, list[str]]:
    """Return board -> the engines that no board before it has, or one of its own, in turn."""
    found: dict[str, list[str]] = {}
    for number, board in enumerate(profile_names()):
        engines = list(load_profile(board).engines)
        new = [engine for engine in engines if not any(engine in each for each in found.values())]
        found[board] = new or [engines[number % len(engines)]]
    return found


@pytest.mark.parametrize("board", profile_names())
def test_a_simulation_is_json_without_nan_or_a_reason(board: str, float_bundle: Bundle) -> None:
    """In an engine of each board, so that every engine has its turn; in each of them in the full form."""
    engines = load_profile(board).engines
    for engine in small_or_full(turns()[board], list(engines)):
        for precision in engines[engine].dtypes:
            found = tried(board, engine, precision, str(float_bundle.path))
            if found is not None:
                json.dumps(found, allow_nan=False)
                assert (found["profile"], found["engine"], found["precision"]) == (board, engine, precision)
                assert len(simulation_lines(found)) > 5


def test_every_engine_has_its_turn() -> None:
    every = {engine for board in profile_names() for engine in load_profile(board).engines}
    assert {engine for engines in turns().values() for engine in engines} == every


def test_a_change_that_cannot_be_predicted_is_json_without_nan(float_bundle: Bundle) -> None:
    load = count_workload(float_bundle, Context())
    way = Candidate(load_profile("raspberry-pi-5-hailo8"), "default", "hailort", "int8")
    outcome = outcomes([way], load, load_model())[0]
    assert not outcome.latency.known
    found = _change(Change("int8 in the place of float32", outcome))
    assert (found["latency_ms"], found["why"]) == (None, outcome.latency.why)
    json.dumps(found, allow_nan=False)


def test_a_graph_with_free_axes_is_refused_with_a_remedy_that_works(tmp_path: Path) -> None:
    model = tmp_path / "free.onnx"
    weight = numpy_helper.from_array(np.ones((4, 2), np.float32), "w")
    given, taken = (helper.make_tensor_value_info(name, 1, (1, "rows", size)) for name, size in (("y", 2), ("x", 4)))
    graph = helper.make_graph([helper.make_node("MatMul", ["x", "w"], ["y"])], "g", [taken], [given], [weight])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=8), model)
    asked = (str(model), "raspberry-pi-5", None, None, "", Context())
    with pytest.raises(SourceError, match="has the free axes rows") as caught:
        simulate(*asked)
    assert "--shape x=1,rows,4" in caught.value.fix
    (tmp_path / "policy.yaml").write_text(
        "name: free\nspec:\n  inputs: [{name: x, shape: [1, 5, 4]}]\n  outputs: [{name: y, shape: [1, 5, 2]}]\n"
        "  control_hz: 10\n  chunk: 5\n"
    )
    assert simulate(*asked)["latency_ms"][0] > 0
