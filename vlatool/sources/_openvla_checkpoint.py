"""What the directory of an OpenVLA checkpoint says of its policy: read as data, from its JSON files and tensor headers.

``modeling_prismatic.py`` and its like in the directory are code, which is neither imported nor needed: the network has
a published structure, and its sizes are those of the tensors.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.bundle.conversion import LARGEST
from vlatool.bundle.prompt import Prompt
from vlatool.errors import SourceError, suggest
from vlatool.files.json import read_json
from vlatool.files.limits import check_limit
from vlatool.files.printable import truncate
from vlatool.files.small_file import read_bounded
from vlatool.files.validate import short_repr
from vlatool.runtime.tokenizer import Tokenizer
from vlatool.weights.shards import FLOATS, StoredTensor, read_shards

SHARDS = "*.safetensors"
INSTRUCTION = "instruction"
"""Name of the input that says what to do."""
SAVE = "copy the whole directory again, as it was downloaded or as save_pretrained wrote it"
BY_HAND = "write a policy.yaml and a few lines of Python: docs/guides/hugging-face-policy.md"
EMPTY_TOKEN = 29871
"""The id that ends every prompt of the training, behind "Out:"; appended where the tokenizer does not give it."""
QUESTION = "What action should the robot take to {}?"
CHAT = (
    "A chat between a curious user and an artificial intelligence assistant. The assistant gives helpful, detailed, "
    f"and polite answers to the user's questions. USER: {QUESTION} ASSISTANT:"
)
TEMPLATES = {"llama2-": f"In: {QUESTION}\nOut:", "vicuna-": CHAT}
"""Beginning of ``llm_backbone_id`` -> prompt, with which OpenVLA's scripts ask models of that kind."""
HEADS = {"tiny": 3, "small": 6, "base": 12, "large": 16, "so400m": 16, "huge": 16}
"""Size in the name of a vision transformer of timm -> heads, the one thing that its tensors do not say."""
RESIZE = {"resize-naive": "fill", "resize-crop": "cover"}
"""``image_resize_strategy`` -> how a frame is fitted; what else it may be pads frames of any aspect to squares."""
FUSED_TOWER = "vision_backbone.fused_featurizer"
FILTERS = ("bicubic", "bilinear")
Tensors = Mapping[str, StoredTensor]


@dataclass(frozen=True)
class Checkpoint:
    """An OpenVLA policy.

    Args:
        arguments: of ``_openvla_network.make``.
        image: side of the picture that the towers see, in pixels; ``fit`` and ``filter``: how a frame becomes it.
        prompt: what is written around an instruction.
        tokenizer: content of ``tokenizer.json``, which pads with the id that the network expects.
        statistics: ``q01`` and ``q99`` of each element of the action; -1 and 1 where it is not normalised.
        dataset: key of the statistics.
        tensors: what its shards hold.
    """

    folder: Path
    arguments: dict[str, Any]
    image: int
    fit: str
    filter: str
    prompt: Prompt
    tokenizer: str
    statistics: dict[str, list[float]]
    dataset: str
    tensors: Tensors


def read_checkpoint(folder: Path, unnorm_key: str, prompt_tokens: int) -> Checkpoint:
    """Read a checkpoint; nothing of it runs.

    Args:
        unnorm_key: which statistics its actions are in; the only ones when empty.
        prompt_tokens: ids of a prompt, padding included.

    Raises:
        SourceError: naming the file and the entry that is missing, damaged or unknown.
    """
    config = _mapping(folder, "config.json")
    _check_kind(folder, config)
    dataset, statistics = _statistics(folder, config, unnorm_key)
    tensors = _tensors(folder)
    pictures = _pictures(folder, config, tensors)
    towers = {
        name: _tower(folder, f"vision_backbone.{name}.", tensors, about) for name, about in pictures["towers"].items()
    }
    language = _language(folder, config, tensors)
    arguments: dict[str, Any] = {
        "towers": towers,
        "projector": _projector(folder, tensors, sum(each["width"] for each in towers.values()), language["width"]),
        "language": language,
        "decoding": _decoding(folder, config, len(statistics["q01"]), language["vocabulary"], prompt_tokens),
    }
    places = max(tower["grid"] for tower in towers.values()) ** 2 + prompt_tokens + len(statistics["q01"])
    for count, what in (
        (places * language["head_width"], "The positions"),
        (arguments["decoding"]["bins"], "The bins"),
    ):
        check_limit("elements", count, f"{what} of {folder}", SourceError)  # are computed, not read
    if len({tower["grid"] for tower in towers.values()}) > 1:
        raise SourceError(f"The towers of {folder} see different numbers of patches.", SAVE)
    prompt = _prompt(folder, config)
    tokenizer = _tokenizer(folder, prompt, arguments["decoding"], config)
    return Checkpoint(
        folder, arguments, pictures["size"], pictures["fit"], pictures["filter"], prompt, tokenizer, statistics,
        dataset, tensors,
    )  # fmt: skip


