"""Measure latency and memory through the runtime."""
