"""Somebody's checkpoint: a small LeRobot SmolVLA (random weights), and what select_action() does on recordings."""

import os
from pathlib import Path

import numpy as np
import torch
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy
from made import JOINTS, SPREAD, batch, features, keep
from tokenizers import Tokenizer, models, pre_tokenizers
from transformers import (
    LlamaConfig,
    PreTrainedTokenizerFast,
    SmolVLMConfig,
    SmolVLMImageProcessor,
    SmolVLMProcessor,
    SmolVLMVideoProcessor,
)

HERE = Path(__file__).parent
SIDE, CHUNK = 64, 10
SPECIAL = ["<pad>", "<unk>", "<image>", "<fake_token_around_image>", "<global-img>", "<end_of_utterance>"]
WORDS = [*SPECIAL, "pick", "place", "the", "red", "green", "cup", "bowl", "up", "into"]


def backbone(folder):
    """A vision-language model of SmolVLM's kind, with its processor, small enough for a test."""
    words = Tokenizer(models.WordLevel({word: index for index, word in enumerate(WORDS)}, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    extra = {"image_token": SPECIAL[2], "fake_image_token": SPECIAL[3], "global_image_token": SPECIAL[4]}
    extra["end_of_utterance_token"] = SPECIAL[5]
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=words, pad_token="<pad>", unk_token="<unk>", extra_special_tokens=extra, model_max_length=64
    )
    text = {"hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 4, "num_attention_heads": 4}
    heads = {"num_key_value_heads": 2, "head_dim": 16, "vocab_size": 32, "pad_token_id": 0}
    vision = {"hidden_size": 48, "intermediate_size": 96, "num_hidden_layers": 2, "num_attention_heads": 4}
    vision |= {"image_size": SIDE, "patch_size": 16}
    config = SmolVLMConfig(
        vision_config=vision, text_config=LlamaConfig(**text, **heads).to_dict(), scale_factor=2, image_token_id=2
    )
    config.save_pretrained(folder)
    pictures = SmolVLMImageProcessor(size={"longest_edge": SIDE}, max_image_size={"longest_edge": SIDE})
    template = "{% for message in messages %}{{ message['content'] }}{% endfor %}"
    SmolVLMProcessor(pictures, tokenizer, SmolVLMVideoProcessor(), chat_template=template).save_pretrained(folder)


def config():
    sizes = {"chunk_size": CHUNK, "n_action_steps": CHUNK, "num_steps": 5, "num_vlm_layers": 4}
    model = {"vlm_model_name": "backbone", "resize_imgs_with_padding": (SIDE, SIDE), "device": "cpu"}
    return SmolVLAConfig(**features(SIDE, SIDE), **sizes, **model)


def chunk(policy, before, after, state, front, instruction, noise):
    """One chunk (10, 6) as LeRobot's control loop takes it: calls of select_action()."""
    seen = before(batch(state, front, task=str(instruction)))
    policy.reset()
    calls = (policy.select_action(dict(seen), noise=torch.tensor(noise)) for _ in range(CHUNK))
    return np.stack([after(action)[0].numpy() for action in calls])


def recording(policy, before, after, seed, count):
    """Random joints, pictures and sentences, the noise, and the chunks that the policy gives."""
    random = np.random.default_rng(seed)
    state = random.normal(size=(count, JOINTS)).astype(np.float32) * np.linspace(5, 25, JOINTS, dtype=np.float32)
    front = random.integers(0, 256, (count, 4, 4, 3), np.uint8).repeat(16, axis=1).repeat(16, axis=2)
    said = [f"pick up the {random.choice(['red', 'green'])} {random.choice(['cup', 'bowl'])}" for _ in range(count)]
    noise = random.normal(size=(count, 1, CHUNK, 32)).astype(np.float32)
    rows = zip(state, front, said, noise, strict=True)
    action = [chunk(policy, before, after, *row) for row in rows]
    return {"state": state, "front": front, "instruction": np.array(said), "action": np.array(action), "noise": noise}


if __name__ == "__main__":
    os.chdir(HERE)  # the checkpoint names its backbone relative to here
    torch.manual_seed(0)
    backbone("backbone")
    policy = SmolVLAPolicy(config()).eval()
    keep(HERE, policy, {"observation.state": SPREAD, "action": SPREAD}, recording, noise="x")
