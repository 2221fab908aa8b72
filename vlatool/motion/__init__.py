"""How a robot moved in an episode: tracks, metrics, and ratios of two policies."""