def _mapping(folder: Path, name: str) -> dict[str, Any]:
    path = folder / name
    try:
        content = read_bounded(path, "statistics_bytes", SourceError)
    except OSError as error:
        raise SourceError(f"The OpenVLA checkpoint {folder} has no {name} ({error.strerror}).", SAVE) from error
    value = read_json(content, str(path), SourceError, SAVE)
    if not isinstance(value, dict):
        raise SourceError(f"{path} holds no mapping.", SAVE)
    return value


def _check_kind(folder: Path, config: Mapping[str, Any]) -> None:
    """Refuse what changes the network or its weights in ways that the tensors do not show."""
    text = config.get("text_config")
    if not isinstance(text, dict) or text.get("model_type") != "llama":
        kind = text.get("model_type") if isinstance(text, dict) else text
        raise SourceError(
            f"The language model of {folder} (text_config in config.json) is {short_repr(kind)}; known: llama.", BY_HAND
        )
    for key in ("rope_scaling", "attention_bias", "mlp_bias"):
        if text.get(key):
            raise SourceError(
                f"text_config in config.json of {folder} has {key} {short_repr(text[key])}, which is not known.",
                BY_HAND,
            )
    for key, value, known in (
        ("hidden_act", text.get("hidden_act", "silu"), "silu"), ("rope_type", _rope(text).get("rope_type"), "default"),
        ("type of rotary positions", _rope(text).get("type"), "default"),
        ("partial_rotary_factor", {**_rope(text), **text}.get("partial_rotary_factor"), 1),
    ):  # fmt: skip
        if value not in (known, None):
            raise SourceError(
                f"text_config in config.json of {folder} has {key} {short_repr(value)}; known: {known}.", BY_HAND
            )
    if config.get("quantization_config"):
        raise SourceError(
            f"The weights of {folder} are quantized already (quantization_config in config.json).",
            "name the checkpoint that they were quantized from; vlatool quantize weight-only does it from there",
        )
    if (folder / "adapter_config.json").exists():
        raise SourceError(
            f"{folder} holds an adapter (adapter_config.json), not the whole policy.",
            "merge it into its base: PeftModel.merge_and_unload(), then save_pretrained",
        )


def _rope(text: Mapping[str, Any]) -> dict[str, Any]:
    """Return what newer releases of transformers write about rotary positions, beside or instead of ``rope_theta``."""
    found = text.get("rope_parameters")
    return found if isinstance(found, dict) else {}


def _tensors(folder: Path) -> Tensors:
    if not any(folder.glob(SHARDS)):
        pickles = sorted(path.name for path in folder.glob("*.bin"))
        found = f"; it has {pickles[0]}, a pickle, which can run code" if pickles else ""
        raise SourceError(
            f"{folder} has no {SHARDS}{found}.",
            "save it again with save_pretrained(DIRECTORY, safe_serialization=True)" if pickles else SAVE,
        )
    tensors = read_shards(folder, SHARDS)
    for name, tensor in tensors.items():
        if tensor.dtype not in FLOATS:
            raise SourceError(
                f"'{name}' in {tensor.file.name} of {folder} is {tensor.dtype}; known: {', '.join(FLOATS)}.",
                "name the checkpoint whose weights are not quantized",
            )
    return tensors


def check_tensors(checkpoint: Checkpoint, wanted: Mapping[str, tuple[int, ...]]) -> None:
    """Check that the shards hold what the network of the checkpoint's arguments has, and nothing that it would miss.

    Args:
        wanted: name -> shape of each parameter.

    Raises:
        SourceError: naming the first tensor that is missing, has another shape, or is not known.
    """
    for name, shape in wanted.items():
        got = _shape(checkpoint.folder, checkpoint.tensors, name, len(shape))
        if got != shape:
            raise SourceError(
                f"'{name}' in {checkpoint.tensors[name].file.name} of {checkpoint.folder} has the shape {list(got)}; "
                f"beside the other tensors it must have {list(shape)}.",
                SAVE,
            )
    unread = _unread(checkpoint.arguments)
    for name, tensor in checkpoint.tensors.items():
        if name not in wanted and not unread.fullmatch(name):
            raise SourceError(
                f"{tensor.file.name} of {checkpoint.folder} holds '{truncate(name, 120)}', which the known network "
                "does not have: without it, its actions would be others.",
                f"merge an adapter into its base, and keep other checkpoints in directories of their own; or {BY_HAND}",
            )


