"""Turn a policy into a bundle with graphs that ONNX Runtime was seen to run."""
