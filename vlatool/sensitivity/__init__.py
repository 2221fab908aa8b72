"""Sensitivity of the accuracy to quantization of each layer."""
