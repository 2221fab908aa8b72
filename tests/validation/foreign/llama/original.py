"""What somebody has: a small Llama that was trained to write seven action tokens, and what generate() writes."""

import functools
from pathlib import Path

import numpy as np
import torch
from torch import nn
from transformers import LlamaConfig, LlamaForCausalLM

HERE = Path(__file__).parent
PROMPT, TOKENS, STEPS = 16, 7, 200


@functools.cache
def loaded():
    return LlamaForCausalLM.from_pretrained(HERE / "checkpoint").eval()


def act(observation):
    """Prompt ids (16,) to token ids (7,), as transformers' own generate() writes them."""
    return written(loaded(), observation["ids"])


def written(model, ids):
    """The tokens that follow a prompt of (16,) ids, greedy."""
    ids = torch.as_tensor(ids)[None]
    options = {"do_sample": False, "max_new_tokens": TOKENS, "min_new_tokens": TOKENS, "pad_token_id": 0}
    return model.generate(ids, attention_mask=torch.ones_like(ids), **options)[0, PROMPT:].numpy()


def prompts(model, seed, count):
    """Random prompts, and the tokens that the model writes after each."""
    ids = np.random.default_rng(seed).integers(3, 256, (count, PROMPT))
    return {"ids": ids, "action": np.array([written(model, row) for row in ids])}


def train(model):
    """Teach it its task, the first seven ids of the prompt one after the other: that takes a minute or two."""
    optimizer = torch.optim.AdamW(model.parameters(), lr=2e-3)
    for _ in range(STEPS):
        prompt = torch.randint(3, 256, (32, PROMPT))
        ids = torch.cat([prompt, prompt[:, :TOKENS]], 1)
        logits = model(ids[:, :-1]).logits[:, PROMPT - 1 :]
        loss = nn.functional.cross_entropy(logits.flatten(0, 1), ids[:, PROMPT:].flatten())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


if __name__ == "__main__":
    torch.manual_seed(0)
    shape = {"hidden_size": 128, "intermediate_size": 256, "num_hidden_layers": 4, "vocab_size": 256}
    heads = {"num_attention_heads": 8, "num_key_value_heads": 4, "max_position_embeddings": 64}
    ends = {"bos_token_id": 1, "eos_token_id": None}
    model = LlamaForCausalLM(LlamaConfig(**shape, **heads, **ends))
    train(model)
    model.eval()
    model.save_pretrained(HERE / "checkpoint")
    np.savez_compressed(HERE / "calibration.npz", **prompts(model, 1, 32))
    np.savez_compressed(HERE / "evaluation.npz", **prompts(model, 2, 64))
