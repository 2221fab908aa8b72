"""Trace the policy of a LeRobot checkpoint, in the Python that has LeRobot; run as a script, without vlatool.

    python _lerobot_child.py REQUEST.json

Reads a request (``checkpoint``, ``out``, ``pictures``: camera -> mean and std, or null), loads the policy with LeRobot,
and writes into ``out`` one ``GRAPH.pt2`` (``torch.export``) for each graph, and ``facts.json``: its inputs and
outputs, the program that runs them, and versions. The graphs take pictures as cameras give them, (1, height, width, 3)
uint8, and every vector as LeRobot's preprocessor normalised it. They are compared with the policy's own inference.
"""

import json
import os
import re
import sys
from pathlib import Path

import torch
from torch import nn

# mypy: ignore-errors

TOLERANCE = 1e-4
"""Largest relative L2 difference between the graphs and the policy's own inference."""
TRIALS = 3
EMPTY = "observation.images.empty_camera_"
"""Cameras that a policy of several fills with a constant."""
STATE, TEXT = "observation.state", "task"
"""How LeRobot calls joints and instruction."""
STATE_IN_PROMPT = "pi05_prepare_state_tokenizer_processor_step"
TASKS = ("pick up the red cup", "  open_the {state} drawer\n", "a\nb {}")


def identifier(key):
    """Return the name of a graph's input for the key of an observation; not a keyword, whatever the key is."""
    return "in_" + re.sub(r"\W", "_", key, flags=re.ASCII)


class Pictures(nn.Module):
    """Pictures of a camera, uint8 (..., height, width, 3), as LeRobot's preprocessor hands them on: (..., 3, h, w)."""

    def __init__(self, statistics):
        super().__init__()
        for name, values in (statistics or {"mean": [0.0] * 3, "scale": [1.0] * 3}).items():
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32).reshape(-1, 1, 1))

    def forward(self, frames):
        channels_first = frames.transpose(-1, -3).transpose(-1, -2)
        return (channels_first.float() / 255 - self.mean) / self.scale


class Observation(nn.Module):
    """Positional inputs as the batch that a LeRobot policy takes."""

    def __init__(self, config, request):
        super().__init__()
        self.keys = [key for key in config.input_features if not key.startswith(EMPTY)]
        self.cameras = [key for key in config.image_features if not key.startswith(EMPTY)]
        self.pictures = nn.ModuleDict({identifier(key): Pictures(request["pictures"].get(key)) for key in self.cameras})

    def forward(self, values):
        named = dict(zip(self.keys, values, strict=True))
        return {key: self.pictures[identifier(key)](named[key]) if key in self.cameras else named[key] for key in named}


class Act(nn.Module):
    """One inference of ACT: a chunk of normalised actions. The encoder of its VAE is for training alone."""

    def __init__(self, policy, observation):
        super().__init__()
        self.model, self.observation, self.cameras = policy.model, observation, observation.cameras

    def forward(self, *values):
        batch = self.observation(values)
        if self.cameras:
            batch["observation.images"] = [batch[key] for key in self.cameras]
        return self.model(batch)[0]


def act(policy, observation, values, out):
    """Return the graphs of ACT with an example of their inputs, and the program."""
    names = [identifier(key) for key in observation.keys]
    program = [
        {"graph": "main", "feeds": dict(zip(names, observation.keys, strict=True)), "gives": {"action": "action"}}
    ]
    return {"main": (Act(policy, observation), names, values, ["action"])}, program, policy.config.chunk_size


class Condition(nn.Module):
    """The last observations of a diffusion policy to the condition of every denoising step."""

    def __init__(self, policy, observation):
        super().__init__()
        self.diffusion, self.observation, self.cameras = policy.diffusion, observation, observation.cameras

    def forward(self, *values):
        batch = self.observation(values)
        if self.cameras:
            batch["observation.images"] = torch.stack([batch[key] for key in self.cameras], dim=2)
        return self.diffusion._prepare_global_conditioning(batch)


