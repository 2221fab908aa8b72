"""A package that adds one thing of each kind to vlatool, as somebody else would write it."""
