"""An OpenVLA checkpoint of a few thousand parameters, laid out as openvla/openvla-7b is."""

from __future__ import annotations

import copy
import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

VOCABULARY, ACTIONS, SIDE = 30016, 3, 4
CONFIG: dict[str, Any] = {
    "model_type": "openvla", "auto_map": {"AutoModelForVision2Seq": "modeling_prismatic.OpenVLAForActionPrediction"},
    "vision_backbone_id": "dinosiglip-vit-so-224px", "llm_backbone_id": "llama2-7b-pure",
    "timm_model_ids": ["vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224"],
    "timm_override_act_layers": [None, None], "image_sizes": [SIDE, SIDE], "use_fused_vision_backbone": True,
    "image_resize_strategy": "resize-naive", "n_action_bins": 256, "pad_to_multiple_of": 64, "pad_token_id": 30000,
    "norm_stats": {
        "bridge_orig": {"action": {"q01": [-1, 0, -3], "q99": [1, 0.5, 3], "mask": [True, True, False]}},
    },
    "text_config": {
        "model_type": "llama", "vocab_size": VOCABULARY, "hidden_size": 8, "intermediate_size": 12,
        "num_hidden_layers": 2, "num_attention_heads": 2, "num_key_value_heads": 1,
    },
}  # fmt: skip
PICTURES: dict[str, Any] = {
    "image_resize_strategy": "resize-naive", "interpolations": ["bicubic", "bicubic"],
    "means": [[0.485, 0.456, 0.406], [0.5, 0.5, 0.5]], "stds": [[0.229, 0.224, 0.225], [0.5, 0.5, 0.5]],
}  # fmt: skip
WORDS = [
    "<unk>",
    "<s>",
    *["In", ":", "What", "action", "should", "the", "robot", "take", "to", "?", "Out", "move", "lift", "Lift", "cup"],
]
TOKENIZER: dict[str, Any] = {
    "version": "1.0", "truncation": None, "padding": None, "added_tokens": [], "normalizer": None,
    "pre_tokenizer": {"type": "Whitespace"}, "decoder": None,
    "post_processor": {
        "type": "TemplateProcessing", "pair": [{"Sequence": {"id": "A", "type_id": 0}}],
        "single": [{"SpecialToken": {"id": "<s>", "type_id": 0}}, {"Sequence": {"id": "A", "type_id": 0}}],
        "special_tokens": {"<s>": {"id": "<s>", "ids": [1], "tokens": ["<s>"]}},
    },
    "model": {"type": "WordLevel", "vocab": {word: at for at, word in enumerate(WORDS)}, "unk_token": "<unk>"},
}  # fmt: skip
VISION, LANGUAGE = "model-00001-of-00002.safetensors", "model-00002-of-00002.safetensors"


Shapes = dict[str, tuple[int, ...]]


def tower(
    prefix: str, width: int, hidden: int, *, registers: int, scale: str, blocks: int = 2, patch: int = 2, grid: int = 2
) -> Shapes:
    """Return the shapes of a vision transformer under timm's names, with the prefix of OpenVLA."""
    shapes: Shapes = {"patch_embed.proj.weight": (width, 3, patch, patch), "patch_embed.proj.bias": (width,)}
    shapes |= {"pos_embed": (1, grid**2, width), "norm.weight": (width,), "norm.bias": (width,)}
    if registers:
        shapes |= {"cls_token": (1, 1, width), "reg_token": (1, registers, width)}
    linear = {"attn.qkv": (3 * width, width), "attn.proj": (width, width)}
    linear |= {"mlp.fc1": (hidden, width), "mlp.fc2": (width, hidden)}
    block: Shapes = {f"{name}.weight": shape for name, shape in linear.items()}
    block |= {f"{name}.bias": shape[:1] for name, shape in linear.items()}
    block |= {f"{name}.{kind}": (width,) for name in ("norm1", "norm2") for kind in ("weight", "bias")}
    block |= {f"{name}.{scale}": (width,) for name in ("ls1", "ls2") if scale}
    shapes |= {f"blocks.{at}.{name}": shape for at in range(blocks) for name, shape in block.items()}
    return {f"vision_backbone.{prefix}.{name}": shape for name, shape in shapes.items()}


def projector(*widths: int) -> Shapes:
    """Return the shapes of the layers between the towers and the language model."""
    shapes: Shapes = {}
    for number, (before, after) in enumerate(itertools.pairwise(widths), 1):
        shapes |= {f"projector.fc{number}.weight": (after, before), f"projector.fc{number}.bias": (after,)}
    return shapes


def llama(vocabulary: int, width: int, hidden: int, keys: int, layers: int) -> Shapes:
    """Return the shapes of the language model under transformers' names."""
    layer: Shapes = {"self_attn.q_proj": (width, width), "self_attn.o_proj": (width, width)}
    layer |= {"self_attn.k_proj": (keys, width), "self_attn.v_proj": (keys, width)}
    layer |= {"mlp.gate_proj": (hidden, width), "mlp.up_proj": (hidden, width), "mlp.down_proj": (width, hidden)}
    layer |= {"input_layernorm": (width,), "post_attention_layernorm": (width,)}
    shapes: Shapes = {"model.embed_tokens.weight": (vocabulary, width), "model.norm.weight": (width,)}
    shapes |= {f"model.layers.{at}.{name}.weight": shape for at in range(layers) for name, shape in layer.items()}
    shapes["lm_head.weight"] = (vocabulary, width)
    return {f"language_model.{name}": shape for name, shape in shapes.items()}


def shapes() -> dict[str, Shapes]:
    """Return shard -> tensor -> shape."""
    vision = tower("featurizer", 16, 20, registers=4, scale="scale_factor")
    vision |= tower("fused_featurizer", 32, 24, registers=0, scale="")
    return {VISION: {**vision, **projector(48, 192, 8, 8)}, LANGUAGE: llama(VOCABULARY, 8, 12, keys=4, layers=2)}


def tensors() -> dict[str, dict[str, NDArray[np.float32]]]:
    """Return shard -> tensor -> seeded values."""
    drawn = np.random.default_rng(0)
    return {
        file: {
            name: drawn.normal(0, 1 if len(shape) == 1 else math.prod(shape[1:]) ** -0.5, shape).astype(np.float32)
            for name, shape in named.items()
        }
        for file, named in shapes().items()
    }


def parts() -> dict[str, Any]:
    """Return the files of a checkpoint: name -> JSON, tensors, or bytes."""
    shards = tensors()
    files = {name: file for file, named in shards.items() for name in named}
    return {
        "config.json": copy.deepcopy(CONFIG), "preprocessor_config.json": copy.deepcopy(PICTURES),
        "tokenizer.json": copy.deepcopy(TOKENIZER), "model.safetensors.index.json": {"weight_map": files}, **shards,
        "modeling_prismatic.py": b"open('pwned', 'w')\n",
    }  # fmt: skip