class Denoise(nn.Module):
    """One step of DDIM or DDPM (Song et al. 2021, Ho et al. 2020), with the coefficients of its scheduler as inputs.

    sample: (1, horizon, A). clean, noise, sample coefficients and the roots of the schedule: (1,). fresh: noise of all
    steps, (steps, 1, horizon, A), of which ``index`` is added; not there for DDIM.
    """

    def __init__(self, policy):
        super().__init__()
        self.unet, self.config = policy.diffusion.unet, policy.config
        self.limit = policy.diffusion.noise_scheduler.config.clip_sample_range if policy.config.clip_sample else None

    def forward(
        self, sample, time, signal, spread, to_clean, to_noise, to_sample, condition, index=None, sigma=None, fresh=None
    ):
        answer = self.unet(sample, time.long(), global_cond=condition)
        if self.config.prediction_type == "epsilon":
            noise, clean = answer, (sample - spread * answer) / signal
        else:
            noise, clean = (sample - signal * answer) / spread, answer
        if self.limit is not None:
            clean = clean.clamp(-self.limit, self.limit)
        following = to_clean * clean + to_noise * noise + to_sample * sample
        if fresh is not None:
            following = following + sigma * fresh.index_select(0, index.long())[0]
        first = self.config.n_obs_steps - 1
        return following, following[:, first : first + self.config.n_action_steps]


def schedule_of(scheduler, steps):
    """Return what each step of a scheduler multiplies by: name -> a number for each step."""
    scheduler.set_timesteps(steps)
    times = [int(time) for time in scheduler.timesteps]
    stride, alphas = scheduler.config.num_train_timesteps // steps, scheduler.alphas_cumprod.double()
    implicit = type(scheduler).__name__ == "DDIMScheduler"
    last = float(scheduler.final_alpha_cumprod) if implicit else 1.0
    rows = []
    for time in times:
        now, then = float(alphas[time]), float(alphas[time - stride]) if time >= stride else last
        kept = now / then
        variance = max((1 - then) / (1 - now) * (1 - kept), 1e-20)
        if implicit:
            weights = (then**0.5, (1 - then) ** 0.5, 0.0, 0.0)
        else:
            weights = (
                then**0.5 * (1 - kept) / (1 - now),
                0.0,
                kept**0.5 * (1 - then) / (1 - now),
                variance**0.5 * (time > 0),
            )
        rows.append((float(time), now**0.5, (1 - now) ** 0.5, *weights))
    names = ("time", "signal", "spread", "to_clean", "to_noise", "to_sample", "sigma")
    return {name: [row[index] for row in rows] for index, name in enumerate(names)}, implicit


def diffusion(policy, observation, values, out):
    """Return the graphs of a diffusion policy with an example of their inputs, and the program."""
    config, model = policy.config, policy.diffusion
    if config.noise_scheduler_type not in ("DDIM", "DDPM"):
        raise SystemExit(f"the noise scheduler {config.noise_scheduler_type} is not known; known: DDIM, DDPM")
    steps = model.num_inference_steps
    schedule, implicit = schedule_of(model.noise_scheduler, steps)
    names = [identifier(key) for key in observation.keys]
    encode = Condition(policy, observation)
    with torch.no_grad():
        condition = encode(*values)
    shape = [1, config.horizon, config.action_feature.shape[0]]
    numbers = {name: torch.tensor([each[0]]) for name, each in schedule.items() if name != "sigma"}
    examples = {"sample": torch.zeros(shape), **numbers, "condition": condition}
    draws = {"sample": {"shape": shape, "distribution": "normal"}}
    if not implicit:
        schedule["index"] = [float(number) for number in range(steps)]
        examples |= {"index": torch.zeros(1), "sigma": torch.zeros(1), "fresh": torch.zeros([steps, *shape])}
        draws["fresh"] = {"shape": [steps, *shape], "distribution": "normal"}
    else:
        del schedule["sigma"]
    program = [
        {
            "graph": "encode", "feeds": dict(zip(names, observation.keys, strict=True)),
            "gives": {"condition": "condition"},
        },
        {
            "graph": "denoise", "feeds": {name: name for name in examples},
            "gives": {"following": "following", "action": "action"}, "repeat": steps, "carry": {"following": "sample"},
            "schedule": schedule, "noise": draws,
        },
    ]  # fmt: skip
    graphs = {
        "encode": (encode, names, values, ["condition"]),
        "denoise": (Denoise(policy), list(examples), list(examples.values()), ["following", "action"]),
    }
    return graphs, program, config.n_action_steps


