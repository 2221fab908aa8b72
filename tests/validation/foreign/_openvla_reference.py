"""Make an OpenVLA checkpoint with random weights from timm and transformers, and record what these two do with it.

    python _openvla_reference.py FOLDER [--observations 50] [--towers dinosiglip|siglip|dinoclip]

Needs timm 0.9.16 (the release that OpenVLA names), transformers, torchvision and safetensors; no vlatool. Writes
``FOLDER/checkpoint``, laid out as openvla/openvla-7b is, and ``FOLDER/episode.npz``: frames (N, 120, 160, 3) uint8,
instructions, and the token ids and actions (N, 7) of greedy ``generate`` and OpenVLA's arithmetic of actions.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import timm
import torch
from PIL import Image
from safetensors.torch import save_file
from tokenizers import Tokenizer, decoders, models, normalizers, processors
from torchvision.transforms import functional as pictures
from transformers import LlamaConfig, LlamaForCausalLM

# mypy: ignore-errors

VOCABULARY, MULTIPLE, BINS, PAD = 32064, 64, 256, 32000
WIDTH, SIZE, ACTIONS = 64, 56, 7
DINO, SIGLIP, CLIP = (
    "vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224", "vit_large_patch14_clip_336.openai"
)  # fmt: skip
TOWERS = {"dinosiglip": (DINO, SIGLIP), "siglip": (SIGLIP,), "dinoclip": (DINO, CLIP)}
BACKBONES = {"dinosiglip": "dinosiglip-vit-so-224px", "siglip": "siglip-vit-so400m", "dinoclip": "dinoclip-vit-l-336px"}
MEANS = {DINO: [0.485, 0.456, 0.406], SIGLIP: [0.5] * 3, CLIP: [0.481, 0.458, 0.408]}
STDS = {DINO: [0.229, 0.224, 0.225], SIGLIP: [0.5] * 3, CLIP: [0.269, 0.261, 0.276]}
TEXTS = ("pick up the Red cup", "put the spoon on the towel", "open the drawer", "move the pot, slowly, to the left")


def tower(name):
    """Return a small vision transformer of timm, with weights far from their start."""
    more = {"act_layer": "quick_gelu"} if name == CLIP else {}
    model = timm.create_model(
        name, pretrained=False, num_classes=0, img_size=SIZE, embed_dim=32 if name == DINO else 48, depth=3,
        num_heads=16, **more,
    )  # fmt: skip
    with torch.no_grad():
        for key, parameter in model.named_parameters():
            if parameter.ndim > 1 or "token" in key:
                parameter.normal_(0, parameter[0].numel() ** -0.5 if parameter.ndim > 1 else 0.5)
            else:
                parameter.add_(torch.randn_like(parameter) * 0.1)
    return model.eval()


class Reference(torch.nn.Module):
    """The parts of a policy, under the names that its checkpoint has for them."""

    def __init__(self, names):
        super().__init__()
        self.names = names
        self.vision_backbone = torch.nn.Module()
        for attribute, name in zip(("featurizer", "fused_featurizer"), names, strict=False):
            setattr(self.vision_backbone, attribute, tower(name))
        width = sum(part.embed_dim for part in self.vision_backbone.children())
        sizes = [width, 4 * width, WIDTH, WIDTH] if len(names) > 1 else [width, WIDTH, WIDTH]
        self.projector = torch.nn.Module()
        for number in range(1, len(sizes)):
            setattr(self.projector, f"fc{number}", torch.nn.Linear(sizes[number - 1], sizes[number]))
        self.language_model = LlamaForCausalLM(
            LlamaConfig(
                vocab_size=VOCABULARY, hidden_size=WIDTH, intermediate_size=160, num_hidden_layers=3,
                num_attention_heads=4, num_key_value_heads=2, initializer_range=0.15, pad_token_id=PAD,
            )
        )  # fmt: skip
        with torch.no_grad():  # tokens of actions win, as they do after training
            self.language_model.lm_head.weight[VOCABULARY - MULTIPLE - BINS : VOCABULARY - MULTIPLE] *= 8
        self.eval()

    def patches(self, frame):
        """Return what a frame is to the language model."""
        image = Image.fromarray(frame).resize((SIZE, SIZE), Image.BICUBIC)
        features = []
        for part, name in zip(self.vision_backbone.children(), self.names, strict=True):
            pixels = pictures.normalize(pictures.to_tensor(image), MEANS[name], STDS[name])[None]
            features += part.get_intermediate_layers(pixels, n={len(part.blocks) - 2})
        tokens = torch.cat(features, dim=2)
        for number, layer in enumerate(self.projector.children()):
            tokens = layer(torch.nn.functional.gelu(tokens) if number else tokens)
        return tokens

    def tokens(self, frame, ids):
        """Return the ids of the action, by greedy ``generate``."""
        embedded = self.language_model.get_input_embeddings()(torch.tensor([ids]))
        embeddings = torch.cat([embedded[:, :1], self.patches(frame), embedded[:, 1:]], dim=1)
        seen = torch.ones(embeddings.shape[:2], dtype=torch.long)
        return self.language_model.generate(
            inputs_embeds=embeddings, attention_mask=seen, max_new_tokens=ACTIONS, min_new_tokens=ACTIONS,
            do_sample=False,
        )[0].numpy()  # fmt: skip


def tokenizer():
    """Return a tokenizer that does as Llama's: a mark for each space, bytes for what it does not know, <s> in front."""
    words = {"<unk>": 0, "<s>": 1, "</s>": 2, **{f"<0x{byte:02X}>": 3 + byte for byte in range(256)}}
    for letter in "▁abcdefghijklmnopqrstuvwxyzIOWR:?,.":
        words.setdefault(letter, len(words))
    merges = [("▁", "t"), ("▁t", "o")]
    for word in ("▁What", "▁action", "▁should", "▁the", "▁robot", "▁take"):
        pairs = ((word[:end], word[end]) for end in range(1, len(word)))
        merges += [pair for pair in pairs if pair not in merges]
    for pair in merges:
        words.setdefault("".join(pair), len(words))
    made = Tokenizer(models.BPE(words, merges, unk_token="<unk>", byte_fallback=True, fuse_unk=True))
    made.normalizer = normalizers.Sequence([normalizers.Prepend("▁"), normalizers.Replace(" ", "▁")])
    made.post_processor = processors.TemplateProcessing(single="<s> $A", special_tokens=[("<s>", 1)])
    made.decoder = decoders.ByteFallback()
    return made


