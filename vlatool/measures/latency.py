"""How long an inference takes, how steady that is, and how it compares."""

from __future__ import annotations

import re

from vlatool.measures import HEADLINE, PERCENT, PERCENTILES, Family, Quantity
from vlatool.report import Measurement

UPPER_BOUND = "upper bound, order statistic"
RATIO_QUANTILE = "order statistic of the ratios within rounds"
HODGES = "Hodges-Lehmann, over fresh processes"

LATENCY_P50 = Quantity(
    "latency_p50", "ms", section=HEADLINE, order=10, host_column="p50, this host", interval=UPPER_BOUND
)
LATENCY_P90 = Quantity("latency_p90", "ms", section=PERCENTILES, order=20, interval=UPPER_BOUND)
LATENCY_P95 = Quantity("latency_p95", "ms", section=PERCENTILES, order=30, interval=UPPER_BOUND)
LATENCY_P99 = Quantity("latency_p99", "ms", section=PERCENTILES, order=40, interval=UPPER_BOUND)
LATENCY_P999 = Quantity("latency_p99.9", "ms", "latency p99.9", section=PERCENTILES, order=50, interval=UPPER_BOUND)
LATENCY_MAX = Quantity("latency_max", "ms", section=PERCENTILES, order=60)
LATENCY = Family(Quantity("latency_{percentile}", "ms", interval=UPPER_BOUND))
OF_LATENCY = (LATENCY_P50, LATENCY_P90, LATENCY_P95, LATENCY_P99, LATENCY_P999, LATENCY_MAX)
"""What a table of percentiles has."""

SPEEDUP = Quantity("speedup", "x", "speed-up", "more", HEADLINE, 30, interval=RATIO_QUANTILE)
DEADLINE_MISSES = Quantity(
    "deadline_misses", "1", section=HEADLINE, order=20, host_column="deadline misses, this host", interval="Wilson"
)
THROUGHPUT = Quantity("throughput", "1/s", better="more", order=10)
GMACS = Quantity("gmacs", "GMAC/s", better="more", order=20)
REACH_SHARE = Quantity("reach_share", "1", better="more", order=30, form=PERCENT)
JITTER = Quantity("jitter", "ms", order=40)
AGE_P50 = Quantity("age_p50", "ms", "observation age p50", order=50, interval=UPPER_BOUND)
AGE_P99 = Quantity("age_p99", "ms", "observation age p99", order=51, interval=UPPER_BOUND)
AGE_MAX = Quantity("age_max", "ms", "observation age max", order=52)
AGE = Family(Quantity("age_{percentile}", "ms", "observation age {percentile}", interval=UPPER_BOUND))
WAKEUP_P50 = Quantity("wakeup_p50", "ms", "wake-up delay p50", order=60, interval=UPPER_BOUND)
WAKEUP_P99 = Quantity("wakeup_p99", "ms", "wake-up delay p99", order=61, interval=UPPER_BOUND)
WAKEUP = Family(Quantity("wakeup_{percentile}", "ms", "wake-up delay {percentile}", interval=UPPER_BOUND))
LATENCY_START_P50 = Quantity("latency_start_p50", "ms", "latency p50 at the start", order=70, interval=UPPER_BOUND)
LATENCY_START = Family(Quantity("latency_start_{percentile}", "ms", interval=UPPER_BOUND))
LATENCY_SUSTAINED_P50 = Quantity("latency_sustained_p50", "ms", "latency p50 sustained", order=71, interval=UPPER_BOUND)
LATENCY_SUSTAINED = Family(Quantity("latency_sustained_{percentile}", "ms", interval=UPPER_BOUND))
SUSTAINED_SLOWDOWN = Quantity("sustained_slowdown", "x", "sustained slow-down", order=72)
LATENCY_BUSY_P50 = Quantity("latency_busy_p50", "ms", "latency p50 in a busy loop", order=73)
LATENCY_DUTY_P50 = Quantity("latency_duty_p50", "ms", "latency p50 at the robot's rate", order=74)
LATENCY_SINGLE_P50 = Quantity("latency_single_p50", "ms", "latency p50 of single shots", order=75)
DUTY_RATIO = Quantity("duty_ratio", "x", "latency at the robot's rate", order=76, interval=RATIO_QUANTILE)
SINGLE_RATIO = Quantity("single_ratio", "x", "latency of single shots", order=77, interval=RATIO_QUANTILE)
COLD_START = Quantity("cold_start", "ms", order=80)

LATENCY_IN_THE_LOOP = Quantity("latency_in_the_loop", "ms")
LATENCY_PER_ACTION = Quantity("latency_per_action", "ms")
TORCH_EAGER_P50 = Quantity("torch_eager_latency_p50", "ms", interval=UPPER_BOUND)
OPENVINO_FLOAT32_P50 = Quantity("openvino_float32_latency_p50", "ms", interval=UPPER_BOUND)
LATENCY_RATIO = Quantity("latency_ratio", "x", interval=HODGES)
LATENCY_MEAN_RATIO = Quantity("latency_mean_ratio", "x", interval=HODGES)
LATENCY_RATIO_AT = Family(Quantity("latency_ratio_{threads}_threads", "x", interval=HODGES))
LATENCY_MEAN_RATIO_AT = Family(Quantity("latency_mean_ratio_{threads}_threads", "x", interval=HODGES))
OVERHEAD_P50 = Quantity("overhead_p50", "us", interval="order statistic")
OVERHEAD_IN_TURN_P50 = Quantity("overhead_in_turn_p50", "us", interval="order statistic")
BARE_RUN_P50 = Quantity("bare_run_p50", "us")


def ratio_at_threads(ratio: Measurement, threads: int) -> Measurement:
    """Return a ratio of latencies as that at a number of threads."""
    family = LATENCY_RATIO_AT if ratio.name == LATENCY_RATIO.name else LATENCY_MEAN_RATIO_AT
    return family.quantity(str(threads)).relabel(ratio)


def latency_of_limit(limit: str) -> Quantity | None:
    """Return the latency that a limit is on, by the limit's name: ``max_latency_p99_ms``; None for another limit."""
    named = re.fullmatch(r"(?:max_)?(.*)_ms", limit)
    if named is None or not ("latency" in named[1] or "deadline" in named[1]):
        return None
    percentile = re.search(r"p\d+(\.\d+)?|max$", named[1])
    return LATENCY.quantity(percentile[0]) if percentile else LATENCY_P50
