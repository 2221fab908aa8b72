"""What reads and edits an ONNX graph."""
