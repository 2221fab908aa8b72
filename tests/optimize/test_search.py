"""The search: variants, mixed plans, resuming, and what it never does."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from _arithmetic import full_range_or_less

from vlatool.bundle.bundle import Bundle
from vlatool.hardware.profile import load_profile
from vlatool.machine import target
from vlatool.machine.target import target_of
from vlatool.optimize import search as search_module
from vlatool.optimize.budget import Budget
from vlatool.optimize.plan import transforms
from vlatool.optimize.recipe import Limits
from vlatool.optimize.search import Search, Trial, variants_for
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.runtime.engines.openvino import BF16
from vlatool.sensitivity.layers import LayerError
from vlatool.stage.base import Context
from vlatool.stage.run import cached_transform

BAD = ({"quantize.static_int8": {"samples": 1, "method": "percentile", "percentile": 60, "per_channel": False}},)


@pytest.fixture
def search(float_bundle, tmp_path):
    """A function that begins a search, in a cache of the test's own unless it names another."""

    def start(profile: str | None = "raspberry-pi-5", cache: Path = tmp_path, **limits) -> Search:
        given = limits or {"metric": "relative_error", "max_metric": 0.1}
        return Search(float_bundle, Limits(**given), load_profile(profile) if profile else None, cache, Context())

    return start


@pytest.fixture(scope="session")
def shared_cache(tmp_path_factory) -> Path:
    """A cache of the searches that ask what is chosen, not what is made."""
    return tmp_path_factory.mktemp("searches")


def test_a_board_with_onnx_runtime_alone_gets_its_variants() -> None:
    assert set(variants_for(load_profile("raspberry-pi-5"), calibrated=True)) == {
        "dynamic_int8",
        "static_int8",
        "static_int8_mse",
        "static_int8_attention",
        "static_int8_elementwise",
    }
    assert set(variants_for(load_profile("raspberry-pi-5"), calibrated=False)) == {"dynamic_int8"}


def test_bfloat16_is_tried_only_where_the_processor_has_it() -> None:
    nuc = variants_for(load_profile("intel-nuc-13-pro"), calibrated=True)
    assert "openvino_int8" in nuc
    assert "openvino_bf16" not in nuc
    assert not target_of(load_profile("intel-nuc-13-pro")).has(*BF16)


def test_convolutions_are_tried_only_where_the_processor_has_matrix_units(monkeypatch: pytest.MonkeyPatch) -> None:
    def options(*features: str) -> list[dict[str, Any]]:
        monkeypatch.setattr(target, "isa", lambda: features)
        return [each for (stage,) in variants_for(None, calibrated=True).values() for each in stage.values()]

    assert not any("convolutions" in each for each in options("avx512_vnni", "avx512_bf16"))
    with_amx = options("amx_tile", "amx_bf16", "amx_int8")
    assert {"layout": "openvino", "compute": "bfloat16"} in with_amx, "the same without convolutions races, too"
    assert {"layout": "openvino", "compute": "bfloat16", "convolutions": True, "attention": True} in with_amx
    assert {"convolutions": True} in [each for (stage,) in variants_for(None, calibrated=False).values()
                                      for each in stage.values()]  # fmt: skip


def test_a_plan_with_the_graphs_of_another_one_is_not_tried_again(search) -> None:
    run = search(metric="relative_error", max_metric=0.5)
    stages = ({"quantize.static_int8": {}},)
    first, again = run._try("first", stages), run._try("again", stages)
    assert first.speedup > 0
    assert (again.speedup, again.note) == (0.0, "It has the graphs of first.")
    assert run._try("first", stages).speedup > 0


def test_every_variant_can_be_built_as_stages() -> None:
    for stages in variants_for(None, calibrated=True).values():
        assert len(transforms(stages)) == 1


def test_every_plan_is_tried_and_the_fastest_inside_join(search, shared_cache) -> None:
    run = search(cache=shared_cache, metric="relative_error", max_metric=0.5)
    found = run.run({"static_int8": ({"quantize.static_int8": {}},)})
    assert {trial.name for trial in run.trials} >= {"static_int8", "static_int8_mse", "dynamic_int8"}
    assert all(trial.speedup > 0 and math.isfinite(trial.error) for trial in run.trials)
    assert "static_int8" not in found
    table = run.tables()["Plans tried by the search"]
    assert len(table) == len(run.trials)


