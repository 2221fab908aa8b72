"""The seven policies (Stable-Baselines3 twice): where each lies, what it is, and which packages it needs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Foreign:
    """A policy that nobody of this project wrote.

    Args:
        name: Its folder below tests/validation/foreign.
        title: What it is, for the head of the table.
        packages: Which environment it needs: ``lerobot`` or ``common``.
        source: What `vlatool export` is given, relative to the folder's parent; the folder when empty.
        scripts: What makes it from nothing, in order; all run in the folder.
        shared: A folder below tests/validation/foreign whose files lie beside its own when it is made; none when empty.
        environment: Whether it can play episodes.
        verified: Whether original.py has an ``act`` to verify the wrapper against.
    """

    name: str
    title: str
    packages: str
    source: str = ""
    scripts: tuple[str, ...] = ("original.py",)
    shared: str = ""
    environment: bool = False
    verified: bool = False

    @property
    def exported(self) -> str:
        """What `vlatool export` is given, relative to the folder's parent."""
        return self.source or self.name

    @property
    def files(self) -> dict[str, Path]:
        """Name -> file, of what it is made from."""
        folders = [HERE / folder for folder in (self.shared, self.name) if folder]
        return {file.name: file for folder in folders for file in folder.iterdir() if file.is_file()}


LEROBOT = ("original.py", "describe.py")
POLICIES = (
    Foreign("lerobot_act", "LeRobot ACT", "lerobot", scripts=LEROBOT, shared="_lerobot", verified=True),
    Foreign("lerobot_diffusion", "LeRobot Diffusion", "lerobot", scripts=LEROBOT, shared="_lerobot"),
    Foreign("lerobot_smolvla", "LeRobot SmolVLA", "lerobot", scripts=LEROBOT, shared="_lerobot"),
    Foreign("resnet_gru", "ResNet-18 + GRU", "common"),
    Foreign("ppo_mlp", "SB3 PPO, MLP", "common", environment=True, verified=True),
    Foreign("ppo_cnn", "SB3 PPO, CNN", "common", environment=True, verified=True),
    Foreign("clip", "CLIP, ONNX file", "common", source="clip/clip.onnx"),
    Foreign("llama", "Llama, KV cache", "common", verified=True),
)
BY_NAME = {policy.name: policy for policy in POLICIES}
