"""A method that was begun."""

from vlatool.quantize import Quantization


class NoRun(Quantization):
    """Do nothing yet."""
