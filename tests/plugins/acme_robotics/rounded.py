"""A quantization method in one file."""

from pathlib import Path

import numpy as np
from onnx import numpy_helper
from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.graph.files import load, save
from vlatool.quantize import Quantization
from vlatool.stage.base import Context


class Rounded(Quantization):
    """Round every weight to a few bits of its tensor's range; it stays float32 in the file."""

    tried = {"": {}}

    bits: int = Field(6, ge=2, le=16, description="bits of a weight")

    def run(self, source: Bundle | None, out: Path, context: Context) -> Bundle:
        """Round the weights of every selected graph."""

        def quantize(_name: str, original: Path, target: Path) -> None:
            model = load(original)
            for tensor in model.graph.initializer:
                values = numpy_helper.to_array(tensor)
                if values.dtype == np.float32 and values.ndim > 1:
                    step = np.abs(values).max() / (2 ** (self.bits - 1) - 1) or 1.0
                    tensor.CopyFrom(numpy_helper.from_array((np.round(values / step) * step).astype("f4"), tensor.name))
            save(model, target)

        return self.transform(source, out, context, quantize)
