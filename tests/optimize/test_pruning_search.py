"""Trials of pruned policies in ``optimize``, end to end on the tiny policy, through the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.hardware.profile import Profile, load_profile
from vlatool.optimize.plan import make_plan
from vlatool.optimize.pruning_search import PrunedSearch, front_of, with_measured
from vlatool.optimize.recipe import read_recipe
from vlatool.optimize.result import write_recipe
from vlatool.optimize.space import FLOAT32, Shape, Space
from vlatool.optimize.study import Tried
from vlatool.report import Measurement, Report, Row, read_report
from vlatool.stage.base import Context

RECIPE = """\
candidates: {static_int8: [quantize.static_int8: {samples: 8}]}
pruning:
  trials: 2
  episodes: 4
  recover: [distill.policy: {steps: 3, batch: 6, episodes: 0, student_episodes: 0, precision: float32, threads: 1}]
effort: {episodes: 4, iterations: 20}
limits: {max_drop: 1.0, max_distance: 1000, hz: 1000000}
"""
TABLE = "Pruned policies, by trials"


@pytest.fixture
def recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recipe with two trials; stages run without a child of their own."""
    monkeypatch.setattr("vlatool.stage.run.run_in_child", lambda stage, *rest: stage.run(*rest))
    monkeypatch.setattr("vlatool.optimize.pipeline.explanation_in_child", lambda *_, **__: ())  # has tests of its own
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "recipe.yaml"
    path.write_text(RECIPE)
    return path


def optimized(*words: Any) -> int:
    try:
        main(["optimize", *map(str, words)])
    except SystemExit as left:
        return int(left.code or 0)
    return 0


def table_of(report: Report) -> list[dict[str, Any]]:
    chosen = next(row for row in report.rows if row.role == "chosen")
    return list(next(table for title, table in chosen.details.items() if title.startswith(TABLE)))


def test_pruned_policies_are_trained_tried_and_judged_beside_the_others(
    policy_template: Path, recipe: Path, tmp_path: Path
) -> None:
    out, study = tmp_path / "out", tmp_path / "trials.journal"
    words = (policy_template, "--recipe", recipe, "--study", study, "--workers", 1)
    assert optimized(*words, "-o", out) in (1, 5), "the nearest to a rate that nothing reaches"
    report = read_report(out / "reports")
    table = table_of(report)
    assert {each["policy"] for each in table} == {"whole_static_int8", "width70_static_int8"}
    trained = {each["policy"]: each["training"] for each in table}
    assert trained["whole_static_int8"] == ""
    assert trained["width70_static_int8"].endswith(" min")
    assert [each["on the front"] for each in table].count("yes") >= 1
    rows = {row.name: row for row in report.rows}
    assert "width70_static_int8" in rows
    assert rows["width70_static_int8"].get("success_drop") is not None
    assert rows["float32"].role in ("baseline", "chosen")
    again = read_recipe(out / "recipe.yaml")
    assert again.pruning.trials == 0, "what was chosen is made again without trials"


def test_without_episodes_the_error_on_recorded_observations_decides(
    policy_template: Path, float_bundle: Bundle, int8_bundle: Bundle, recipe: Path, tmp_path: Path
) -> None:
    asked = read_recipe(recipe)
    asked = asked.model_copy(update={"effort": asked.effort.model_copy(update={"episodes": 0})})
    plan = make_plan(str(policy_template), None, asked, tmp_path / "cache")
    search = PrunedSearch(plan, float_bundle, float_bundle, Context())
    drop, _ = search._judged(int8_bundle)
    assert 0 < drop < 0.2
    assert search._describe_drop(drop) == f"{drop:.4g}"
    assert search._describe_drop(float("inf")) == ""