def _unread(arguments: Mapping[str, Any]) -> re.Pattern[str]:
    """Return a pattern of the tensors that do not change an action: what follows the last block that a tower runs."""
    behind = [
        rf"vision_backbone\.{name}\.(blocks\.{tower['layers']}|norm|fc_norm|attn_pool|head)\..*"
        for name, tower in arguments["towers"].items()
    ]
    return re.compile("|".join([*behind, r"language_model\.model\.(layers\.\d+\.self_attn\.)?rotary_emb\.inv_freq"]))


def _shape(folder: Path, tensors: Tensors, name: str, axes: int) -> tuple[int, ...]:
    """Return the shape of a tensor, which must be there."""
    if name not in tensors:
        raise SourceError(f"No shard of {folder} holds '{name}'; {_nearest(name, tensors)}.", SAVE)
    shape = tensors[name].shape
    if len(shape) != axes or 0 in shape:
        raise SourceError(
            f"'{name}' in {tensors[name].file.name} of {folder} has the shape {list(shape)}; wanted {axes} axes.", SAVE
        )
    return shape


def _nearest(name: str, tensors: Tensors) -> str:
    hint = suggest(name, tensors)
    return hint.partition("? ")[0] + "?" if "? " in hint else f"it has {len(tensors)} others"


def _layers(folder: Path, tensors: Tensors, prefix: str) -> int:
    """Return how many layers there are below a prefix, by the highest number; each is checked later."""
    pattern = re.compile(re.escape(prefix) + r"(\d{1,4})\.")
    numbers = [int(found[1]) for name in tensors if (found := pattern.match(name))]
    if not numbers:
        raise SourceError(f"No shard of {folder} holds layers '{prefix}0...'; {_nearest(prefix, tensors)}.", SAVE)
    return max(numbers) + 1


def _pictures(folder: Path, config: Mapping[str, Any], tensors: Tensors) -> dict[str, Any]:
    """Return the size of the picture, how a frame becomes it, and what each tower is told, by its name."""
    about = _mapping(folder, "preprocessor_config.json")
    count = 2 if config.get("use_fused_vision_backbone", f"{FUSED_TOWER}.pos_embed" in tensors) else 1

    def of_each(name: str, default: Any = None) -> list[Any]:
        file, values = ("config.json", config) if name in config else ("preprocessor_config.json", about)
        row = values.get(name) or default
        if not isinstance(row, list) or len(row) < count:
            raise SourceError(
                f"{file} of {folder} has {name} {short_repr(row)}; wanted a list of {count}, one for each tower.", SAVE
            )
        return row[:count]

    strategy = about.get("image_resize_strategy", config.get("image_resize_strategy"))
    if not isinstance(strategy, str) or strategy not in RESIZE:
        raise SourceError(
            f"{folder} fits frames by {short_repr(strategy)} (image_resize_strategy); known: {', '.join(RESIZE)}.",
            f"{BY_HAND}; the frame can be fitted before it is given to the policy",
        )
    sizes, filters = of_each("image_sizes"), of_each("interpolations")
    if len({str(each) for each in sizes}) > 1 or len({str(each) for each in filters}) > 1 or filters[0] not in FILTERS:
        raise SourceError(
            f"The towers of {folder} want pictures of the sizes {short_repr(sizes)}, resized by {short_repr(filters)}; "
            f"known: one size, and one filter of {', '.join(FILTERS)}.",
            BY_HAND,
        )
    rows = zip(
        ("featurizer", "fused_featurizer"), of_each("timm_model_ids"), sizes,
        of_each("timm_override_act_layers", [None, None]), of_each("means"), of_each("stds"), strict=False,
    )  # fmt: skip
    towers = {
        name: {"timm": timm, "size": size, "activation": activation or "gelu", "mean": mean, "std": std}
        for name, timm, size, activation, mean, std in rows
    }
    return {"towers": towers, "size": sizes[0], "fit": RESIZE[strategy], "filter": filters[0]}


