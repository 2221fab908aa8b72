"""Let the server of child processes import its libraries while this process still imports the command."""

from __future__ import annotations

from collections.abc import Sequence

from vlatool.user_code import children

GRAPHS = ("numpy.random", "onnx", "onnxruntime", "vlatool.stage._child", "vlatool.quantize.static_int8")
MODULES = ("torch", "onnx", "onnxscript", "onnxruntime", "vlatool.export.onnx", "vlatool.stage._child")
TRAINING_METHOD = "qat"


def start_early(words: Sequence[str]) -> None:
    """Start the server where a command line will need it.

    Example:
        >>> start_early(["doctor"])
    """
    if len(words) < 2 or any(word in ("--help", "-h") for word in words):
        return
    if words[0] == "quantize" and words[1] != TRAINING_METHOD:
        children.prepare(GRAPHS)
    elif words[0] in ("export", "prune", "distill", "verify", "quantize"):
        children.prepare(MODULES)
