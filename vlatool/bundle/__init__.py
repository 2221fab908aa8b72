"""Bundles: manifest, spec, program and files."""
