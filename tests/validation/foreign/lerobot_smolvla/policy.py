import os
from pathlib import Path

import torch
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy, make_att_2d_masks, pad_vector
from torch import nn

HERE = Path(__file__).parent
STEPS = 5  # num_steps of the checkpoint


class Prefix(nn.Module):
    """State (1, 6), normalised, picture (1, 64, 64, 3) uint8 and ids (1, 12) to the keys and values of the prefix."""

    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, state, front, instruction):
        picture = front.permute(0, 3, 1, 2).float() / 255 * 2 - 1
        said = instruction != 0  # 0 pads
        state = pad_vector(state, self.model.config.max_state_dim)
        seen = torch.ones(1, dtype=torch.bool)
        embedded, pads, attends = self.model.embed_prefix([picture], [seen], instruction, said, state=state)
        _, cache = self.model.vlm_with_expert.forward(
            attention_mask=make_att_2d_masks(pads, attends),
            position_ids=torch.cumsum(pads, dim=1) - 1,
            past_key_values=None,
            inputs_embeds=[embedded, None],
            use_cache=True,
            fill_kv_cache=True,
        )
        keys = torch.stack([cache[layer]["key_states"] for layer in sorted(cache)])
        values = torch.stack([cache[layer]["value_states"] for layer in sorted(cache)])
        return keys, values, pads


class Step(nn.Module):
    """One step of flow matching: x (1, 10, 32) at a time (1,) to the next x, and its actions (1, 10, 6)."""

    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, x, time, keys, values, pads):
        pairs = enumerate(zip(keys, values, strict=True))
        cache = {layer: {"key_states": key, "value_states": value} for layer, (key, value) in pairs}
        x = x - self.model.denoise_step(pads, cache, x, time) / STEPS
        return x, x[:, :, :6]


def make():
    os.chdir(HERE)  # the checkpoint names its backbone relative to here
    model = SmolVLAPolicy.from_pretrained("checkpoint").model
    return {"prefix": Prefix(model), "step": Step(model)}
