"""Weight-only quantization in blocks, streamed: one tensor in memory at a time."""