class Prefix(nn.Module):
    """Pictures, state and instruction to the keys and values of every layer, and which positions are padding."""

    def __init__(self, policy, observation, pad):
        super().__init__()
        self.model, self.observation, self.pad, self.policy = policy.model, observation, pad, [policy]

    def forward(self, *values):
        from lerobot.policies.smolvla.modeling_smolvla import make_att_2d_masks

        *features, ids = values
        batch, (policy,) = self.observation(features), self.policy
        pictures, present = policy.prepare_images(batch)
        embedded, pads, attends = self.model.embed_prefix(
            pictures, present, ids, ids != self.pad, state=policy.prepare_state(batch)
        )
        _, cache = self.model.vlm_with_expert.forward(
            attention_mask=make_att_2d_masks(pads, attends), position_ids=torch.cumsum(pads, dim=1) - 1,
            past_key_values=None, inputs_embeds=[embedded, None], use_cache=True,
        )  # fmt: skip
        keys, values = ([getattr(layer, name) for layer in cache.layers] for name in ("keys", "values"))
        return torch.stack(keys), torch.stack(values), pads


class PiPrefix(nn.Module):
    """Pictures and prompt of pi0 or pi0.5 to the keys and values of every layer, and which positions are there."""

    def __init__(self, policy, observation, pad):
        super().__init__()
        self.model, self.observation, self.pad, self.policy = policy.model, observation, pad, [policy]

    def forward(self, *values):
        from lerobot.policies.common.vla_utils import make_att_2d_masks, prepare_attention_masks_4d

        *frames, ids = values
        see = self.observation.pictures
        batch = {key: see[identifier(key)](frame) for key, frame in zip(self.observation.cameras, frames, strict=True)}
        pictures, present = self.policy[0]._preprocess_images(batch)
        embedded, pads, attends = self.model.embed_prefix(pictures, present, ids, ids != self.pad)
        _, cache = self.model.paligemma_with_expert.forward(
            attention_mask=prepare_attention_masks_4d(make_att_2d_masks(pads, attends)),
            position_ids=torch.cumsum(pads, dim=1) - 1, past_key_values=None, inputs_embeds=[embedded, None],
            use_cache=True,
        )  # fmt: skip
        keys, values = ([getattr(layer, name) for layer in cache.layers] for name in ("keys", "values"))
        return torch.stack(keys), torch.stack(values), pads


class Flow(nn.Module):
    """One Euler step of flow matching: x (1, chunk, padded width) at a time (1,) to the next x, and its actions.

    The state (1, S), normalised, is an input of pi0's step; SmolVLA's prefix has it.
    """

    def __init__(self, policy):
        super().__init__()
        self.model, self.width, self.policy = policy.model, policy.config.action_feature.shape[0], [policy]

    def forward(self, x, time, interval, keys, values, pads, state=None):
        from transformers import DynamicCache

        more = {} if state is None else {"state": self.policy[0].prepare_state({STATE: state})}

        cache = DynamicCache()
        for layer in range(keys.shape[0]):
            cache.update(keys[layer], values[layer], layer)
        velocity = self.model.denoise_step(x_t=x, prefix_pad_masks=pads, past_key_values=cache, timestep=time, **more)
        x = x + interval * velocity
        return x, x[:, :, : self.width]


