"""Numbers of a run: histograms, counters, drift, health."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from _records import record

from vlatool.errors import UsageError
from vlatool.runtime.interface import HOLD, Origin
from vlatool.runtime.telemetry import Delivery
from vlatool.runtime.telemetry.health import Health, HealthLevel, Timeout
from vlatool.runtime.telemetry.histogram import Histogram
from vlatool.runtime.telemetry.metrics import FIRST_STEPS, NAMES, OTHER_REASON, Metrics


@pytest.mark.parametrize("draw", [lambda r: r.lognormal(1, 1, 4000), lambda r: r.uniform(0.002, 0.1, 4000),
                                  lambda r: np.where(r.random(4000) < 0.99, 5.0, 500.0)])  # fmt: skip
def test_quantiles_are_within_half_a_bin(draw: Any):
    times, histogram = draw(np.random.default_rng(0)), Histogram()
    for time in times:
        histogram.add(time)
    for share in (0.01, 0.5, 0.9, 0.99, 0.999, 1.0):
        exact = np.quantile(times, share, method="inverted_cdf")
        assert histogram.quantile_ms(share) == pytest.approx(exact, rel=2 ** (1 / 16) - 1 + 1e-9)
    assert (histogram.count, histogram.max_ms) == (4000, times.max())
    assert histogram.sum_ms == pytest.approx(times.sum())
    assert [count for _, count in histogram.cumulative()] == [int((times <= edge).sum())
                                                             for edge, _ in histogram.cumulative()]  # fmt: skip


def test_a_time_that_is_none_breaks_nothing():
    histogram = Histogram()
    assert math.isnan(histogram.quantile_ms(0.5))
    for time in (math.nan, -1.0, 0.0, math.inf, 1e12):
        histogram.add(time)
    assert histogram.count == 4
    assert histogram.cumulative()[-1][1] == 4
    assert histogram.quantile_ms(0.5) <= 0.001


def test_what_happened_is_counted_with_its_reason():
    metrics = Metrics()
    metrics(record(0))
    missed = "DeadlineMissed: there is no action"
    metrics(record(1, missed=True, error=missed, origin=Origin(HOLD, 9.0, ("velocity", "jerk")), level=2))
    metrics(record(2, alarms=("stall", "z_score")))
    metrics(Delivery(2, 0.4))
    metrics("something else")
    assert (metrics.steps, metrics.misses, metrics.level) == (3, 1, 0)
    assert metrics.counts["source"] == {"policy": 2, "hold": 1}
    assert metrics.counts["check"] == {"velocity": 3, "jerk": 1}
    assert metrics.counts["error"] == {"DeadlineMissed": 1}
    assert metrics.counts["alarm"] == {"stall": 1, "z_score": 1}
    assert metrics.times["transport"].sum_ms == 0.4
    assert metrics.times["infer"].sum_ms == pytest.approx(3.0)


def test_reasons_without_end_are_bounded():
    metrics = Metrics()
    for step in range(5 * NAMES):
        metrics(record(step, error=f"Error{step}: x", missed=True))
    assert len(metrics.counts["error"]) == NAMES + 1
    assert metrics.counts["error"][OTHER_REASON] == 4 * NAMES


def test_drift_is_of_the_last_steps_against_the_run():
    metrics, random = Metrics(), np.random.default_rng(2)
    for step in range(2 * FIRST_STEPS):
        metrics(record(step, action=random.normal(0, 1, 2), answer_ms=2.0))
    assert metrics.time_drift == 1.0
    assert metrics.action_drift < 1.0
    for step in range(FIRST_STEPS):
        metrics(record(step, action=random.normal([0, 4], 1), answer_ms=6.0))
    assert metrics.time_drift == pytest.approx(3.0, rel=0.1)
    assert metrics.action_drift > 1.0


def test_silence_and_what_a_component_says_degrade_it():
    now = [0.0]
    health = Health({"camera": Timeout(0.2, 1.0), "policy": Timeout(0.5, 2.0), "controller": Timeout(9, 9)},
                    clock=lambda: now[0])  # fmt: skip
    assert health.worst == HealthLevel.OK
    now[0] = 0.3
    assert health.levels()["camera"] == (HealthLevel.DEGRADED, "silent for 0.3 s")
    health.beat("camera", HealthLevel.FAILED, "unplugged")
    assert health.levels()["camera"] == (HealthLevel.FAILED, "unplugged")
    health.beat("camera")
    now[0] = 0.6
    health(record(0, missed=True))
    assert health.levels()["policy"][0] == HealthLevel.DEGRADED, "it has given nothing yet"
    health(record(1, level=2))
    assert health.levels()["policy"] == (HealthLevel.DEGRADED, "the fallback stands on rung 2")
    health(record(2))
    assert health.levels()["policy"][0] == HealthLevel.OK
    now[0] = 9.0
    assert health.levels()["controller"][0] == HealthLevel.OK
    assert health.worst == HealthLevel.FAILED
    with pytest.raises(UsageError, match="no component 'camara'"):
        health.beat("camara")


@pytest.mark.parametrize("wrong", [(0, 1), (2, 1), (math.nan, 1), (1, math.inf), ("1", 2)])
def test_a_time_out_that_is_none_is_refused(wrong: Any):
    with pytest.raises(UsageError, match="_s is"):
        Timeout(*wrong)
    with pytest.raises(UsageError, match="component -> Timeout"):
        Health({"camera": wrong})
