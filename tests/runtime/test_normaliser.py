import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vlatool.bundle.spec import NORMALISATIONS, STATISTICS_OF, TensorSpec
from vlatool.errors import SpecError
from vlatool.runtime.statistics import load_normaliser

ROWS = {"mean": [1, 2], "std": [2, 4], "min": [-1, 0], "max": [3, 10], "q01": [0, 1], "q99": [4, 9],
        "q10": [1, 2], "q90": [3, 8]}  # fmt: skip


def load(folder: Path, normalisation: str, table: object = None, where: str = "stats.json#state"):
    text = table if isinstance(table, str) else json.dumps({"state": ROWS} if table is None else table)
    (folder / "stats.json").write_text(text)
    return load_normaliser(TensorSpec("state", (1, 2), normalisation=normalisation, statistics=where), folder)


def test_no_normalisation_needs_no_file(tmp_path: Path):
    assert load_normaliser(TensorSpec("state", (1, 2)), tmp_path) is None


def test_mean_and_std(tmp_path: Path):
    normaliser = load(tmp_path, "mean_std")
    np.testing.assert_array_equal(normaliser.forward(np.array([[3.0, -2.0]], np.float32)), [[1.0, -1.0]])


@pytest.mark.parametrize(
    ("normalisation", "low", "high"),
    [("min_max", "min", "max"), ("quantiles", "q01", "q99"), ("quantile10", "q10", "q90")],
)
def test_ranges_map_to_minus_one_and_one(tmp_path: Path, normalisation, low, high):
    normaliser = load(tmp_path, normalisation)
    ends = np.array([ROWS[low], ROWS[high]], np.float32)
    np.testing.assert_allclose(normaliser.forward(ends), [[-1, -1], [1, 1]], atol=1e-6)
    np.testing.assert_allclose(normaliser.inverse(np.array([-1, 1], np.float32)), [ROWS[low][0], ROWS[high][1]])


@pytest.mark.parametrize("normalisation", NORMALISATIONS[1:])
def test_inverse_undoes_forward_and_stays_float32(tmp_path: Path, normalisation):
    normaliser = load(tmp_path, normalisation)
    physical = np.random.default_rng(0).normal(size=(3, 4, 2)).astype(np.float32)
    normalised = normaliser.forward(physical)
    assert normalised.dtype == np.float32
    np.testing.assert_allclose(normaliser.inverse(normalised), physical, rtol=1e-5, atol=1e-6)


STILL = {"mean": [1, 7], "std": [2, 0], "min": [-1, 7], "max": [3, 7], "q01": [0, 7], "q99": [4, 7], "q10": [1, 7],
         "q90": [3, 7]}  # fmt: skip
EPSILON = 1e-8


def lerobot(mode: str, values, *, back: bool):
    """The arithmetic of LeRobot 0.6 (``processor/normalize_processor.py``) in float32."""
    first, second = (np.array(STILL[key], np.float32) for key in STATISTICS_OF[mode])
    epsilon = np.float32(EPSILON)
    if mode == "mean_std":
        return values * second + first if back else (values - first) / (second + epsilon)
    span = np.where(second == first, epsilon, second - first)
    return (values + 1) / 2 * span + first if back else 2 * (values - first) / span - 1


@pytest.mark.parametrize("mode", NORMALISATIONS[1:])
def test_with_an_epsilon_a_joint_that_never_moved_is_as_in_lerobot(tmp_path: Path, mode: str):
    (tmp_path / "stats.json").write_text(json.dumps({"state": STILL}))
    tensor = TensorSpec("state", (1, 2), normalisation=mode, statistics="stats.json#state", epsilon=EPSILON)
    normaliser = load_normaliser(tensor, tmp_path)
    assert normaliser is not None
    for physical in ([[2.5, 7]], [[-3, 7.5]], [[0, -7]]):
        row = np.array(physical, np.float32)
        wanted = lerobot(mode, row, back=False)
        np.testing.assert_allclose(normaliser.forward(row), wanted, rtol=1e-6)
        np.testing.assert_allclose(normaliser.forward_row(row[0].tolist()), wanted, rtol=1e-6)
    for normalised in ([[0.5, 0]], [[-1, -1]], [[2, 3]]):
        row = np.array(normalised, np.float32)
        np.testing.assert_allclose(normaliser.inverse(row), lerobot(mode, row, back=True), rtol=1e-6)
    with pytest.raises(SpecError, match=r"no spread in the elements \[1\]") as caught:
        load_normaliser(replace(tensor, epsilon=0), tmp_path)
    assert "epsilon: 1e-8" in caught.value.fix


@pytest.mark.parametrize("mode", NORMALISATIONS[1:])
def test_with_an_epsilon_it_is_lerobots_arithmetic_bit_for_bit(tmp_path: Path, mode: str):
    random = np.random.default_rng(0)
    first, second = STATISTICS_OF[mode]
    for number in range(50):
        low = random.normal(size=2).astype(np.float32)
        high = np.abs(low) + random.uniform(0.01, 3, 2).astype(np.float32)
        rows = {first: low.tolist(), second: high.tolist()}
        (tmp_path / "stats.json").write_text(json.dumps({"state": rows}))
        tensor = TensorSpec("state", (1, 2), normalisation=mode, statistics="stats.json#state", epsilon=EPSILON)
        normaliser = load_normaliser(tensor, tmp_path)
        assert normaliser is not None
        for row in (low, high, (low + high) / 2, random.normal(size=2).astype(np.float32)):
            span = high + np.float32(EPSILON) if mode == "mean_std" else high - low
            wanted = (row - low) / span if mode == "mean_std" else 2 * (row - low) / span - 1
            np.testing.assert_array_equal(normaliser.forward(row[None])[0], wanted, err_msg=str(number))


