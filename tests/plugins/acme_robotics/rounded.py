"""A quantization method in one file."""

from pathlib import Path

import numpy as np
from onnx import numpy_helper
from pydantic import Field

from vlatool.bundle.bundle import Bundle
from vlatool.graph.files import load, save
from vlatool.graph.layers import find_layers
from vlatool.quantize import Quantization
from vlatool.stage.base import Context, Result


class Rounded(Quantization):
    """Round every weight to a few bits of its tensor's range; it stays float32 in the file."""

    packages = ("acme-robotics", "onnx", "numpy")
    tried = {"": {}}

    bits: int = Field(6, ge=2, le=16, description="bits of a weight")

    def run(self, source: Bundle, out: Path, context: Context) -> Result:
        """Round the weights of every selected layer."""
        layers = {}
        for graph in self.chosen_graphs(source):
            model = load(source.file(source.manifest.graphs[graph].file))
            layers[graph] = find_layers(model, ("MatMul", "Gemm", "Conv"))
        selected = self.select_nodes([layer.name for found in layers.values() for layer in found], source)

        def quantize(graph: str, original: Path, target: Path) -> None:
            model = load(original)
            weights = {layer.weight for layer in layers[graph] if layer.name in selected}
            for tensor in model.graph.initializer:
                if tensor.name in weights:
                    rounded = self.rounded(numpy_helper.to_array(tensor))
                    tensor.CopyFrom(numpy_helper.from_array(rounded, tensor.name))
            save(model, target)

        return self.transform(source, out, context, quantize)

    def rounded(self, weights: np.ndarray) -> np.ndarray:
        """Return the nearest of ``2 ** bits - 1`` evenly spaced values for each weight."""
        step = np.abs(weights).max() / (2 ** (self.bits - 1) - 1) or 1.0
        return (np.round(weights / step) * step).astype(np.float32)
