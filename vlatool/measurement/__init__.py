"""How latency, memory and answers are measured: processes that need numpy and one engine."""