def write(model, folder, towers):
    """Write the checkpoint in two shards, with the factor of a branch named as OpenVLA names it."""
    folder.mkdir(parents=True)
    state = {key.replace(".gamma", ".scale_factor"): value.contiguous() for key, value in model.state_dict().items()}
    files = {key: f"model-0000{1 + key.startswith('language')}-of-00002.safetensors" for key in state}
    for file in set(files.values()):
        save_file({key: value for key, value in state.items() if files[key] == file}, folder / file)
    index = {"metadata": {}, "weight_map": files}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    generator = np.random.default_rng(3)
    low = generator.uniform(-1, 0, ACTIONS)
    action = {"q01": low.tolist(), "q99": (low + generator.uniform(0.1, 2, ACTIONS)).tolist()}
    action |= {"mask": [True] * 6 + [False]}
    fused, names = len(model.names) > 1, model.names
    config = {
        "model_type": "openvla", "architectures": ["OpenVLAForActionPrediction"],
        "auto_map": {"AutoModelForVision2Seq": "modeling_prismatic.OpenVLAForActionPrediction"},
        "vision_backbone_id": BACKBONES[towers], "llm_backbone_id": "llama2-7b-pure", "timm_model_ids": list(names),
        "timm_override_act_layers": ["quick_gelu" if name == CLIP else None for name in names],
        "image_sizes": [SIZE] * len(names), "use_fused_vision_backbone": fused, "image_resize_strategy": "resize-naive",
        "n_action_bins": BINS, "pad_to_multiple_of": MULTIPLE, "pad_token_id": PAD,
        "norm_stats": {"bridge_orig": {"action": action}},
        "text_config": {
            "model_type": "llama", "vocab_size": VOCABULARY, "pad_token_id": PAD, "hidden_size": WIDTH,
            "intermediate_size": 160, "num_hidden_layers": 3, "num_attention_heads": 4, "num_key_value_heads": 2,
        },
    }  # fmt: skip
    about = {
        "image_resize_strategy": "resize-naive", "input_sizes": [[3, SIZE, SIZE]] * len(names),
        "interpolations": ["bicubic"] * len(names), "means": [MEANS[name] for name in names],
        "stds": [STDS[name] for name in names], "use_fused_vision_backbone": fused,
    }  # fmt: skip
    (folder / "config.json").write_text(json.dumps(config, indent=1))
    (folder / "preprocessor_config.json").write_text(json.dumps(about, indent=1))
    (folder / "modeling_prismatic.py").write_text("raise SystemExit('this file is code, which nobody runs')\n")
    tokenizer().save(str(folder / "tokenizer.json"))
    return action


def main(folder, observations, towers):
    """Write the checkpoint and what its policy does."""
    torch.manual_seed(0)
    model = Reference(TOWERS[towers])
    action = write(model, folder / "checkpoint", towers)
    edges = np.linspace(-1, 1, BINS)
    centres, text = (edges[:-1] + edges[1:]) / 2, tokenizer()
    low, high, mask = (np.array(action[name]) for name in ("q01", "q99", "mask"))
    generator = np.random.default_rng(1)
    frames = generator.integers(0, 256, (observations, 12, 16, 3), dtype=np.uint8).repeat(10, 1).repeat(10, 2)
    texts, tokens, actions = [], [], []
    with torch.no_grad():
        for number in range(observations):
            texts.append(TEXTS[number % len(TEXTS)])
            ids = text.encode(f"In: What action should the robot take to {texts[-1].lower()}?\nOut:").ids
            ids = ids if ids[-1] == 29871 else [*ids, 29871]
            tokens.append(model.tokens(frames[number], ids))
            normalised = centres[np.clip(VOCABULARY - MULTIPLE - tokens[-1] - 1, 0, len(centres) - 1)]
            actions.append(np.where(mask, 0.5 * (normalised + 1) * (high - low) + low, normalised))
    np.savez(folder / "episode.npz", image=frames, instruction=np.array(texts), tokens=tokens, action=actions)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--observations", type=int, default=50)
    parser.add_argument("--towers", choices=tuple(TOWERS), default="dinosiglip")
    given = parser.parse_args()
    main(given.folder.resolve(), given.observations, given.towers)
