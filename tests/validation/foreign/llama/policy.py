from pathlib import Path

import torch
from torch import nn
from transformers import LlamaForCausalLM
from transformers.cache_utils import Cache

PROMPT, TOKENS = 16, 7
SLOTS = PROMPT + TOKENS


class Slots(Cache):
    """A KV cache of a fixed length: keys and values (layers, 1, heads, SLOTS, width); `here` marks slots to write."""

    def __init__(self, keys, values, here):
        super().__init__(layers=[])
        self.keys, self.values, self.here = list(keys), list(values), here

    def update(self, key, value, layer, *_, **__):
        self.keys[layer] = torch.where(self.here, key, self.keys[layer])
        self.values[layer] = torch.where(self.here, value, self.values[layer])
        return self.keys[layer], self.values[layer]

    def get_seq_length(self, layer=0):
        return 0


class Part(nn.Module):
    def __init__(self, llama):
        super().__init__()
        self.llama = llama

    def run(self, ids, positions, cache):
        """Logits (1, 256) after the last of the ids (1, n), which stand at the positions (n,)."""
        mask = torch.arange(cache.keys[0].shape[2])[None] <= positions[:, None]
        mask = torch.where(mask, 0.0, torch.finfo(torch.float32).min)[None, None]
        out = self.llama(ids, attention_mask=mask, position_ids=positions[None], past_key_values=cache, use_cache=True)
        return out.logits[:, -1]


class Prefill(Part):
    """Prompt (1, 16) to keys and values of the cache, and logits (1, 7, 256), whose first row is known by now."""

    def forward(self, ids):
        config = self.llama.config
        shape = (config.num_hidden_layers, 1, config.num_key_value_heads, PROMPT, config.head_dim)
        empty = torch.zeros(shape)
        cache = Slots(empty, empty, torch.tensor(True))
        logits = self.run(ids, torch.arange(PROMPT), cache)
        keys, values = (nn.functional.pad(torch.stack(kept), (0, 0, 0, TOKENS)) for kept in (cache.keys, cache.values))
        return keys, values, nn.functional.pad(logits[:, None], (0, 0, 0, TOKENS - 1))


class Decode(Part):
    """One more token: number (1,) of the token to write, the cache and the logits so far, to the next of all three."""

    def forward(self, number, keys, values, logits):
        number = number.long()
        token = logits.index_select(1, number - 1).argmax(-1)
        position = PROMPT + number - 1
        cache = Slots(keys, values, (torch.arange(SLOTS) == position)[:, None])
        row = self.run(token, position, cache)
        here = (torch.arange(TOKENS) == number)[None, :, None]
        return torch.stack(cache.keys), torch.stack(cache.values), torch.where(here, row[:, None], logits)


def make():
    llama = LlamaForCausalLM.from_pretrained(Path(__file__).parent / "checkpoint")
    return {"prefill": Prefill(llama), "decode": Decode(llama)}
