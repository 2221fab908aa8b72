"""Activations of a policy on recorded samples: statistics and the ranges that follow from them."""
