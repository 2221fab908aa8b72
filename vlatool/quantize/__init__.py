"""Quantization methods: from a bundle to a bundle of lower precision."""
