"""What a training says of its teacher."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from vlatool.training.supervision import Supervision, parameters, size_line, teacher_lines, teacher_record

LABELS = {"used": 120, "recorded": 1200}


def said(supervision: Supervision, looks: list[list[float]], labels: dict[str, int]) -> tuple[str, ...]:
    sizes = {"student": 1_900_000, "teacher": 7_800_000}
    return teacher_lines({"parameters": sizes, "teacher": supervision.about(looks, labels)})


@pytest.mark.parametrize(("supervision", "looks", "labels", "says"), [
    (Supervision(), [], {}, "100 % (alpha 1, the loss has no other term)"),
    (Supervision(0.0), [], LABELS,
     "0 % (alpha 0, the teacher was not asked; 120 of 1,200 recorded observations with the expert's action)"),
    (Supervision(0.5), [[1, 3.0, 1.0], [5, 1.0, 1.0]], LABELS,
     "75 % in step 1, 50 % in step 5 (alpha 0.5; 120 of 1,200 recorded observations with the expert's action)"),
    (Supervision(0.5), [], LABELS,
     "not measured (alpha 0.5; 120 of 1,200 recorded observations with the expert's action)"),
])  # fmt: skip
def test_the_lines(supervision: Supervision, looks: list[list[float]], labels: dict[str, int], says: str):
    assert said(supervision, looks, labels) == (
        "1.9 M of 7.8 M parameters (24 %)", f"gradient from the teacher: {says}",
    )  # fmt: skip


def test_a_control_is_said_first():
    first, *_ = said(Supervision(control="noise"), [], {})
    assert first.startswith("a control, not for a robot")
    about: dict[str, Any] = Supervision(control="noise").about([], {})
    record = teacher_record({"parameters": {"student": 5, "teacher": 10}, "teacher": about})
    assert list(record) == ["student", "gradient from the teacher", "control"]
    assert record["student"] == "5 of 10 parameters (50 %)"


def test_the_share_is_the_mean_of_what_was_measured_and_that_of_alpha_otherwise():
    about = Supervision(0.25).about([[1, 3.0, 1.0], [5, 1.0, 1.0], [9, 0.0, 0.0]], LABELS)
    assert about["gradient_share"] == pytest.approx(0.625)
    assert [look["step"] for look in about["gradients"]] == [1, 5], "where no term has a gradient there is no share"
    assert Supervision(0.25).about([], LABELS)["gradient_share"] is None
    assert [Supervision(alpha).about([], {})["gradient_share"] for alpha in (0.0, 1.0)] == [0.0, 1.0]


def test_the_loss_is_named_after_its_terms():
    assert [Supervision(alpha).loss_name("kl") for alpha in (1.0, 0.7, 0.0)] == ["kl", "0.7 kl + 0.3 expert", "expert"]


def test_weights_that_modules_share_count_once():
    one, other = nn.Linear(3, 4), nn.Linear(3, 4)
    other.weight = one.weight
    assert parameters({"one": one, "other": other}) == 12 + 4 + 4
    assert parameters({"one": one, "table": nn.Embedding(7, 2, dtype=torch.float16)}) == 16 + 14


def test_small_numbers_are_not_rounded():
    assert size_line({"student": 99_999, "teacher": 100_000}) == "99,999 of 0.1 M parameters (100 %)"