def test_a_plan_that_cannot_be_made_is_a_trial_that_says_why(search) -> None:
    run = search()
    trial = run._try("lost", ({"quantize.static_int8": {"include": ["nothing_like_it"]}},))
    assert trial.speedup == 0
    assert "nothing_like_it" in trial.note
    assert not trial.within


@pytest.mark.filterwarnings("ignore:ranges from")
def test_a_bad_plan_is_mended_by_leaving_layers_in_float(search) -> None:
    run = search(metric="relative_error", max_metric=1.0)
    bad = run._try("bad", BAD)
    assert bad.error > 0.02
    run.budget = Budget("relative_error", 0.6 * bad.error)
    run._mix(bad, transforms(BAD)[-1])
    mixed = [trial for trial in run.trials if "mixed" in trial.name]
    assert mixed
    assert min(trial.error for trial in mixed) < bad.error
    assert any(trial.within for trial in mixed)
    assert all("exclude" in trial.stages[-1]["quantize.static_int8"] for trial in mixed)


def test_when_nothing_is_inside_the_most_accurate_plan_stays(search, shared_cache) -> None:
    run = search(cache=shared_cache, metric="relative_error", max_metric=0.0)
    found = run.run({})
    assert len(found) == 1
    least = min((trial for trial in run.trials if trial.speedup), key=lambda trial: trial.error)
    assert list(found) == [least.name]


def made_at(cache: Path) -> dict[Path, int]:
    """Return when each file of the stages in a cache was written."""
    return {path: path.stat().st_mtime_ns for path in (cache / "stages").rglob("*") if path.is_file()}


@pytest.mark.soak("a search that was interrupted and goes on: test_an_interrupted_search_goes_on_where_it_was")
def test_a_second_search_makes_and_measures_nothing_again(search, shared_cache) -> None:
    search(cache=shared_cache).run({})
    before = made_at(shared_cache)
    assert before
    search(cache=shared_cache).run({})
    assert made_at(shared_cache) == before


def test_an_interrupted_search_goes_on_where_it_was(search, tmp_path) -> None:
    first = search()
    told: list[str] = []

    def stop(what: str, share: float | None) -> None:
        told.append(what)
        if "plan 2" in what:
            raise KeyboardInterrupt

    first.context = Context(stop)
    with pytest.raises(KeyboardInterrupt):
        first.run({})
    kept = made_at(tmp_path)
    assert kept
    search().run({})
    assert made_at(tmp_path).items() >= kept.items()
    assert "of at most" in told[0]


def test_the_estimate_leaves_out_as_many_layers_as_independent_errors_need(search) -> None:
    run = search()
    run.budget = Budget("relative_error", 0.05)
    layers = [
        LayerError(str(index), "main", error, {}, 0.0, 0.0, 0.1) for index, error in enumerate((0.09, 0.03, 0.03))
    ]
    assert run._estimate(layers, 0.1) == 1
    assert run._estimate(layers, 0.05) == 1
    assert run._estimate(layers, 10.0) == 3


def test_finalists_are_the_fastest_inside_and_the_most_accurate(search) -> None:
    run = search()
    run.trials = [
        Trial("a", BAD, 4.0, 0.04, True),
        Trial("b", BAD, 3.9, 0.03, True),
        Trial("c", BAD, 5.0, 0.2, False),
        Trial("d", BAD, 1.5, 0.01, True),
        Trial("e", BAD, 0.5, 0.001, True),
    ]
    assert [trial.name for trial in run._finalists()] == ["a", "b"]
    run.trials.pop()
    assert [trial.name for trial in run._finalists()] == ["a", "b", "d"]


