"""The seven policies (Stable-Baselines3 twice): where each lies, what it is, and which packages it needs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Foreign:
    """A policy that nobody of this project wrote.

    Args:
        name: Its folder below tests/foreign.
        title: What it is, for the head of the table.
        packages: Which environment it needs: ``lerobot`` or ``common``.
        source: What `vlatool export` is given, relative to the folder's parent; the folder when empty.
        scripts: What makes it from nothing, in order; all run in the folder.
        environment: Whether it can play episodes.
        verified: Whether original.py has an ``act`` to verify the wrapper against.
    """

    name: str
    title: str
    packages: str
    source: str = ""
    scripts: tuple[str, ...] = ("original.py",)
    environment: bool = False
    verified: bool = False

    @property
    def exported(self) -> str:
        """What `vlatool export` is given, relative to the folder's parent."""
        return self.source or self.name


LEROBOT = ("original.py", "describe.py")
POLICIES = (
    Foreign("lerobot_act", "LeRobot ACT", "lerobot", scripts=LEROBOT, verified=True),
    Foreign("lerobot_diffusion", "LeRobot Diffusion", "lerobot", scripts=LEROBOT),
    Foreign("lerobot_smolvla", "LeRobot SmolVLA", "lerobot", scripts=LEROBOT),
    Foreign("resnet_gru", "ResNet-18 + GRU", "common"),
    Foreign("ppo_mlp", "SB3 PPO, MLP", "common", environment=True, verified=True),
    Foreign("ppo_cnn", "SB3 PPO, CNN", "common", environment=True, verified=True),
    Foreign("clip", "CLIP, ONNX file", "common", source="clip/clip.onnx"),
    Foreign("llama", "Llama, KV cache", "common", verified=True),
)
