"""Where the time of control steps went: parts that sum to the whole."""

from __future__ import annotations

import time
from typing import Any

import pytest
from _numbered import NumberedPolicy, spec_of
from _records import record

from vlatool.bundle.spec import TensorSpec
from vlatool.runtime.interface import POLICY, Origin
from vlatool.runtime.stack import build_stack
from vlatool.runtime.telemetry import PARTS, Delivery
from vlatool.runtime.telemetry.cadence import Cadence, cadence_lines
from vlatool.runtime.telemetry.json_lines import as_dict


def test_parts_sum_to_the_whole():
    cadence = Cadence()
    for step in range(10):
        cadence(record(step, waited_ms=float(step)))
    cadence(Delivery(9, 3.0))
    cadence(Delivery(77, 3.0))
    report = cadence.report()
    assert [each.part for each in report.parts] == ["sensor age", "wait", *PARTS, "transport", "whole"]
    *parts, whole = report.parts
    assert sum(each.mean_ms for each in parts) == pytest.approx(whole.mean_ms, rel=1e-6)
    assert sum(each.share for each in parts) == pytest.approx(1.0)
    assert parts[1].p50_ms == 4.5
    assert (parts[1].p99_ms, parts[1].max_ms, parts[-1].max_ms) == (9, 9, 3)
    assert "infer" in "\n".join(cadence_lines(report))
    assert cadence_lines(report.to_dict()) == cadence_lines(report)


def test_the_age_of_a_slow_part_is_beside_the_parts():
    cadence = Cadence()
    for step in range(4):
        cadence(record(step, origin=Origin(POLICY, 3.5, (), None if step == 3 else 100.0 * step)))
    report = cadence.report()
    assert report.latent is not None
    assert (report.latent.steps, report.latent.p50_ms, report.latent.max_ms) == (3, 100, 200)
    assert report.parts[-1].max_ms < 10, "no part of a step"
    assert "latent age" in cadence_lines(report)[-1]
    assert cadence_lines(report.to_dict()) == cadence_lines(report)
    assert as_dict(record(origin=Origin(POLICY, latent_age_ms=5.0)))["latent_age_ms"] == 5
    assert "latent_age_ms" not in as_dict(record())


def test_what_nobody_says_is_left_out():
    cadence = Cadence(4)
    assert cadence.report().parts == ()
    for step in range(9):
        cadence(record(step, sensed_ms=None, missed=step == 1))
    report = cadence.report()
    assert [each.part for each in report.parts] == ["wait", *PARTS, "whole"]
    assert (report.parts[0].steps, report.misses) == (4, 1)


def test_a_step_without_an_inference_has_no_time_of_one():
    records: list[Any] = []
    stack = build_stack(NumberedPolicy(spec_of(4)), telemetry=records.append, deadline_ms=40)
    for step in range(3):
        stack.act({"t": step})
    stack.close()
    infer = [each.parts_ms[PARTS.index("infer")] for each in records]
    assert infer[0] > 0
    assert infer[1:] == [0, 0]


def test_a_missed_deadline_is_time_of_the_inference():
    class Slow(NumberedPolicy):
        def infer(self, observation: Any, *, noise: Any = None) -> Any:
            time.sleep(0.05)
            return super().infer(observation)

    records: list[Any] = []
    spec = spec_of(2, 1, TensorSpec("a", (1, 1, 2), mode="delta"))
    stack = build_stack(Slow(spec), telemetry=records.append, deadline_ms=5)
    stack.act({"t": 0})
    stack.close()
    assert records[0].missed
    assert records[0].parts_ms[PARTS.index("infer")] >= 4.5
