"""What somebody has: a CLIP (random weights, small) as an ONNX file, and what transformers gives on recordings."""

from pathlib import Path

import numpy as np
import torch
from torch import nn
from transformers import CLIPConfig, CLIPModel

HERE = Path(__file__).parent


class Similarity(nn.Module):
    """Pixels (B, 3, 64, 64) and ids (1, 12) to the similarity (B, 1) of picture and text."""

    def __init__(self, clip):
        super().__init__()
        self.clip = clip

    def forward(self, pixels, ids):
        return self.clip(input_ids=ids, pixel_values=pixels).logits_per_image


def observations(network, seed, count):
    """Random pixels and ids, and the similarity that the network gives."""
    random = np.random.default_rng(seed)
    pixels = random.normal(size=(count, 3, 64, 64)).astype(np.float32)
    ids = np.concatenate([random.integers(3, 98, (count, 11)), np.full((count, 1), 99)], axis=1)
    with torch.no_grad():
        pairs = zip(torch.tensor(pixels), torch.tensor(ids), strict=True)
        action = np.array([network(one[None], words[None])[0].numpy() for one, words in pairs])
    return {"pixels": pixels, "ids": ids, "action": action}


if __name__ == "__main__":
    torch.manual_seed(0)
    tower = {"hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 3, "num_attention_heads": 4}
    text = {**tower, "vocab_size": 100, "max_position_embeddings": 12, "bos_token_id": 1, "eos_token_id": 99}
    config = CLIPConfig(
        text_config=text, vision_config={**tower, "image_size": 64, "patch_size": 16}, projection_dim=32
    )
    network = Similarity(CLIPModel(config)).eval()
    example = (torch.zeros(1, 3, 64, 64), torch.full((1, 12), 99))
    names = {"input_names": ["pixels", "ids"], "output_names": ["action"]}
    torch.onnx.export(network, example, HERE / "clip.onnx", dynamo=True, external_data=False, **names)
    np.savez_compressed(HERE / "calibration.npz", **observations(network, 1, 32))
    np.savez_compressed(HERE / "evaluation.npz", **observations(network, 2, 32))