def test_the_plan_of_a_trial_makes_the_bundle_that_was_tried(search, float_bundle: Bundle, tmp_path: Path) -> None:
    run = search(metric="relative_error", max_metric=0.5)
    trial = run._try("static_int8", ({"quantize.static_int8": {"samples": 8}},))
    stage = transforms(trial.stages)[-1]
    assert isinstance(stage, StaticInt8)
    made = cached_transform(stage, float_bundle, tmp_path, Context()).bundle
    assert run._error(made, Context()) == trial.error


@pytest.mark.parametrize(("isa", "tried"), [("[avx2, fma, f16c]", True), ("[avx2, fma, f16c, avx_vnni]", False)])
def test_a_board_without_vnni_also_tries_products_that_do_not_saturate(tmp_path: Path, isa: str, tried: bool) -> None:
    pytest.importorskip("openvino")
    text = (Path(__file__).parents[2] / "profiles/intel-nuc-13-pro.yaml").read_text(encoding="utf-8")
    (tmp_path / "board.yaml").write_text(text.replace("[avx2, fma, f16c, avx_vnni]", isa), encoding="utf-8")
    found = variants_for(load_profile(tmp_path / "board.yaml"), calibrated=True)
    for name, (stage,) in found.items():
        ((_, options),) = stage.items()
        assert options.get("reduce_range", False) is (tried and name != "static_int8_all_bits"), name
    assert "openvino_int8" in found, "int8 is tried, though it may lose"
    assert ("static_int8_all_bits" in found) is tried


@pytest.fixture
def made_of(search, monkeypatch):
    """A search whose plans are as fast and as wrong as a table says of their options."""

    def start(figures: dict[str, tuple[float, float]], budget: float, fastest: float = 1.0) -> Search:
        def fake(self: Search, name: str, stages: Any) -> Trial:
            ((_, options),) = stages[-1].items()
            speedup, error = figures["+".join(sorted(options))]
            self.trials.append(Trial(name, stages, speedup, error, error <= 0.9 * budget, fastest=fastest * speedup))
            return self.trials[-1]

        monkeypatch.setattr(Search, "_try", fake)
        run = search(metric="relative_error", max_metric=budget)
        for options in ({}, {"method": "mse"}, {"attention": True}, {"elementwise": True}):
            ending = "".join(f"_{value if value is not True else key}" for key, value in options.items())
            run._try(f"int8{ending}", ({"quantize.static_int8": options},))
        for base in list(run.trials):
            run._combine(base)
        run._try_methods()
        return run

    return start


ALONE = {"": (2.0, 0.030), "method": (2.0, 0.028), "attention": (2.4, 0.045), "elementwise": (1.5, 0.031)}


def test_options_that_gain_something_alone_are_tried_together(made_of) -> None:
    run = made_of({**ALONE, "attention+method": (2.4, 0.038)}, 0.04)
    assert [trial.name for trial in run.trials[4:]] == ["int8_attention_mse"]
    assert [trial.name for trial in run._finalists()][:1] == ["int8_attention_mse"], "above 0.9 of the budget, below it"
    assert run.trials[1] in run._finalists(), "a plan that is safely inside stays"


def test_what_may_be_as_fast_on_a_busy_machine_is_combined_too(made_of) -> None:
    slower = {**ALONE, "attention": (1.9, 0.038)}
    alone = made_of({**slower, "attention+method": (2.4, 0.036)}, 0.04)
    assert len(alone.trials) == 4, "an option that is certainly slower is left alone"
    unsure = made_of({**slower, "attention+method": (2.4, 0.036)}, 0.04, fastest=1.1)
    assert [trial.name for trial in unsure.trials[4:]][:1] == ["int8_attention_mse"]


def test_of_three_the_one_that_costs_most_is_left_out_again(made_of) -> None:
    three = {**ALONE, "elementwise": (2.2, 0.06), "attention+elementwise+method": (2.8, 0.08)}
    run = made_of({**three, "attention+method": (2.4, 0.038), "elementwise+method": (2.2, 0.05)}, 0.04)
    assert [trial.name for trial in run.trials[4:6]] == ["int8_attention_elementwise_mse", "int8_attention_mse"]


def test_a_way_to_choose_ranges_that_is_no_more_accurate_is_not_combined(made_of) -> None:
    run = made_of({**ALONE, "method": (2.1, 0.031), "attention": (2.1, 0.045)}, 0.04)
    assert len(run.trials) == 4


