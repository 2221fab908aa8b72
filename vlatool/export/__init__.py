"""Turn a policy into a bundle of graphs, checked in ONNX Runtime."""
