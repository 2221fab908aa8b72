"""The names of raw samples of a row."""

from __future__ import annotations

from vlatool.measures import Pattern

LATENCY, START_TIMES, OVERHEAD = "latency_ms", "at_s", "overhead_us"
"""Of each call: how long it took, when it began in seconds since the start of the run; what the runtime added to it."""
THROTTLE_TIMES = "throttled_at_s"
READING, READING_TIMES = Pattern("telemetry.{reading}"), Pattern("telemetry.{reading}.at_s")
LOSSES = Pattern("training: {stage}")
"""The loss of each step."""
SUCCESS, SEED, STEPS, TASK, INSTRUCTION = "success", "seed", "steps", "task", "instruction"
"""Of each episode; task and instruction are rows of the tables of details."""
START = "start"
"""The distinct first observation of each episode, as a number."""
NO_CLOCK = "no clock"
"""1 for each episode in which the environment's clock could not be used."""
METRIC = Pattern("motion.{metric}")
DISTURBED_SUCCESS, DISTURBED_BASELINE = Pattern("disturbed.{disturbance}"), Pattern("disturbed.{disturbance}, baseline")
"""Which episodes succeeded under a disturbance, and the same episodes of what the variant is held against."""
EPISODE = Pattern("episode.{series}")
"""The steps of the one episode that a report shows."""
LOG_RATIO, LOG_MEAN_RATIO = "log_ratio", "log_mean_ratio"
"""Of each process of a gate."""