def test_a_way_to_choose_ranges_is_tried_on_a_fast_plan_though_it_lost_on_a_slow_one(made_of) -> None:
    lost = {**ALONE, "method": (2.0, 0.031)}
    run = made_of({**lost, "attention+method": (2.4, 0.034)}, 0.04)
    assert [trial.name for trial in run.trials[4:]] == ["int8_attention_mse"]
    assert run._finalists()[0].name == "int8_attention_mse"
    worse = made_of({**lost, "elementwise": (2.6, 0.06), "attention+method": (2.4, 0.034),
                     "elementwise+method": (2.6, 0.05), "attention+elementwise": (2.9, 0.09),
                     "attention+elementwise+method": (2.9, 0.08)}, 0.04)  # fmt: skip
    names = [trial.name for trial in worse.trials]
    assert len(names) == len(set(names))
    assert {"int8_attention_mse", "int8_elementwise_mse"} <= set(names)


def test_finalists_reach_a_hair_beyond_the_budget_and_hold_a_plan_inside(search) -> None:
    run = search(metric="relative_error", max_metric=0.1)
    run.trials = [Trial(str(number), BAD, speed, error, error <= 0.09) for number, (speed, error) in enumerate(
        [(4.0, 0.12), (3.9, 0.104), (3.8, 0.099), (3.7, 0.095), (3.0, 0.08), (2.0, 0.02)]
    )]  # fmt: skip
    assert [trial.name for trial in run._finalists()] == ["1", "2", "3", "4", "5"]


def test_engines_that_cannot_be_compared_have_finalists_of_their_own(search) -> None:
    run = search()
    run.trials = [
        Trial("a", BAD, 4.0, 0.04, True, "", "ort_cpu"),
        Trial("b", BAD, 0.7, 0.03, True, "", "openvino"),
        Trial("c", BAD, 0.6, 0.2, False, "", "openvino"),
        Trial("d", BAD, 2.0, 0.05, True, "", "ort_cpu"),
    ]
    assert [trial.name for trial in run._finalists()] == ["a", "b"]
    run._apart = True
    table = run.tables()["Plans tried by the search"]
    assert [(each["plan"], each["against float32 in"]) for each in table] == [
        ("b", "openvino"), ("c", "openvino"), ("a", "ort_cpu"), ("d", "ort_cpu"),
    ]  # fmt: skip


def test_a_plan_is_mended_though_another_engine_is_faster_on_this_host(search, monkeypatch) -> None:
    mended: list[str] = []
    monkeypatch.setattr(Search, "_mix", lambda _self, trial, _stage: mended.append(trial.name))
    for engine, wanted in (("openvino", ["slow"]), ("ort_cpu", [])):
        run = search()
        run.trials = [
            Trial("fast", BAD, 4.0, 0.01, True, "", "ort_cpu"),
            Trial("slow", BAD, 2.0, 0.5, False, "", engine),
        ]
        mended.clear()
        run._repair()
        assert mended == wanted


def test_a_trial_is_timed_against_float32_in_its_own_engine_where_engines_are_apart(search, monkeypatch) -> None:
    pytest.importorskip("openvino")
    seen: dict[str, str] = {}
    measure = search_module.cached_measure

    def watched(stage: Any, *more: Any) -> Any:
        if stage.name() == "benchmark.latency":
            seen[stage.against[0].name.split("-")[0]] = stage.engine
        return measure(stage, *more)

    monkeypatch.setattr(search_module, "cached_measure", watched)
    run = search(metric="relative_error", max_metric=0.5)
    run._apart = True
    own = run._try("own", ({"quantize.dynamic_int8": {}},))
    exact = full_range_or_less()
    other = run._try("other", ({"quantize.static_int8": {"samples": 8, "layout": "openvino", **exact}},))
    assert seen == {"quantize.dynamic_int8": "ort_cpu", "quantize.static_int8": "openvino"}
    assert (own.engine, other.engine) == ("ort_cpu", "openvino")
    assert own.speedup > 0
    assert other.speedup > 0
