"""A method with a bug."""

from vlatool.quantize import Quantization


class Broken(Quantization):
    """Divide by nothing."""

    def run(self, source, out, context):
        """Fail as code fails."""
        return out / (1 // 0)
