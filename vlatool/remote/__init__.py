"""A benchmark on another machine."""
