"""Make a LeRobot checkpoint with random weights, and record what its policy does; run in the Python that has LeRobot.

    python _lerobot_checkpoints.py KIND[-relative] FOLDER [--small] [--steps N]

Writes ``FOLDER/checkpoint`` and ``FOLDER/episode.npz``: the observations of an episode (N, ...), the actions (N, A) of
``select_action`` with LeRobot's own processors around it, and the noise that each inference drew. The actions of a kind
``-relative`` are differences from the state but for the grippers; as in LeRobot's real-time chunking, all of a chunk
are added to the state that it was inferred for.
"""

import argparse
import os
import sys
from pathlib import Path
from unittest import mock

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors

JOINTS, TEXT_KINDS = 14, ("smolvla", "pi0", "pi05")
TEXTS = ("red cup", "green bowl", "cup into the bowl\n")


def features(height, width, cameras):
    """Return what goes in and out, as a configuration names it."""
    pictures = {f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, height, width)) for name in cameras}
    state = {"observation.state": PolicyFeature(FeatureType.STATE, (JOINTS,))}
    action = {"action": PolicyFeature(FeatureType.ACTION, (JOINTS,))}
    return {"input_features": {**state, **pictures}, "output_features": action, "device": "cpu"}


def act(small):
    """Return an ACT policy, in its default configuration (51.6 M parameters) or small."""
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    sizes = {"dim_model": 64, "n_heads": 4, "dim_feedforward": 128, "n_encoder_layers": 2, "chunk_size": 20}
    sizes = {**sizes, "n_action_steps": 10} if small else {"n_action_steps": 10}
    seen = features(96, 128, ["top"]) if small else features(480, 640, ["top"])
    return ACTPolicy(ACTConfig(**seen, **sizes, pretrained_backbone_weights=None))


def diffusion(kind, small):
    """Return a Diffusion Policy of two cameras with that scheduler."""
    from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    sizes = {"down_dims": (64, 128)} if small else {}
    config = DiffusionConfig(
        **features(96, 96, ["front", "wrist"]), **sizes, noise_scheduler_type=kind, pretrained_backbone_weights=None,
        crop_shape=(84, 84), horizon=16, n_action_steps=8, num_inference_steps=10 if kind == "DDIM" else 20,
    )  # fmt: skip
    return DiffusionPolicy(config)


def smolvla(folder):
    """Return a small SmolVLA, as the foreign policy of that name has it, with its backbone beside the checkpoint."""
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    sys.path += [str(Path(__file__).with_name(name)) for name in ("lerobot_smolvla", "_lerobot")]
    from original import backbone, config

    os.chdir(folder)  # the checkpoint names its backbone relative to where it lies
    backbone("backbone")
    return SmolVLAPolicy(config())


def pi0(folder, kind, small):
    """Return a pi0 or pi0.5, with a tokenizer beside the checkpoint in the place of PaliGemma's."""
    from lerobot.policies.pi0 import processor_pi0
    from lerobot.policies.pi0.configuration_pi0 import PI0Config
    from lerobot.policies.pi0.modeling_pi0 import PI0Policy
    from lerobot.policies.pi05 import processor_pi05
    from lerobot.policies.pi05.configuration_pi05 import PI05Config
    from lerobot.policies.pi05.modeling_pi05 import PI05Policy
    from tokenizers import Regex, Tokenizer, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    os.chdir(folder)
    names = ["<pad>", "<bos>", "<unk>", "\n", *["pick", "up", "the", "red", "green", "cup", "bowl", "into"]]
    names += ["Task", "State", "Action", *":,;-0123456789"]
    words = Tokenizer(models.WordLevel({word: index for index, word in enumerate(names)}, unk_token="<unk>"))
    pieces = pre_tokenizers.Split(Regex(r"[0-9]|[A-Za-z]+|[^0-9A-Za-z]"), "isolated")
    words.pre_tokenizer = pre_tokenizers.Sequence([pre_tokenizers.Split(" ", "removed"), pieces])
    words.post_processor = processors.TemplateProcessing(single="<bos> $A", special_tokens=[("<bos>", 1)])
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=words, pad_token="<pad>", unk_token="<unk>")
    tokenizer.save_pretrained("tokenizer")
    step = processor_pi0.TokenizerProcessorStep
    for module in (processor_pi0, processor_pi05):
        module.TokenizerProcessorStep = lambda **more: step(**{**more, "tokenizer_name": "tokenizer"})
    sizes = {"chunk_size": 10, "n_action_steps": 5, "num_inference_steps": 5, "image_resolution": (56, 56)}
    policy_type, config_type = {"pi0": (PI0Policy, PI0Config), "pi05": (PI05Policy, PI05Config)}[kind]
    config = config_type(**features(48, 64, ["front", "wrist"]), **(sizes if small else {"n_action_steps": 10}))
    policy = policy_type(config)
    with torch.no_grad():
        for name, parameter in policy.named_parameters():
            if "norm" in name and parameter.ndim == 1:
                parameter.add_(torch.randn_like(parameter) * 0.1)
    return policy


