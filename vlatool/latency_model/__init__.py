"""The latency model: published latencies, features, the Gaussian process, its fit and score."""