def steps_of(policy):
    """Return the steps of the checkpoint's own preprocessor: registry name -> configuration."""
    steps = json.loads(Path(policy.config.pretrained_path, "policy_preprocessor.json").read_text())["steps"]
    return {step["registry_name"]: step["config"] for step in steps}


def tokenizer_name(policy):
    """Return the tokenizer that the checkpoint's own processor names."""
    return steps_of(policy)["tokenizer_processor"]["tokenizer_name"]


def prompts(policy, generator):
    """Return what this LeRobot makes of instructions and normalised states: (task, state, prompt) of each."""
    from lerobot.processor import ProcessorStepRegistry, TransitionKey

    if STATE_IN_PROMPT not in steps_of(policy):
        return []
    step = ProcessorStepRegistry.get(STATE_IN_PROMPT)(**steps_of(policy)[STATE_IN_PROMPT])
    width, found = policy.config.input_features[STATE].shape[0], []
    for task, scale in zip(TASKS, (0.6, 1.0, 0.3), strict=True):
        state = (torch.randn(1, width, generator=generator) * scale * 128).round() / 128  # edges of bins
        said = {TransitionKey.OBSERVATION: {STATE: state}, TransitionKey.COMPLEMENTARY_DATA: {TEXT: [task]}}
        (prompt,) = step(said)[TransitionKey.COMPLEMENTARY_DATA][TEXT]
        found.append((task, state[0].tolist(), prompt))
    return found


def write_tokenizer(name, out, line_break=True):
    """Write the tokenizer of a policy, which may end a text with a line break, and return the id that pads."""
    from tokenizers import Regex, normalizers
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(name, local_files_only=True)
    inner, pad = tokenizer.backend_tokenizer, tokenizer.pad_token_id
    if line_break:
        ends = normalizers.Replace(Regex(r"(?<!\n)\z"), "\n")
        inner.normalizer = normalizers.Sequence([ends, *([inner.normalizer] if inner.normalizer else [])])
    inner.no_truncation()
    inner.enable_padding(pad_id=pad, pad_token=tokenizer.pad_token)
    inner.save(str(out / "tokenizer.json"))
    return pad


def smolvla(policy, observation, values, out):
    """Return the graphs of SmolVLA with an example of their inputs, and the program."""
    config = policy.config
    if config.n_obs_steps != 1:
        raise SystemExit("more than one observation step is not supported")
    prefix = Prefix(policy, observation, write_tokenizer(config.vlm_model_name, out))
    return flow(policy, prefix, dict(zip(observation.keys, values, strict=True)), config.num_steps)


def pi0(policy, observation, values, out):
    """Return the graphs of pi0 or pi0.5 with an example of their inputs, and the program.

    The state goes into every step of pi0, and into the prompt of pi0.5, which has no line break at its end.
    """
    config, model = policy.config, policy.model.paligemma_with_expert
    if config.n_obs_steps != 1:
        raise SystemExit("more than one observation step is not supported")
    for part in (model.paligemma.model.language_model, model.gemma_expert.model):
        part.config._attn_implementation = "eager"  # as its own inference has it
    in_prompt = config.type == "pi05"
    prefix = PiPrefix(policy, observation, write_tokenizer(tokenizer_name(policy), out, line_break=not in_prompt))
    named = dict(zip(observation.keys, values, strict=True))
    seen = {key: named[key] for key in observation.cameras}
    return flow(policy, prefix, seen, config.num_inference_steps, None if in_prompt else named)


