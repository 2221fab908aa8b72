"""A bundle: what its manifest says, its spec, its files."""
