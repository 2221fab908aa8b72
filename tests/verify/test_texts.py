"""Texts of a log: near to those of the recordings, or of another task."""

from __future__ import annotations

import pytest

from vlatool.verify._texts import explain_paired, relation, unknown_texts

KNOWN = ["open the drawer", "close the window"]
TEMPLATE = "In: What action should the robot take to {}?\nOut:"

RELATIONS = {
    "Open the drawer.": "it was written 'open the drawer'",
    "OPEN  THE DRAWER": "it was written 'open the drawer'",
    TEMPLATE.format("close the window"): "it was written 'close the window', without the words around it ('in what "
                                         "action should the robot take to ... out')",
    "the drawer": "it was written 'open the drawer', with words around it ('open ...')",
    "open the drawwer": "it is near to 'open the drawer': a slip?",
    "open the cupboard": "",
    "drawer": "",
    "": "",
}  # fmt: skip


@pytest.mark.parametrize("text", RELATIONS)
def test_how_a_text_is_near_to_one_that_is_known(text):
    assert relation(text, KNOWN) == RELATIONS[text]


def test_a_template_of_the_recordings_that_a_log_lacks_is_told():
    known = [TEMPLATE.format(text) for text in KNOWN]
    said = list(unknown_texts("task", [KNOWN[0]] * 3, known, ([0, 0, 0], [0, 1])))
    assert said == [f"'task' is 'open the drawer' in 3 rows, which was never recorded: it was written {known[0]!r}, "
                    "with words around it ('in what action should the robot take to ... out')"]  # fmt: skip


PAIRED = {
    ("open the drawer",) * 4: [],
    ("",) * 4: ["it is empty, where 'open the drawer' was recorded, in 4 of 4 rows"],
    ("close the window",) * 2: ["it is 'close the window', the text of another task, where 'open the drawer' was "
                                "recorded, in 2 of 2 rows"],
    ("open the drawer", "Open the drawer."): ["it is 'Open the drawer.': it was written 'open the drawer', where 'open "
                                              "the drawer' was recorded, in 1 of 2 rows"],
    ("wave",): ["it is 'wave': a text that was never recorded, where 'open the drawer' was recorded, in 1 of 1 row"],
}  # fmt: skip


@pytest.mark.parametrize("log", PAIRED)
def test_texts_of_the_same_moments_are_compared_row_by_row(log):
    reference = ["open the drawer"] * len(log)
    found = list(explain_paired("task", [*log, "close the window"], [*reference, "close the window"]))
    assert [(each.signal, each.kind) for each in found] == [("task", "text")] * len(found)
    assert [each.where.replace(f" of {len(log) + 1}", f" of {len(log)}").replace(" of 1 rows", " of 1 row")
            for each in found] == PAIRED[log]  # fmt: skip
