"""Make a bundle of lower precision."""
