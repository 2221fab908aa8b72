"""The newest opset and IR version that the installed ONNX Runtime opens: models of one operator, one after the other.

python tests/validation/engines/versions.py
"""

from __future__ import annotations

import onnxruntime
from onnx import TensorProto, helper

OPSETS, IR_VERSIONS = range(13, 31), range(7, 16)


def opens(opset: int, ir_version: int) -> bool:
    """Return whether ONNX Runtime opens a model of these versions."""
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [2]) for name in "xy"]
    graph = helper.make_graph([helper.make_node("Add", ["x", "x"], ["y"])], "g", ends[:1], ends[1:])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=ir_version)
    try:
        onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    except Exception:  # the seam: ONNX Runtime raises foreign types
        return False
    return True


def main() -> None:
    """Print the newest of both."""
    onnxruntime.set_default_logger_severity(4)
    opset = max(number for number in OPSETS if opens(number, 8))
    ir_version = max(number for number in IR_VERSIONS if opens(18, number))
    print(f"onnxruntime {onnxruntime.__version__}: opset {opset}, IR version {ir_version}")


if __name__ == "__main__":
    main()