@pytest.mark.parametrize(
    ("words", "pruning", "code", "said"),
    [
        (["--study", "trials"], "trials: 0", 3, "none are asked for"),
        (["--trials", "-1"], "trials: 1", 2, "greater than or equal to 0"),
        (["--trials", "many"], "trials: 1", 2, "valid integer"),
        (["--train-steps", "0"], "trials: 1", 2, "greater than or equal to 1"),
        (["--train-steps", "5"], "{trials: 1, recover: [quantize.qat: {}]}", 2, "--train-steps is of distill.policy"),
        ([], "{trials: 1, recover: [export.onnx: {}]}", 3, "names what trains a pruned policy; got export.onnx"),
        ([], "{trials: 1, recover: []}", 3, "got nothing"),
        ([], "{trials: 1, recover: [distill.police: {}]}", 3, "distill.police"),
        ([], "{trials: 1, recover: [distill.policy: {step: 3}]}", 3, "step"),
        ([], "{trials: -1}", 3, "pruning.trials"),
        ([], "{trials: .nan}", 3, "pruning.trials"),
        ([], "{least: 1.5}", 3, "pruning.least"),
        ([], "{episodes: 0}", 3, "pruning.episodes"),
        ([], "{tirals: 3}", 3, "tirals"),
        ([], "7", 3, "pruning"),
        (["--trials", "2", "--study", " "], "trials: 1", 2, "--study names no place"),
        (["--trials", "2", "--study", "nothing://here"], "trials: 1", 2, "not the address of a known kind of database"),
        (["--trials", "2", "--study", "sqlite:////proc/none/x.db"], "trials: 1", 2, "a folder that does not exist"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)  # fmt: skip
def test_wrong_inputs_are_named_and_leave_nothing(
    policy_template: Path, recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    words: list[str], pruning: str, code: int, said: str,
) -> None:  # fmt: skip
    head, _, rest = RECIPE.partition("pruning:\n")
    recipe.write_text(
        f"{head}pruning: {pruning if pruning[0] in '{7' else '{' + pruning + '}'}\n{rest[rest.index('effort') :]}"
    )
    out = tmp_path / "out"
    assert optimized(policy_template, "--recipe", recipe, "--workers", 1, *words, "-o", out) == code
    assert said in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


def test_an_exported_policy_has_nothing_to_prune(
    onnx_file: Path, recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert optimized(onnx_file, "--recipe", recipe, "-o", tmp_path / "out") == 3
    assert "no modules that could be pruned" in " ".join(capsys.readouterr().err.split())


def test_the_plan_tells_of_the_trials(
    policy_template: Path, recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (policy_template, "--recipe", recipe, "--trials", 5, "--dry-run", "-o", tmp_path / "out")
    assert optimized(*words) == 0
    assert "5 policies, pruned, trained (distill.policy" in capsys.readouterr().out
    assert optimized(*words, "--json") == 0
    assert json.loads(capsys.readouterr().out)["plan"]["pruning"]["trials"] == 5


def test_passwords_and_places_of_studies_stay_here(
    policy_template: Path, float_bundle: Bundle, recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url = "sqlite://me:secret@host/trials"
    words = (policy_template, "--recipe", recipe, "--study", url, "--dry-run", "-o", tmp_path / "out")
    for more in ((), ("--json",)):
        assert optimized(*words, *more) == 0
        said = capsys.readouterr().out
        assert "secret" not in said
        assert "sqlite://me:***@host/trials" in said
    asked = read_recipe(recipe)
    asked = asked.model_copy(update={"pruning": asked.pruning.model_copy(update={"study": url})})
    write_recipe(asked, asked.candidates, "float32", tmp_path)
    written = (tmp_path / "recipe.yaml").read_text()
    assert "trials: 2" in written
    assert "sqlite" not in written


def test_only_trials_that_may_be_compared_share_a_study(
    policy_template: Path, float_bundle: Bundle, recipe: Path, tmp_path: Path
) -> None:
    asked = read_recipe(recipe)

    def named(profile: Profile | None = None, **changes: Any) -> str:
        plan = make_plan(str(policy_template), profile, asked.model_copy(update=changes), tmp_path / "cache")
        return PrunedSearch(plan, float_bundle, float_bundle, Context())._name()

    pruning, effort = asked.pruning, asked.effort
    assert named() == named(pruning=pruning.model_copy(update={"trials": 9, "study": "elsewhere", "seed": 3}))
    others = {
        named(load_profile("raspberry-pi-5")),
        named(effort=effort.model_copy(update={"episodes": 0})),
        named(pruning=pruning.model_copy(update={"episodes": 5})),
        named(limits=asked.limits.model_copy(update={"max_drop": 0.5})),
    }
    assert len({named(), *others}) == 5


def _tried(speedup: float, drop: float, width: float = 0.55) -> Tried:
    return Tried(Shape(width, 1, 1, FLOAT32), speedup, drop)


def test_the_front_is_what_no_other_beats_in_both() -> None:
    slow, fast, beaten, even = _tried(1, 0), _tried(4, 0.02), _tried(2, 0.03), _tried(4, 0.02, 0.7)
    failed = Tried(Shape(0.4, 1, 1, FLOAT32), note="no")
    assert front_of([slow, fast, beaten, failed, even]) == [slow, fast, even]


def test_what_moves_well_is_judged_before_what_is_faster(
    policy_template: Path, float_bundle: Bundle, recipe: Path, tmp_path: Path
) -> None:
    """The judge would refuse all three fastest for their motion, and nothing pruned would be left."""
    plan = make_plan(str(policy_template), None, read_recipe(recipe), tmp_path / "cache")
    search = PrunedSearch(plan, float_bundle, float_bundle, Context())
    space = Space((1.0, 0.7, 0.55), 4, 1, {FLOAT32: ()}, ())
    rough = [Tried(Shape(0.55, blocks, 1, FLOAT32), 9.0 - blocks, 0.0, refused="jerk is 2x") for blocks in (1, 2, 3)]
    calm = Tried(Shape(0.7, 1, 1, FLOAT32), 2.0, 0.0)
    assert search._finalists([*rough, calm], space) == [calm, *rough[:2]]
    (line,) = (line for line in search._table([*rough, calm], space) if line["speed-up"] == "8.00x")
    assert (line["within"], line["note"]) == ("no", "jerk is 2x")


def test_claims_of_a_study_are_not_shown_as_measurements(
    policy_template: Path, float_bundle: Bundle, recipe: Path, tmp_path: Path
) -> None:
    plan = make_plan(str(policy_template), None, read_recipe(recipe), tmp_path / "cache")
    search = PrunedSearch(plan, float_bundle, float_bundle, Context())
    space = Space((1.0, 0.7, 0.55), 4, 1, {FLOAT32: ()}, ())
    here = Tried(Shape(0.7, 1, 1, FLOAT32), 2.0, 0.0)
    claimed = Tried(Shape(0.55, 1, 1, FLOAT32), 99.0, 0.0, 60.0, elsewhere=True)
    failed = Tried(Shape(0.55, 2, 1, FLOAT32), note="no weights", elsewhere=True)
    table = search._table([claimed, here, failed], space)
    assert [line["policy"] for line in table] == [space.name(each.shape) for each in (here, claimed, failed)]
    assert [(line["speed-up"], line["on the front"], line["within"]) for line in table] == [
        ("2.00x", "yes", "yes"), ("", "", ""), ("", "", ""),
    ]  # fmt: skip
    assert [line["the study says"] for line in table] == ["", "99.00x, drop 0.0 points", "no weights"]
    assert [line["note"] for line in table] == ["", *["not measured in this run"] * 2]
    name = space.name(claimed.shape)
    again = with_measured(table, {name: Row(name, measurements=(Measurement("speedup", 1.25, "x"),))})
    assert [(line["speed-up"], line["note"]) for line in again[:2]] == [
        ("2.00x", ""), ("1.25x", "measured as a candidate"),
    ]  # fmt: skip
    assert again[0] == table[0]
    assert again[2] == table[2]
