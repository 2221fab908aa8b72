"""What is right and what is not, and how a table says it."""

import numpy as np
import pytest
from _verdicts import Difference, Row, difference, exit_code, summed_up, table

CLOSE, FAR = Difference(0.01, 0.005), Difference(0.2, 0.1)


def row(found: Difference | None = CLOSE, refused: str = "", **fields: str) -> Row:
    return Row(("core",), "ort uint8", found, 0.045, refused, **fields)


def test_a_difference_is_relative_to_each_observation_and_to_all_of_them():
    wanted = np.array([[3.0, 4.0], [0.3, 0.4]])
    found = difference(np.array([[3.0, 4.0], [0.3, 0.9]]), wanted)
    assert found.worst == pytest.approx(1.0)
    assert found.of_all == pytest.approx(0.5 / np.hypot(5, 0.5))
    assert difference(wanted, wanted) == Difference(0.0, 0.0)


def test_a_difference_of_nothing_is_absolute():
    assert difference(np.full((1, 2), 0.5), np.zeros((1, 2))).worst == pytest.approx(np.sqrt(0.5))


@pytest.mark.parametrize("got", [np.zeros((2, 3)), np.full((2, 2), np.nan), np.full((2, 2), np.inf)])
def test_another_size_and_what_is_no_number_differ_without_bound(got):
    assert difference(got, np.ones((2, 2))).worst == np.inf


@pytest.mark.parametrize(
    ("tried", "verdict"),
    [
        (row(), "ok"),
        (row(FAR), "WRONG"),
        (row(None), "WRONG"),
        (row(Difference(0.08, 0.045)), "ok"),
        (row(Difference(0.1, 0.045)), "WRONG"),
        (row(Difference(0.05, 0.046)), "WRONG"),
        (row(Difference(float("nan"), 0)), "WRONG"),
        (row(CLOSE, "GraphError"), "WRONG"),
        (row(FAR, warned="doctor: saturates"), "WRONG"),
        (row(FAR, must="tell"), "WRONG"),
        (row(FAR, warned="doctor: saturates", must="tell"), "warned"),
        (row(FAR, "GraphError", must="tell"), "refused"),
        (row(None, "GraphError", must="tell"), "refused"),
        (row(None, "crash", must="tell"), "WRONG"),
        (row(None, "MissingExtra", must="tell"), "WRONG"),
        (row(CLOSE, warned="doctor: saturates", must="tell"), "ok"),
        (row(FAR, "GraphError", must="refuse"), "refused"),
        (row(FAR, must="refuse"), "NOT REFUSED"),
        (row(CLOSE, "GraphError", must="refuse"), "NOT REFUSED"),
        (row(None, "GraphError", must="refuse"), "NOT REFUSED"),
        (row(None, "crash", must="refuse"), "NOT REFUSED"),
        (row(None, "BundleError", must="refuse"), "NOT REFUSED"),
        (row(None, skipped="this host lacks avx_vnni"), "not tried"),
    ],
)
def test_a_verdict_is_what_load_and_the_difference_say(tried, verdict):
    assert tried.verdict == verdict
    assert exit_code([row(), tried]) == int(verdict.isupper())


def test_where_nothing_was_tried_nothing_was_shown():
    assert exit_code([]) == 1
    assert summed_up([]) == "nothing was tried"
    assert summed_up([row(), row(), row(FAR)]) == "2 ok, 1 WRONG"


def test_a_table_has_a_line_for_each_row():
    skipped = row(None, skipped="this host lacks avx_vnni")
    lines = table(("core",), [row(FAR, "GraphError", must="tell", note="another | golden\naction " * 20), skipped])
    assert lines[:2] == ["| core | bundle | worst | all | limit | verdict |", "|---|---|---|---|---|---|"]
    assert lines[2].startswith("| core | ort uint8 | 2.0e-01 | 1.0e-01 | 0.045 | refused; another / golden action")
    assert lines[2].endswith("... |")
    assert lines[3] == "| core | ort uint8 | - | - | 0.045 | not tried; this host lacks avx_vnni |"
    assert {line.count("|") for line in lines} == {7}
