"""The policy of a folder, ready to act on raw observations."""

from pathlib import Path

from policy import make
from runtime import Runner


def load_runner(folder: Path) -> Runner:
    """Loads the policy whose weights, vocabulary and statistics are in a folder."""
    return Runner.load(make(folder / "weights.safetensors"), folder)
