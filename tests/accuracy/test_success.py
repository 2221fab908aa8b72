"""What the info of an episode's steps says of its success."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlatool.accuracy.success import Success, reported_success
from vlatool.errors import DataError


def episode(*infos: Any) -> bool:
    listener = Success()
    for info in infos:
        listener.look(info)
    return listener.at_the_end("reach", 7)


@pytest.mark.parametrize("key", ["success", "is_success"])
@pytest.mark.parametrize(
    "value",
    [True, np.bool_(True), 1, 1.0, np.float32(1), np.array(True), np.array([True]), np.array([[1.0]]), [True], (1,)],
    ids=repr,
)
def test_both_keys_and_all_that_means_true_are_known(key: str, value: Any) -> None:
    assert reported_success({key: value}) is True
    opposite = type(value)([0]) if isinstance(value, list | tuple) else value * 0
    assert reported_success({key: opposite}) is False


def test_what_is_told_last_counts() -> None:
    assert episode({"success": True}, {"success": False}) is False
    assert episode({"success": False}, {"success": True}) is True
    assert episode({}, {"is_success": True}, {}) is True, "the key was seen earlier alone"


def test_success_goes_before_is_success() -> None:
    assert reported_success({"success": False, "is_success": True}) is False
    assert reported_success({"success": None, "is_success": True}) is True


@pytest.mark.parametrize("final", [{"is_success": True}, [{"is_success": True}], np.array([{"is_success": True}])])
def test_a_vector_environment_of_one_tells_it_in_final_info(final: Any) -> None:
    assert reported_success({"final_info": final}) is True


@pytest.mark.parametrize("info", [None, {}, [], {"goal_reached": True}, {"final_info": None}, {"final_info": {}}])
def test_what_tells_nothing_is_an_error_that_names_the_keys(info: Any) -> None:
    with pytest.raises(DataError, match=r"task 'reach' never told .* seed 7 .* 'success' or 'is_success'") as caught:
        episode(info, info)
    assert "also when it fails" in caught.value.fix


@pytest.mark.parametrize("value", ["no", "True", 0.7, float("nan"), np.array([True, False]), {}, object(), 2])
def test_what_is_neither_true_nor_false_is_refused(value: Any) -> None:
    with pytest.raises(DataError, match=r"info\['success'\] is .*; allowed: true or false"):
        reported_success({"success": value})