def statistics(config):
    """Return statistics as a dataset has them; one joint never moved."""
    generator = torch.Generator().manual_seed(1)
    found = {}
    for key in (*config.input_features, "action"):
        if "images" in key:
            mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
            found[key] = {"mean": mean.reshape(3, 1, 1), "std": std.reshape(3, 1, 1)}
            continue
        shape = {**config.input_features, **config.output_features}[key].shape
        mean, std = torch.randn(shape, generator=generator), torch.rand(shape, generator=generator) + 0.1
        std[3] = 0
        low, high = mean - 2 * std, mean + 2 * std
        found[key] = {"mean": mean, "std": std, "min": low, "max": high, "q01": low, "q99": high}
    return found


def observation(config, generator, low, high):
    """Return one raw observation: pictures (H, W, 3) uint8 and joints in physical units.

    One joint never moves, and three are at the lower end, the middle and the upper end of what training had.
    """
    raw = {}
    for key, feature in config.input_features.items():
        if key in config.image_features:
            _, height, width = feature.shape
            raw[key] = torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8)
        else:
            raw[key] = torch.randn(feature.shape, generator=generator)
            raw[key][[3, 6]], raw[key][8], raw[key][13] = low[[3, 6]], (low[8] + high[8]) / 2, high[13]
    return raw


def processors(config, stats, relative):
    """Return what stands before and behind the policy, with relative actions where that is asked for."""
    from lerobot.processor import AbsoluteActionsProcessorStep, RelativeActionsProcessorStep

    before, after = make_pre_post_processors(config, dataset_stats=stats)
    if relative:
        names = [f"{side}_{joint}" for side in ("left", "right") for joint in (*map(str, range(6)), "Gripper")]
        step = RelativeActionsProcessorStep(enabled=True, exclude_joints=["gripper"], action_names=names)
        kinds = [type(each).__name__ for each in before.steps]
        before.steps.insert(kinds.index("NormalizerProcessorStep"), step)
        after.steps.insert(1, AbsoluteActionsProcessorStep(enabled=True, relative_step=step))
    return before, after


def main(kind, folder, small, steps):
    """Write the checkpoint and the episode."""
    relative, kind = kind.endswith("-relative"), kind.removesuffix("-relative")
    torch.manual_seed(0)
    folder.mkdir(parents=True, exist_ok=True)
    make = {"act": lambda: act(small), "smolvla": lambda: smolvla(folder)}
    make |= {pi: lambda: pi0(folder, kind, small) for pi in ("pi0", "pi05")}
    policy = make.get(kind, lambda: diffusion(kind.rpartition("-")[2].upper(), small))().eval()
    config, stats = policy.config, statistics(policy.config)
    before, after = processors(config, stats, relative)
    for part in (policy, before, after):
        part.save_pretrained(folder / "checkpoint")
    before, after = make_pre_post_processors(config, pretrained_path=folder / "checkpoint")
    anchors = [step for step in before.steps if type(step).__name__ == "RelativeActionsProcessorStep"]
    generator, drawn = torch.Generator().manual_seed(5), []

    def noise(shape, *_, **__):
        drawn.append(torch.empty(tuple(shape)).normal_(generator=generator))
        return drawn[-1]

    real = torch.randn
    replaced = [mock.patch.object(torch, "randn", lambda *args, **more: noise(more.get("size", args)))]
    if kind in TEXT_KINDS:
        policy.model.sample_noise = noise
    elif kind != "act":
        scheduler = sys.modules[type(policy.diffusion.noise_scheduler).__module__]
        replaced.append(mock.patch.object(scheduler, "randn_tensor", noise))
    seen, actions, counts, state = [], [], [], None
    policy.reset()
    with torch.no_grad():
        for _ in range(steps):
            raw = observation(config, generator, *(stats["observation.state"][side] for side in ("min", "max")))
            fed = {
                key: value.permute(2, 0, 1).float() / 255 if key in config.image_features else value
                for key, value in raw.items()
            }
            if kind in TEXT_KINDS:
                fed["task"] = raw["task"] = f"pick up the {TEXTS[len(seen) % len(TEXTS)]}"
            start = len(drawn)
            with mock.patch.object(torch, "randn", real):
                batch = before(fed)
            chosen = _with(replaced, policy, batch) if kind.startswith("diffusion") else policy.select_action(batch)
            for anchor in anchors:
                infers = len(seen) % config.n_action_steps == 0
                state = anchor._last_state if infers else state
                anchor._last_state = state
            actions.append(after(chosen)[0].numpy())
            counts.append(len(drawn) - start)
            seen.append(raw)
    rows = {key: np.array([raw[key] if key == "task" else raw[key].numpy() for raw in seen]) for key in seen[0]}
    noises = {f"noise_{number}": value.numpy() for number, value in enumerate(drawn)}
    np.savez(folder / "episode.npz", action=np.stack(actions), drawn=np.array(counts), **rows, **noises)


def _with(replaced, policy, batch):
    from contextlib import ExitStack

    with ExitStack() as stack:
        for each in replaced:
            stack.enter_context(each)
        return policy.select_action(batch)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    kinds = ("act", "diffusion-ddim", "diffusion-ddpm", *TEXT_KINDS)
    parser.add_argument("kind", choices=(*kinds, *(f"{kind}-relative" for kind in kinds)))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--steps", type=int, default=50)
    given = parser.parse_args()
    main(given.kind, given.folder.resolve(), given.small, given.steps)
