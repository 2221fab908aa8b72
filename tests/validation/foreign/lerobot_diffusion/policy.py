from pathlib import Path

import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from safetensors.torch import load_file
from torch import nn

CHECKPOINT = Path(__file__).parent / "checkpoint"


class Encode(nn.Module):
    """State (1, 2, 6), normalised, and pictures (1, 2, 96, 96, 3) uint8 to the condition of every denoising step."""

    def __init__(self, diffusion, statistics):
        super().__init__()
        self.diffusion = diffusion
        self.register_buffer("mean", statistics["observation.images.front.mean"])
        self.register_buffer("std", statistics["observation.images.front.std"])

    def forward(self, state, front):
        pictures = (front.permute(0, 1, 4, 2, 3).float() / 255 - self.mean) / self.std
        batch = {"observation.state": state, "observation.images": pictures.unsqueeze(2)}
        return self.diffusion._prepare_global_conditioning(batch)


class Denoise(nn.Module):
    """One step of DDIM without noise of its own: sample (1, 16, 6) at a time (1,) to the next one, and its actions."""

    def __init__(self, diffusion):
        super().__init__()
        scheduler = diffusion.noise_scheduler
        self.unet, self.config = diffusion.unet, diffusion.config
        self.stride = scheduler.config.num_train_timesteps // diffusion.num_inference_steps
        ahead = torch.ones(self.stride) * scheduler.final_alpha_cumprod
        self.register_buffer("alphas", torch.cat([ahead, scheduler.alphas_cumprod]))

    def forward(self, sample, time, condition):
        here = time.long()
        noise = self.unet(sample, here, global_cond=condition)
        now, then = self.alphas[here + self.stride], self.alphas[here]
        clean = ((sample - (1 - now).sqrt() * noise) / now.sqrt()).clamp(-1, 1)
        sample = then.sqrt() * clean + (1 - then).sqrt() * noise
        first = self.config.n_obs_steps - 1
        return sample, sample[:, first : first + self.config.n_action_steps]


def make():
    policy = DiffusionPolicy.from_pretrained(CHECKPOINT)
    (file,) = CHECKPOINT.glob("policy_preprocessor_step_*_normalizer_processor.safetensors")
    return {"encode": Encode(policy.diffusion, load_file(file)), "denoise": Denoise(policy.diffusion)}
