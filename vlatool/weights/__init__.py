"""Stored weights: safetensors shards, and pairs of int8 weights."""