@pytest.mark.parametrize("epsilon", [-1e-8, 1, float("nan"), float("inf"), "1e-8", True, None])
def test_an_impossible_epsilon_is_refused(epsilon):
    with pytest.raises(SpecError, match="epsilon"):
        TensorSpec("state", (1, 2), normalisation="mean_std", statistics="s.json#x", epsilon=epsilon)
    with pytest.raises(SpecError, match="above 0 with a normalisation"):
        TensorSpec("state", (1, 2), epsilon=1e-8)


def test_a_missing_file_is_never_identity_in_silence(tmp_path: Path):
    with pytest.raises(SpecError, match=r"'state' are missing: .*absent.json \(No such file") as caught:
        load(tmp_path, "mean_std", where="absent.json#state")
    assert "never skipped in silence" in caught.value.fix


@pytest.mark.parametrize("text", ["", "{", "\x00"])
def test_a_file_that_is_no_json(tmp_path: Path, text):
    with pytest.raises(SpecError, match="not valid JSON"):
        load(tmp_path, "mean_std", text)


@pytest.mark.parametrize("table", [{}, [], {"stat": ROWS}])
def test_a_missing_entry(tmp_path: Path, table):
    with pytest.raises(SpecError, match="has no statistics 'state' for 'state'"):
        load(tmp_path, "mean_std", table)


def test_a_missing_entry_gets_the_nearest_name(tmp_path: Path):
    with pytest.raises(SpecError, match="did you mean 'states'"):
        load(tmp_path, "mean_std", {"states": ROWS})


@pytest.mark.parametrize("normalisation", NORMALISATIONS[1:])
def test_a_missing_key(tmp_path: Path, normalisation):
    first, second = STATISTICS_OF[normalisation]
    with pytest.raises(SpecError, match=f"lack '{second}', which {normalisation} needs"):
        load(tmp_path, normalisation, {"state": {first: [0, 0]}})
    with pytest.raises(SpecError, match=f"lack '{first}'"):
        load(tmp_path, normalisation, {"state": "rows"})


@pytest.mark.parametrize("row", [[1], [1, 2, 3], [[1, 2]], 4, []])
def test_a_wrong_width(tmp_path: Path, row):
    with pytest.raises(SpecError, match=r"has the shape .*; 'state' has 2 elements"):
        load(tmp_path, "mean_std", {"state": {"mean": row, "std": [1, 1]}})


@pytest.mark.parametrize(
    "row", [["a", "b"], ["1", "2"], [True, False], True, "12", [10**400, 1], [[1], [2, 3]], {"x": 1}]
)
def test_what_is_no_list_of_numbers(tmp_path: Path, row):
    with pytest.raises(SpecError, match="is not a list of numbers"):
        load(tmp_path, "mean_std", {"state": {"mean": row, "std": [1, 1]}})


@pytest.mark.parametrize("value", [float("nan"), float("inf"), None])
def test_a_value_that_is_not_finite(tmp_path: Path, value):
    with pytest.raises(SpecError, match=r"'std' of 'state'.*not finite"):
        load(tmp_path, "mean_std", {"state": {"mean": [0, 0], "std": [1, value]}})


@pytest.mark.parametrize(
    ("normalisation", "change"),
    [
        ("mean_std", {"std": [1, 0]}),
        ("mean_std", {"std": [1, -1]}),
        ("min_max", {"max": [3, 0]}),
        ("quantiles", {"q99": [4, 0]}),
    ],
)
def test_no_spread_is_refused_with_the_element(tmp_path: Path, normalisation, change):
    with pytest.raises(SpecError, match=r"'state' have no spread in the elements \[1\]"):
        load(tmp_path, normalisation, {"state": {**ROWS, **change}})


@pytest.mark.parametrize("value", [1e300, 10**39])
def test_a_value_beyond_float32_is_not_finite(tmp_path: Path, value):
    with pytest.raises(SpecError, match=r"'std' of 'state'.*not finite"):
        load(tmp_path, "mean_std", {"state": {"mean": [0, 0], "std": [1, value]}})


def test_a_range_beyond_float32_is_refused(tmp_path: Path):
    with pytest.raises(SpecError, match="'state' span more than float32 holds"):
        load(tmp_path, "min_max", {"state": {"min": [-3e38, 0], "max": [3e38, 1]}})


def test_a_bomb_is_not_read(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "statistics_bytes=100")
    with pytest.raises(SpecError, match="the limit 'statistics_bytes' allows 100"):
        load(tmp_path, "mean_std", {"state": ROWS, "more": list(range(100))})


@pytest.mark.parametrize("text", ["[" * 100_000, '{"state": 1, "state": 2}'])
def test_what_python_cannot_parse_is_no_traceback(tmp_path: Path, text):
    with pytest.raises(SpecError, match="is not valid JSON"):
        load(tmp_path, "mean_std", text)


def test_a_link_is_not_followed(tmp_path: Path):
    (tmp_path / "other.json").write_text(json.dumps({"state": ROWS}))
    (tmp_path / "link.json").symlink_to(tmp_path / "other.json")
    with pytest.raises(SpecError, match="'state' are missing"):
        load(tmp_path, "mean_std", where="link.json#state")
