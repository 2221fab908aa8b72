from pathlib import Path

import pytest
import yaml

from vlatool.errors import RecipeError
from vlatool.optimize.recipe import Effort, Limits, Recipe, default_recipe, read_recipe, stage_entries


def write(folder: Path, data) -> Path:
    path = folder / "recipe.yaml"
    path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
    return path


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_recipe_survives_yaml(tmp_path: Path, calibrated):
    recipe = default_recipe(Limits(max_drop=0.02, hz=5), Effort(episodes=10, threads=2), calibrated)
    text = recipe.to_yaml()
    assert read_recipe(write(tmp_path, text)) == recipe
    assert text.startswith("schema: 1\n")


def test_static_candidates_need_calibration_data():
    assert set(default_recipe(Limits(), Effort(), calibrated=False).candidates) == {"dynamic_int8"}
    assert "static_int8" in default_recipe(Limits(), Effort(), calibrated=True).candidates


def test_a_short_recipe_has_defaults(tmp_path: Path):
    recipe = read_recipe(write(tmp_path, {"schema": 1, "candidates": {"a": [{"quantize.dynamic_int8": {}}]}}))
    assert recipe.export == ({"export.onnx": {}},)
    assert recipe.limits == Limits()
    assert recipe.effort == Effort()


@pytest.mark.parametrize("limits", [{"metric": "relative_error"}, {"max_metric": 0.1}])
def test_a_metric_and_its_bound_belong_together(tmp_path: Path, limits):
    data = {"schema": 1, "candidates": {"a": [{"quantize.dynamic_int8": {}}]}, "limits": limits}
    with pytest.raises(RecipeError, match="metric and max_metric belong together"):
        read_recipe(write(tmp_path, data))


def test_stage_entries_are_names_with_options():
    stages = ({"export.onnx": {"opset": 20}}, {"quantize.static_int8": {}})
    assert stage_entries(stages) == [("export.onnx", {"opset": 20}), ("quantize.static_int8", {})]


@pytest.mark.parametrize("entry", [{}, {"export.onnx": {}, "quantize.static_int8": {}}])
def test_an_entry_is_one_stage(entry):
    with pytest.raises(RecipeError, match="one name with its options"):
        stage_entries((entry,))


def test_no_file(tmp_path: Path):
    with pytest.raises(RecipeError, match="There is no recipe"):
        read_recipe(tmp_path / "recipe.yaml")


def test_a_directory(tmp_path: Path):
    with pytest.raises(RecipeError, match="cannot be read"):
        read_recipe(tmp_path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("a: [1", "not valid YAML"),
        ("", "is empty; it must be a mapping"),
        ("- a", "must be a mapping; got list"),
        ({"schema": 1}, "candidates: Field required"),
        ({"schema": 1, "candidates": {}}, "candidates: Dictionary should have at least 1 item"),
        ({"schema": 2, "candidates": {"a": []}}, "schema"),
        ({"schema": 1, "candidates": {"a": []}, "limit": {}}, "limit: Extra inputs"),
        ({"schema": 1, "candidates": {"a": []}, "limits": {"max_drop": 2}}, r"limits.max_drop: Input should be less"),
        ({"schema": 1, "candidates": {"a": []}, "effort": {"iterations": 3}}, "effort.iterations"),
        ({"schema": 1, "candidates": {"a": []}, "limits": {"max_drop": True}}, "limits.max_drop: Input should be a nu"),
        ({"schema": 1, "candidates": {"a": "quantize.static_int8"}}, "candidates.a"),
    ],
)
def test_a_recipe_that_cannot_be(tmp_path: Path, data, message):
    with pytest.raises(RecipeError, match=message):
        read_recipe(write(tmp_path, data))


def test_every_problem_is_listed(tmp_path: Path):
    path = write(tmp_path, {"schema": 1, "candidates": {"a": []}, "limits": {"max_drop": 2, "hz": 0}})
    with pytest.raises(RecipeError, match=r"limits.max_drop.*limits.hz"):
        read_recipe(path)


def test_text_that_is_no_utf8(tmp_path: Path):
    (tmp_path / "recipe.yaml").write_bytes(b"\xff\xfe")
    with pytest.raises(RecipeError, match="cannot be read"):
        read_recipe(tmp_path / "recipe.yaml")


def test_a_recipe_needs_its_names(tmp_path: Path):
    assert Recipe.model_validate({"schema": 1, "candidates": {"a": []}}).candidates == {"a": ()}