def _tower(folder: Path, prefix: str, tensors: Tensors, about: Mapping[str, Any]) -> dict[str, Any]:
    """Return the shape of a vision transformer, fields of ``TowerShape``."""
    timm = str(about["timm"])
    heads = next((count for size, count in HEADS.items() if timm.startswith(f"vit_{size}_")), 0)
    if not heads or about["activation"] not in ("gelu", "quick_gelu"):
        raise SourceError(
            f"config.json of {folder} names the tower {truncate(repr(timm), 60)} with the activation "
            f"{about['activation']!r:.40}; known: vit_SIZE_... of {', '.join(HEADS)} with gelu or quick_gelu.",
            BY_HAND,
        )
    width, _, patch, _ = _shape(folder, tensors, f"{prefix}patch_embed.proj.weight", 4)
    _, positions, _ = _shape(folder, tensors, f"{prefix}pos_embed", 3)
    layers = _layers(folder, tensors, f"{prefix}blocks.")
    hidden, _ = _shape(folder, tensors, f"{prefix}blocks.0.mlp.fc1.weight", 2)
    has_class = f"{prefix}cls_token" in tensors
    registers = _shape(folder, tensors, f"{prefix}reg_token", 3)[1] if f"{prefix}reg_token" in tensors else 0
    size = about["size"]
    grid = size // patch if isinstance(size, int) and size > 0 else 0
    if not grid or positions not in (grid**2, grid**2 + has_class) or width % heads:
        raise SourceError(
            f"The tower '{prefix.rstrip('.')}' of {folder} ({timm}) has {positions} positions and the width {width}; "
            f"pictures of {size} pixels in patches of {patch} have {grid**2}, {heads} heads divide the width.",
            f"timm_model_ids and image_sizes in config.json must fit the tensors; {SAVE}",
        )
    scale = next((name for name in ("scale_factor", "gamma") if f"{prefix}blocks.0.ls1.{name}" in tensors), "")
    pre_norm = f"{prefix}norm_pre.weight" in tensors
    numbers = {name: _three(folder, name, about[name]) for name in ("mean", "std")}
    return {
        "width": width, "layers": layers - 1, "heads": heads, "hidden": hidden, "patch": patch, "grid": grid,
        "has_class": has_class, "registers": registers, "positions": positions, "layer_scale": scale,
        "pre_norm": pre_norm, "activation": about["activation"], "epsilon": 1e-5 if pre_norm else 1e-6, **numbers,
    }  # fmt: skip


def _three(folder: Path, name: str, values: Any) -> list[float]:
    known = isinstance(values, list) and len(values) == 3 and all(_is_number(each) for each in values)
    if not known or (name == "std" and min(values) < 1 / LARGEST):
        raise SourceError(
            f"preprocessor_config.json of {folder} has the {name} {short_repr(values)}; wanted three numbers, a std "
            "above 0.",
            SAVE,
        )
    return [float(each) for each in values]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and -LARGEST < value < LARGEST


def _projector(folder: Path, tensors: Tensors, features: int, width: int) -> list[int]:
    """Return the widths between the layers of the projector."""
    count = 3 if "projector.fc3.weight" in tensors else 2
    shapes = [_shape(folder, tensors, f"projector.fc{number}.weight", 2) for number in range(1, count + 1)]
    widths = [shapes[0][1], *(after for after, _ in shapes)]
    if any(before != shape[1] for before, shape in zip(widths, shapes, strict=False)) or (
        (widths[0], widths[-1]) != (features, width)
    ):
        raise SourceError(
            f"The projector of {folder} has layers of the shapes {[list(shape) for shape in shapes]}; they do not fit "
            f"between towers of {features} channels and a language model of {width}.",
            SAVE,
        )
    return widths


