"""Share of zeros in a bundle's weights."""

from __future__ import annotations

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError, MissingExtra, require
from vlatool.graph.files import read

MAX_BYTES = 2_000_000_000
"""Largest size of graphs that are read."""
FLOATS = (1, 10)
"""``TensorProto.FLOAT`` and ``FLOAT16``."""


def zero_share(bundle: Bundle) -> float:
    """Return the share of zeros among the floating-point weights with two axes or more; 0 where they are not read.

    Args:
        bundle: Bundle with graphs, which are not read without onnx installed, or above 2 GB.
    """
    if not bundle.manifest.graphs or bundle.graph_bytes > MAX_BYTES:
        return 0.0
    zeros = total = 0
    try:
        helper = require("onnx.numpy_helper", "build")
        for graph in bundle.manifest.graphs.values():
            for tensor in read(bundle.file(graph.file)).graph.initializer:
                if len(tensor.dims) > 1 and tensor.data_type in FLOATS:
                    values = helper.to_array(tensor)
                    zeros += int(values.size - np.count_nonzero(values))
                    total += values.size
    except (GraphError, MissingExtra):
        return 0.0
    return zeros / total if total else 0.0
