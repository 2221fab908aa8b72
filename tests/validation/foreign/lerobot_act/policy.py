from pathlib import Path

from lerobot.policies.act.modeling_act import ACTPolicy
from safetensors.torch import load_file
from torch import nn

CHECKPOINT = Path(__file__).parent / "checkpoint"


class Act(nn.Module):
    """State (1, 6), normalised, and picture (1, 96, 128, 3) uint8 to a normalised chunk (1, 50, 6)."""

    def __init__(self, policy, statistics):
        super().__init__()
        self.model = policy.model
        self.register_buffer("mean", statistics["observation.images.front.mean"])
        self.register_buffer("std", statistics["observation.images.front.std"])

    def forward(self, state, front):
        picture = (front.permute(0, 3, 1, 2).float() / 255 - self.mean) / self.std
        actions, _ = self.model({"observation.state": state, "observation.images": [picture]})
        return actions


def make():
    (file,) = CHECKPOINT.glob("policy_preprocessor_step_*_normalizer_processor.safetensors")
    return Act(ACTPolicy.from_pretrained(CHECKPOINT), load_file(file))