def flow(policy, prefix, seen, steps, named=None):
    """Return the graphs of a policy of flow matching over a prefix that is computed once, and the program.

    ``seen`` are the inputs of the prefix beside the instruction; ``named`` holds the state where the step takes it.
    """
    config, pad = policy.config, prefix.pad
    ids = torch.full([1, config.tokenizer_max_length], pad)
    ids[0, :3] = torch.tensor([id for id in range(5) if id != pad][:3])
    names, values, step = [*map(identifier, seen), TEXT], [*seen.values()], Flow(policy)
    with torch.no_grad():
        keys, cached, pads = prefix(*values, ids)
    shape = [1, config.chunk_size, config.max_action_dim]
    schedule = {"time": [1 - number / steps for number in range(steps)], "interval": [-1 / steps] * steps}
    examples = {"x": torch.zeros(shape), "time": torch.ones(1), "interval": torch.ones(1)}
    examples |= {"keys": keys, "values": cached, "pads": pads, **({"state": named[STATE]} if named else {})}
    program = [
        {
            "graph": "prefix", "feeds": dict(zip(names, [*seen, TEXT], strict=True)),
            "gives": {name: name for name in ("keys", "values", "pads")},
        },
        {
            "graph": "step", "feeds": {name: STATE if name == "state" else name for name in examples},
            "gives": {"next_x": "next_x", "action": "action"}, "repeat": steps, "carry": {"next_x": "x"},
            "schedule": schedule, "noise": {"x": {"shape": shape, "distribution": "normal"}},
        },
    ]  # fmt: skip
    graphs = {
        "prefix": (prefix, names, [*values, ids], ["keys", "values", "pads"]),
        "step": (step, list(examples), list(examples.values()), ["next_x", "action"]),
    }
    return graphs, program, config.chunk_size


FAMILIES = {"act": act, "diffusion": diffusion, "pi0": pi0, "pi05": pi0, "smolvla": smolvla}


def play(graphs, program, values, keys, generator):
    """Run traced graphs as the program says, and return the action and the noise that was drawn."""
    known, drawn = dict(zip(keys, values, strict=True)), {}
    for step in program:
        module = graphs[step["graph"]][0]
        for name, how in step.get("noise", {}).items():
            drawn[name] = known[name] = torch.randn(how["shape"], generator=generator)
        for number in range(step.get("repeat", 1)):
            numbers = {name: torch.tensor([rows[number]]) for name, rows in step.get("schedule", {}).items()}
            found = module(*[{**known, **numbers}[source] for source in step["feeds"].values()])
            found = found if isinstance(found, tuple) else (found,)
            given = dict(zip(graphs[step["graph"]][3], found, strict=True))
            known |= {step["gives"][name]: value for name, value in given.items()}
            known |= {target: known[source] for source, target in step.get("carry", {}).items()}
    return known["action"], drawn


def own_inference(policy, observation, values, drawn, graph_pad):
    """Return the normalised action chunk that the policy itself gives, for inputs of the graphs and their noise."""
    batch = observation(values[: len(observation.keys)])
    policy.reset()
    if policy.config.type == "diffusion":
        return _own_diffusion(policy, batch, drawn)
    if policy.config.type == "smolvla":
        ids = values[-1][:, values[-1][0] != graph_pad]
        batch |= {"observation.language.tokens": ids, "observation.language.attention_mask": torch.ones_like(ids) > 0}
        return policy.predict_action_chunk(batch, noise=drawn["x"])
    if policy.config.type in ("pi0", "pi05"):
        batch |= {"observation.language.tokens": values[-1]}
        batch |= {"observation.language.attention_mask": values[-1] != graph_pad}
        return policy.predict_action_chunk(batch, noise=drawn["x"])
    return policy.predict_action_chunk(batch)


def _own_diffusion(policy, batch, drawn):
    """Return what LeRobot's own sampling gives; the noise that its scheduler draws is ours, in order."""
    from unittest import mock

    cameras = list(policy.config.image_features)
    if cameras:
        batch["observation.images"] = torch.stack([batch[key] for key in cameras], dim=2)
    fresh = iter(drawn.get("fresh", ()))
    module = sys.modules[type(policy.diffusion.noise_scheduler).__module__]
    with mock.patch.object(module, "randn_tensor", side_effect=fresh):
        condition = policy.diffusion._prepare_global_conditioning(batch)
        with mock.patch.object(torch, "randn", return_value=drawn["sample"]):
            actions = policy.diffusion.conditional_sample(1, global_cond=condition)
    first = policy.config.n_obs_steps - 1
    return actions[:, first : first + policy.config.n_action_steps]


