"""Importing this builds torch's table of ONNX functions, for a server whose children export (``module.torchlib``)."""

from __future__ import annotations

from vlatool.module.to_onnx import OPSET, quiet_exporter
from vlatool.module.torchlib import build

with quiet_exporter():
    build(OPSET)
