"""Make a bundle again from its recipe."""
