"""Where the server of children imports this, what they benchmark has no cold starts, as in the tests' own process."""

from vlatool.benchmark import latency

latency.COLD_STARTS = 0
