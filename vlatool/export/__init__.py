"""Exporters: from a source bundle to a bundle with graphs."""
