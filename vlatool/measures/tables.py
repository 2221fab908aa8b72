"""The titles of the details of a row."""

from __future__ import annotations

from vlatool.measures import Pattern

ENGINE, LOG, TELEMETRY = "engine", "log", "telemetry"
RAN = "what the engine ran"
"""Nodes and multiply-accumulates of each graph by provider and precision, as the engine reports them."""
PHASES, MEMORY_PARTS, START_PARTS = "time by phase", "memory by part", "cold start by part"
DUTY_CYCLE = "latency by the way of calling"
MISSING_VALUES = "unmeasured"
"""What could not be had, and why."""
BY_TASK, BY_INSTRUCTION = "success by task", "success by instruction"
AGAINST_BY_TASK, AGAINST_BY_INSTRUCTION = "against the baseline, by task", "against the baseline, by instruction"
PAIRED_SUCCESS = "paired with the baseline"
UNDER = "under disturbances"
EPISODE = "the episode that differs most"
ROUNDS, TEACHER = Pattern("training: {stage}"), Pattern("training: {stage}, and its teacher")
IDENTITY = "policy identity"
"""Hash over all that decides how a robot behaves with the policy, and the hash of its bundle."""
CLAIMS, SETTINGS = "claims", "measured with"
WAY = "way"
"""How a board is driven: state, power mode, engine, precision."""