def _language(folder: Path, config: Mapping[str, Any], tensors: Tensors) -> dict[str, Any]:
    """Return the shape of the decoder, fields of ``LanguageShape``; what config.json leaves out is Llama's default."""
    text, prefix = config["text_config"], "language_model.model."
    vocabulary, width = _shape(folder, tensors, f"{prefix}embed_tokens.weight", 2)
    layers = _layers(folder, tensors, f"{prefix}layers.")
    attention = f"{prefix}layers.0.self_attn."
    queries, keys = (_shape(folder, tensors, f"{attention}{name}_proj.weight", 2)[0] for name in "qk")
    hidden, _ = _shape(folder, tensors, f"{prefix}layers.0.mlp.gate_proj.weight", 2)
    sizes = {
        "vocab_size": (vocabulary, 32000), "hidden_size": (width, 4096), "num_hidden_layers": (layers, 32),
        "intermediate_size": (hidden, 11008),
    }  # fmt: skip
    for key, (got, default) in sizes.items():
        if text.get(key, default) != got:
            raise SourceError(
                f"text_config in config.json of {folder} has {key} {short_repr(text.get(key, default))}; the tensors "
                f"have {got}.",
                f"config.json and the shards belong together: {SAVE}",
            )
    heads = _count(folder, text, "num_attention_heads", 32)
    shared = _count(folder, text, "num_key_value_heads", heads)
    if queries % heads or (queries // heads) % 2 or keys != queries // heads * shared or heads % shared:
        raise SourceError(
            f"text_config in config.json of {folder} has {heads} heads and {shared} of keys and values; the products "
            f"of the tensors are {queries} and {keys} wide.",
            f"config.json and the shards belong together: {SAVE}",
        )
    tied = "language_model.lm_head.weight" not in tensors
    if tied and text.get("tie_word_embeddings", False) is not True:
        raise SourceError(
            f"No shard of {folder} holds 'language_model.lm_head.weight'; {_nearest('lm_head', tensors)}.", SAVE
        )
    if not tied and text.get("tie_word_embeddings", False) is not False:
        raise SourceError(
            f"text_config in config.json of {folder} has tie_word_embeddings "
            f"{short_repr(text['tie_word_embeddings'])}, and its shards a head of their own: which of both is meant?",
            "write false if the head is used, or save the checkpoint again without it",
        )
    if text.get("head_dim") not in (None, queries // heads):
        raise SourceError(
            f"text_config in config.json of {folder} has head_dim {short_repr(text['head_dim'])}; the tensors have "
            f"{queries // heads}.",
            f"config.json and the shards belong together: {SAVE}",
        )
    base = _number(folder, {**_rope(text), **text}, "rope_theta", 10000.0)
    epsilon = _number(folder, text, "rms_norm_eps", 1e-6)
    return {
        "width": width, "layers": layers, "heads": heads, "shared_heads": shared, "head_width": queries // heads,
        "hidden": hidden, "vocabulary": vocabulary, "base": base, "epsilon": epsilon, "tied": tied,
    }  # fmt: skip


def _count(folder: Path, values: Mapping[str, Any], key: str, default: int, low: int = 1) -> int:
    value = values.get(key)
    value = default if value is None else value
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise SourceError(f"config.json of {folder} has {key} {short_repr(value)}; wanted a number from {low}.", SAVE)
    return value


def _number(folder: Path, values: Mapping[str, Any], key: str, default: float) -> float:
    value = values.get(key, default)
    if not _is_number(value) or value < 1 / LARGEST:
        raise SourceError(f"config.json of {folder} has {key} {short_repr(value)}; wanted a number above 0.", SAVE)
    return float(value)


def _decoding(
    folder: Path, config: Mapping[str, Any], actions: int, vocabulary: int, prompt_tokens: int
) -> dict[str, int]:
    """Return how tokens become an action, fields of ``Decoding``."""
    bins = _count(folder, config, "n_action_bins", 256, 2)
    pad = _count(folder, config, "pad_token_id", 32000, 0)
    end = vocabulary - _count(folder, config, "pad_to_multiple_of", 64, 0)
    if bins >= end or pad >= vocabulary:
        raise SourceError(
            f"config.json of {folder} has {bins} action bins, pad_token_id {pad} and pad_to_multiple_of "
            f"{vocabulary - end}; the vocabulary has {vocabulary} ids.",
            SAVE,
        )
    return {"actions": actions, "prompt_tokens": prompt_tokens, "pad": pad, "bins": bins, "end": end}


def _statistics(folder: Path, config: Mapping[str, Any], unnorm_key: str) -> tuple[str, dict[str, list[float]]]:
    """Return the key of the statistics, and q01 and q99 of the action: -1 and 1 where the mask leaves it as it is.

    ``dataset_statistics.json``, which fine-tuning writes, replaces ``norm_stats`` of config.json.
    """
    beside = (folder / "dataset_statistics.json").exists()
    table = _mapping(folder, "dataset_statistics.json") if beside else config.get("norm_stats")
    where = f"{'dataset_statistics.json' if beside else 'norm_stats in config.json'} of {folder}"
    if not isinstance(table, dict) or not table:
        raise SourceError(f"{where} has no statistics; without them nobody knows how far an action goes.", SAVE)
    keys = ", ".join(truncate(str(key), 60) for key in sorted(table))
    if not unnorm_key and len(table) > 1:
        raise SourceError(
            f"{where} has statistics of {len(table)} datasets; the policy's actions are in the units of one: {keys}.",
            "say whose robot it is to move: --unnorm-key KEY",
        )
    key = unnorm_key or next(iter(table))
    if key not in table:
        raise SourceError(f"{where} has no statistics '{truncate(key, 60)}'; it has: {keys}.", "name one of these")
    action = table[key].get("action") if isinstance(table[key], dict) else None
    lows, highs = (_row(action, name, f"the action of '{key}' in {where}") for name in ("q01", "q99"))
    mask = action.get("mask", [True] * len(lows)) if isinstance(action, dict) else None
    if not isinstance(mask, list) or not all(isinstance(each, bool) for each in mask):
        raise SourceError(
            f"'mask' of the action of '{key}' in {where} is {short_repr(mask)}; wanted: true or false for each one.",
            SAVE,
        )
    if len({len(lows), len(highs), len(mask)}) > 1:
        raise SourceError(f"q01, q99 and mask of the action of '{key}' in {where} are of different lengths.", SAVE)
    pairs = [(low, high) if on else (-1.0, 1.0) for low, high, on in zip(lows, highs, mask, strict=True)]
    if any(high < low for low, high in pairs):
        raise SourceError(f"q01 of the action of '{key}' in {where} is above q99.", SAVE)
    return key, {"q01": [float(low) for low, _ in pairs], "q99": [float(high) for _, high in pairs]}


def _row(action: Any, name: str, where: str) -> list[Any]:
    row = action.get(name) if isinstance(action, dict) else None
    if not isinstance(row, list) or not row or not all(_is_number(each) for each in row):
        raise SourceError(f"'{name}' of {where} is {short_repr(row)}; wanted numbers.", SAVE)
    return row


def _prompt(folder: Path, config: Mapping[str, Any]) -> Prompt:
    named = str(config.get("llm_backbone_id"))
    template = next((text for start, text in TEMPLATES.items() if named.startswith(start)), "")
    if not template:
        raise SourceError(
            f"config.json of {folder} has llm_backbone_id {truncate(repr(named), 60)}, whose prompt is unknown; known: "
            f"{', '.join(f'{start}...' for start in TEMPLATES)}.",
            BY_HAND,
        )
    return Prompt(template, lower=True, last=EMPTY_TOKEN)


def _tokenizer(folder: Path, prompt: Prompt, decoding: Mapping[str, int], config: Mapping[str, Any]) -> str:
    """Return the tokenizer, which pads with the id that the network expects, checked on a prompt.

    Raises:
        SourceError: when it is missing, or its prompt does not begin as the model expects it, or holds the padding.
        SpecError: when it is damaged.
    """
    path = folder / "tokenizer.json"
    try:
        content = read_bounded(path, "tokenizer_bytes", SourceError)
    except OSError as error:
        raise SourceError(
            f"The OpenVLA checkpoint {folder} has no tokenizer.json ({error.strerror}).",
            "write it with transformers: AutoTokenizer.from_pretrained(DIR).save_pretrained(DIR)",
        ) from error
    data = read_json(content, str(path), SourceError, SAVE)
    if not isinstance(data, dict):
        raise SourceError(f"{path} holds no mapping.", SAVE)
    begin, pad = config["text_config"].get("bos_token_id", 1), decoding["pad"]
    padding = {"strategy": "BatchLongest", "direction": "Right", "pad_to_multiple_of": None, "pad_type_id": 0}
    text = json.dumps({**data, "truncation": None, "padding": {**padding, "pad_id": pad, "pad_token": "<PAD>"}})
    row = Tokenizer(path, decoding["prompt_tokens"], INSTRUCTION, text.encode(), prompt)("move")[0].tolist()
    ids = row[: max((at for at, each in enumerate(row) if each != pad), default=-1) + 1]
    if ids[:1] != [begin] or pad in ids or max(ids) >= decoding["end"]:
        raise SourceError(
            f"{path} makes a prompt of the ids {short_repr(ids)}; wanted: {begin} (bos_token_id) first, none of them "
            f"{pad} (pad_token_id), all below {decoding['end']}.",
            f"the tokenizer and config.json belong together: {SAVE}",
        )
    return text
