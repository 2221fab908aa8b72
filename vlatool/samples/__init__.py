"""Policies with random weights and realistic shapes, for latency and memory work; one file for each."""
