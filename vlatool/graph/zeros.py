"""How much of a bundle's weights is zero."""

from __future__ import annotations

import numpy as np

from vlatool.bundle.bundle import Bundle
from vlatool.errors import GraphError, MissingExtra, require
from vlatool.graph.files import read

MOST_BYTES = 2_000_000_000
"""Graphs above this are not looked into."""
FLOATS = (1, 10)
"""``TensorProto.FLOAT`` and ``FLOAT16``."""


def zero_share(bundle: Bundle) -> float:
    """Return the share of zeros among the floating-point weights with two axes or more; 0 where they are not read.

    Args:
        bundle: With graphs. They are not read where onnx is not installed, or they are larger than 2 GB.
    """
    if not bundle.manifest.graphs or bundle.graph_bytes > MOST_BYTES:
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