def example(config, key, generator):
    """Return a random value of an input: uint8 frames, or a normalised vector; with a history where there is one."""
    shape = list(config.input_features[key].shape)
    lead = [1] if config.n_obs_steps == 1 else [1, config.n_obs_steps]
    if key in config.image_features:
        return torch.randint(0, 256, [*lead, *shape[1:], shape[0]], generator=generator, dtype=torch.uint8)
    return torch.randn([*lead, *shape], generator=generator)


def instruction(config, pad, generator):
    """Return random ids of an instruction, padded, as the graphs take it."""
    ids = torch.full([1, config.tokenizer_max_length], pad)
    length = int(torch.randint(2, 9, (), generator=generator))
    drawn = torch.randint(0, 12, (length,), generator=generator)
    ids[0, :length] = torch.where(drawn == pad, pad + 1, drawn)
    return ids


def main(request):
    """Trace the graphs, compare them with the policy, and write them."""
    from importlib.metadata import version

    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class

    checkpoint, out = Path(request["checkpoint"]).resolve(), Path(request["out"]).resolve()
    config = PreTrainedConfig.from_pretrained(checkpoint, local_files_only=True)
    config.device = "cpu"
    if hasattr(config, "adapt_to_pi_aloha"):
        config.adapt_to_pi_aloha = False  # the robot's runtime does it: it is data of the spec
    if hasattr(config, "pretrained_backbone_weights"):
        config.pretrained_backbone_weights = None  # the checkpoint has all weights; nothing is downloaded
    for name, value in {"dtype": "float32", "compile_model": False, "gradient_checkpointing": False}.items():
        if hasattr(config, name):
            setattr(config, name, value)  # pi0 may be stored in bfloat16, which the graphs widen
    os.chdir(checkpoint.parent)  # the checkpoint may name its backbone and tokenizer relative to where it lies
    policy = get_policy_class(config.type).from_pretrained(checkpoint, config=config, local_files_only=True).eval()
    policy.config.pretrained_path = checkpoint
    observation = Observation(config, request)
    generator = torch.Generator().manual_seed(0)
    keys = observation.keys
    with torch.no_grad():
        first = [example(config, key, generator) for key in keys]
        graphs, program, chunk = FAMILIES[config.type](policy, observation, first, out)
        pad = getattr(next(iter(graphs.values()))[0], "pad", None)
        errors = []
        for _ in range(TRIALS):
            values = [example(config, key, generator) for key in keys]
            if pad is not None:
                values.append(instruction(config, pad, generator))
            action, drawn = play(graphs, program, values, [*keys, TEXT][: len(values)], generator)
            own = own_inference(policy, observation, values, drawn, pad)
            errors.append(float((action - own).norm() / own.norm()))
        if not max(errors) <= TOLERANCE:
            raise SystemExit(f"the traced graphs differ from the policy's own inference by {max(errors):.2e}")
        for name, (module, _, inputs, _) in graphs.items():
            torch.export.save(torch.export.export(module.eval(), tuple(inputs)), out / f"{name}.pt2")
    facts = {
        "graphs": {name: {"inputs": names, "outputs": gives} for name, (_, names, _, gives) in graphs.items()},
        "program": program,
        "shapes": {key: list(value.shape) for key, value in zip(keys, first, strict=True)},
        "action": list(action.shape), "chunk": chunk, "error": max(errors),
        "history": config.n_obs_steps, "prompts": prompts(policy, generator),
        "tokens": None if pad is None else config.tokenizer_max_length,
        "versions": {name: version(name) for name in ("lerobot", "torch")},
    }  # fmt: skip
    (out / "facts.json").write_text(json.dumps(facts))


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text()))
