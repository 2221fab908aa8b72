"""OpenVLA checkpoints: what a directory says, what is refused, and the actions against a plain computation.

``tests/validation/foreign/openvla_checkpoints.py`` compares whole policies with timm and transformers.
"""

import json
import math
import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from _checkpoint_files import edited, write
from _openvla import ACTIONS, CONFIG, LANGUAGE, PICTURES, SIDE, VISION, VOCABULARY, parts, shapes

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.errors import DataError, SourceError, VlatoolError
from vlatool.machine.host import UNNORM_KEY
from vlatool.module.description import read_description
from vlatool.module.sharded_weights import stored_modules
from vlatool.module.torch_policy import load_modules, torch_policy
from vlatool.registry import Claim
from vlatool.runtime.observation import ObservationEncoder
from vlatool.runtime.statistics import load_normaliser
from vlatool.sources import source_stage
from vlatool.sources.openvla import OpenVla
from vlatool.stage.base import Context

pytest.importorskip("tokenizers")
UNREAD = "vision_backbone.fused_featurizer.attn_pool.latent"
FRAME = np.random.default_rng(2).integers(0, 256, (9, 12, 3), dtype=np.uint8)


@pytest.fixture(autouse=True)
def _place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("VLATOOL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv(UNNORM_KEY, "")  # so that what the command line sets is taken back
    yield
    assert not (tmp_path / "pwned").exists()


def source_bundle(folder: Path, out: Path) -> Bundle:
    out.mkdir()
    return source_stage(str(folder)).run(None, out, Context()).bundle


def test_a_checkpoint_acts_by_its_tokens_and_statistics_and_its_code_does_not_run(tmp_path: Path) -> None:
    policy = torch_policy(source_bundle(write(tmp_path / "c", parts()), tmp_path / "b"))
    action = policy.infer({"image": FRAME, "instruction": "Lift the cup"})
    tokens = action.outputs["tokens"][0]
    assert len(set(tokens.tolist())) > 1
    edges = np.linspace(-1, 1, 256)
    middles = (edges[:-1] + edges[1:]) / 2
    normalised = middles[np.clip(VOCABULARY - 64 - tokens - 1, 0, 254)]
    expected = [normalised[0], 0.25 * (normalised[1] + 1), normalised[2]]
    np.testing.assert_allclose(action.chunk[0], expected, rtol=1e-6, atol=1e-7)


def test_the_cache_gives_the_tokens_of_the_whole_sequence_read_anew(tmp_path: Path) -> None:
    bundle = source_bundle(write(tmp_path / "c", parts()), tmp_path / "b")
    policy, graphs = torch_policy(bundle), load_modules(bundle)
    observation = {"image": FRAME, "instruction": "lift cup"}
    tokens = policy.infer(observation).outputs["tokens"][0].tolist()
    encoded = policy.encode(observation)
    llama = graphs["prefill"].language_model
    with torch.inference_mode():
        patches = graphs["vision"](torch.from_numpy(encoded["image"]))
        ids = [each for each in encoded["instruction"][0].tolist() if each != CONFIG["pad_token_id"]]
        for number in range(ACTIONS):
            embedded = llama.model.embed_tokens(torch.tensor([ids]))
            states, _, _ = llama.read(torch.cat([embedded[:, :1], patches, embedded[:, 1:]], dim=1))
            ids.append(int(llama.choose(states[:, -1:])))
            assert ids[-1] == tokens[number]


def test_a_prompt_is_the_template_in_lower_case_with_the_empty_token_at_its_end(tmp_path: Path) -> None:
    spec = OpenVla.of(str(write(tmp_path / "c", parts()))).describe()
    words = ["In", ":", "What", "action", "should", "the", "robot", "take", "to", "lift", "?", "Out", ":"]
    vocabulary = parts()["tokenizer.json"]["model"]["vocab"]
    encode = ObservationEncoder(spec.spec, spec.folder)
    ids = encode({"image": FRAME, "instruction": "Lift"})["instruction"][0]
    expected = [1, *(vocabulary[word] for word in words), 29871]
    assert ids[: len(expected)].tolist() == expected
    assert set(ids[len(expected) :].tolist()) == {CONFIG["pad_token_id"]}
    with pytest.raises(DataError, match="a prompt of 114 tokens; the policy takes 64"):
        encode({"image": FRAME, "instruction": "lift " * 100})


def test_the_weights_stay_in_the_shards_of_the_checkpoint_and_both_graphs_share_them(tmp_path: Path) -> None:
    folder = write(tmp_path / "c", parts())
    at = stored_modules(source_bundle(folder, tmp_path / "b")).locations
    assert {place.file.resolve() for graph in at.values() for place in graph.values()} == {
        folder / VISION,
        folder / LANGUAGE,
    }
    assert at["prefill"] == at["decode"]
    assert not any("blocks.1" in name or "attn_pool" in name for name in at["vision"])


def test_a_policy_directory_to_keep_has_links_to_the_weights(tmp_path: Path) -> None:
    folder, kept = write(tmp_path / "c", parts()), tmp_path / "kept"
    with pytest.raises(SystemExit, match="0"):
        main(["new", str(kept), "--from", str(folder), "--control-hz", "5"])
    assert (kept / VISION).is_symlink()
    assert (kept / VISION).resolve() == folder / VISION
    assert read_description(kept).spec.control_hz == 5


def test_a_shape_that_nobody_asks_for_is_refused(tmp_path: Path, capsys) -> None:
    command = ["new", str(tmp_path / "kept"), "--from", str(write(tmp_path / "c", parts())), "--shape", "state=1,2"]
    with pytest.raises(SystemExit, match="2"):
        main(command)
    assert "says the shapes of all inputs" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "kept").exists()


def test_a_directory_of_gigabytes_is_described_without_an_export(tmp_path: Path, capsys) -> None:
    folder, nbytes = write(tmp_path / "c", parts()), 1 << 33
    header = json.dumps({UNREAD: {"dtype": "F32", "shape": [nbytes // 4], "data_offsets": [0, nbytes]}}).encode()
    with (folder / "more.safetensors").open("wb") as stream:
        stream.write(len(header).to_bytes(8, "little") + header)
        stream.truncate(8 + len(header) + nbytes)  # a hole takes no place on the disk
    with pytest.raises(SystemExit, match="0"):
        main(["inspect", str(folder)])
    printed = capsys.readouterr().out
    assert "weights stay in the shards" in printed
    assert "vlatool quantize weight-only" in printed
    assert "instruction: text" in printed


@pytest.mark.parametrize("key", ["a", "b"])
def test_statistics_are_chosen_by_their_key(tmp_path: Path, key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    files, action = parts(), CONFIG["norm_stats"]["bridge_orig"]
    files["config.json"]["norm_stats"] = {"a": {"action": {"q01": [0, 0], "q99": [2, 4]}}, "b": action}
    folder = write(tmp_path / "c", files)
    with pytest.raises(SourceError, match=r"of 2 datasets.*: a, b") as caught:
        OpenVla.of(str(folder)).describe()
    assert "--unnorm-key" in caught.value.fix
    monkeypatch.setenv(UNNORM_KEY, key)
    described = OpenVla.of(str(folder)).describe()
    assert described.spec.action.width == {"a": 2, "b": 3}[key]
    normaliser = load_normaliser(described.spec.action, described.folder)
    width = described.spec.action.width
    middle = {"a": [1, 2], "b": [0, 0.25, 0]}[key]
    np.testing.assert_allclose(normaliser.inverse(np.zeros((1, width), np.float32)), [middle])


@pytest.mark.parametrize(("key", "code", "words"), [
    ("b", 0, "actions in the statistics of b"), ("c", 3, "has no statistics 'c'; it has: a, b"),
    (None, 3, "of 2 datasets"),
])  # fmt: skip
def test_the_command_line_chooses_the_statistics(
    tmp_path: Path, key: str | None, code: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    files, action = parts(), CONFIG["norm_stats"]["bridge_orig"]
    files["config.json"]["norm_stats"] = {"a": action, "b": action}
    command = ["new", str(tmp_path / "kept"), "--from", str(write(tmp_path / "c", files))]
    with pytest.raises(SystemExit) as caught:
        main([*command, *(["--unnorm-key", key] if key else [])])
    assert caught.value.code == code
    assert words in " ".join("".join(capsys.readouterr()).split())


def test_statistics_of_a_fine_tuning_replace_those_of_the_base(tmp_path: Path) -> None:
    own = {"libero": {"action": {"q01": [0] * 7, "q99": [1] * 7}}}
    folder = write(tmp_path / "c", {**parts(), "dataset_statistics.json": own})
    described = OpenVla.of(str(folder)).describe()
    assert described.spec.action.width == 7
    assert "libero" in described.description


def test_a_recording_beside_a_checkpoint_is_carried(tmp_path: Path) -> None:
    folder, data = write(tmp_path / "c", parts()), tmp_path / "calibration.npz"
    np.savez(data, image=FRAME[None].repeat(2, 0), instruction=np.array(["lift", "move"]))
    described = OpenVla.of(str(folder)).model_copy(update={"calibration": data}).describe()
    assert described.calibration == data


def test_one_token_is_the_whole_action_without_a_decoding_step(tmp_path: Path) -> None:
    files = parts()
    files["config.json"]["norm_stats"] = {"a": {"action": {"q01": [0], "q99": [1]}}}
    policy = torch_policy(source_bundle(write(tmp_path / "c", files), tmp_path / "b"))
    assert policy.infer({"image": FRAME, "instruction": "lift"}).chunk.shape == (1, 1)


def both(*edits: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, Any]], None]:
    def edit(files: dict[str, Any]) -> None:
        for each in edits:
            each(files)

    return edit


STATS = ("config.json", "norm_stats", "bridge_orig", "action")
TEXT, INDEX = ("config.json", "text_config"), "model.safetensors.index.json"
LAYER = "language_model.model.layers.1."
LAYER_TENSORS = [name.removeprefix(LAYER) for name in shapes()[LANGUAGE] if name.startswith(LAYER)]
NO_FIRST = {"type": "ByteLevel", "add_prefix_space": False, "trim_offsets": True, "use_regex": True}
BROKEN = {
    "not JSON": (edited("config.json", to=b'{"model_type": "openvla",'), "is not valid JSON"),
    "no statistics": (edited("config.json", "norm_stats", to={}), "norm_stats in config.json .* has no statistics"),
    "no quantiles": (edited(*STATS, "q01", to=None), "'q01' of the action of 'bridge_orig'"),
    "quantiles of text": (edited(*STATS, "q99", to=["a"]), "'q99' of the action of 'bridge_orig'"),
    "infinite quantiles": (edited(*STATS, "q99", to=[1, 2, float("inf")]), "'q99' of the action of 'bridge_orig'"),
    "a short mask": (edited(*STATS, "mask", to=[True]), "of different lengths"),
    "quantiles beyond float32": (edited(*STATS, "q99", to=[1e299, 1, 1]), "'q99' of the action of 'bridge_orig'"),
    "a mask of text": (edited(*STATS, "mask", to=["false"] * 3), "'mask' of the action of 'bridge_orig'"),
    "a mask of nothing": (edited(*STATS, "mask", to=0), "'mask' of the action of 'bridge_orig'"),
    "an empty mask": (edited(*STATS, "mask", to=[]), "of different lengths"),
    "quantiles in the wrong order": (edited(*STATS, "q01", to=[2, 0, 0]), "q01 of .* is above q99"),
    "another language model": (edited(*TEXT, "model_type", to="phi"), r"text_config.*'phi'; known: llama"),
    "no language model": (edited(*TEXT, to="llama"), "text_config in config.json"),
    "scaled rotary positions": (edited(*TEXT, "rope_scaling", to={"factor": 2}), "rope_scaling"),
    "rotary positions of another type": (edited(*TEXT, "rope_parameters", to={"type": "linear"}), "'linear'"),
    "rotary positions of a part": (edited(*TEXT, "partial_rotary_factor", to=0.5), "partial_rotary_factor 0.5"),
    "heads of another width": (edited(*TEXT, "head_dim", to=2), "head_dim 2; the tensors have 4"),
    "two heads": (edited(*TEXT, "tie_word_embeddings", to=True), "tie_word_embeddings True"),
    "an epsilon beyond float32": (edited(*TEXT, "rms_norm_eps", to=1e299), "rms_norm_eps"),
    "other heads": (edited(*TEXT, "num_attention_heads", to=3), "has 3 heads"),
    "other width": (edited(*TEXT, "hidden_size", to=16), "hidden_size 16; the tensors have 8"),
    "layers of another checkpoint": (edited(*TEXT, "num_hidden_layers", to=32), "num_hidden_layers 32; the tensors"),
    "unknown tower": (edited("config.json", "timm_model_ids", to=["resnet50", "resnet50"]), "the tower 'resnet50'"),
    "no towers": (edited("config.json", "timm_model_ids", to=None), "timm_model_ids None; wanted a list of 2"),
    "another picture": (edited("config.json", "image_sizes", to=[8, 8]), "has 4 positions .* pictures of 8 pixels"),
    "unknown prompt": (edited("config.json", "llm_backbone_id", to="my-llm"), "llm_backbone_id 'my-llm'"),
    "more bins than ids": (edited("config.json", "n_action_bins", to=10**6), "1000000 action bins"),
    "padding beyond the vocabulary": (edited("config.json", "pad_token_id", to=10**6), "pad_token_id 1000000"),
    "padding that a prompt has": (edited("config.json", "pad_token_id", to=4), "none of them 4"),
    "quantized": (edited("config.json", "quantization_config", to={"load_in_4bit": True}), "are quantized already"),
    "an adapter": (edited("adapter_config.json", to={"r": 32}), "holds an adapter"),
    "letterbox": (edited("preprocessor_config.json", "image_resize_strategy", to="letterbox"), "'letterbox'"),
    "no preprocessor": (edited("preprocessor_config.json", to=None), "has no preprocessor_config.json"),
    "means of one tower": (edited("preprocessor_config.json", "means", to=PICTURES["means"][:1]), "has means"),
    "a std of zero": (edited("preprocessor_config.json", "stds", to=[[0, 1, 1]] * 2), "has the std"),
    "a std that float32 has not": (edited("preprocessor_config.json", "stds", to=[[1e-300, 1, 1]] * 2), "has the std"),
    "no tokenizer": (edited("tokenizer.json", to=None), "has no tokenizer.json"),
    "a tokenizer of text": (edited("tokenizer.json", to=b"[]"), "holds no mapping"),
    "no first token": (edited("tokenizer.json", "post_processor", to=NO_FIRST), "bos_token_id"),
    "a damaged tokenizer": (edited("tokenizer.json", "model", to={"type": "BPE"}), "tokenizer"),
    "a missing shard": (edited(VISION, to=None), f"names the shard {VISION}, which is missing"),
    "a shard that is cut": (edited(LANGUAGE, to=b"\x10" + bytes(9)), "not a safetensors file, or is cut off"),
    "a missing layer": (
        both(*(edited(LANGUAGE, f"{LAYER}{name}", to=None) for name in LAYER_TENSORS), edited(INDEX, to=None)),
        "num_hidden_layers 2; the tensors have 1",
    ),
    "a hole between layers": (
        both(*(edited(LANGUAGE, f"{LAYER.replace('1', '0')}{name}", to=None) for name in LAYER_TENSORS),
             edited(INDEX, to=None)),
        "layers.0.self_attn.q_proj.weight'",
    ),
    "no bias of the projector": (
        both(edited(VISION, "projector.fc2.bias", to=None), edited(INDEX, to=None)), "'projector.fc2.bias'"
    ),
    "a norm of another width": (
        edited(LANGUAGE, "language_model.model.norm.weight", to=np.ones(9, np.float32)), r"model.norm.weight' .*\[9\]"
    ),
    "a head of another vocabulary": (
        edited(LANGUAGE, "language_model.lm_head.weight", to=np.zeros((9, 8), np.float32)), r"lm_head.* \[9, 8\]"
    ),
    "no norm in a block": (
        both(edited(VISION, "vision_backbone.featurizer.blocks.0.norm2.bias", to=None), edited(INDEX, to=None)),
        "blocks.0.norm2.bias'",
    ),
    "a negative picture": (edited("config.json", "image_sizes", to=[-SIDE, -SIDE]), "pictures of -4 pixels"),
    "a strategy of lists": (
        edited("preprocessor_config.json", "image_resize_strategy", to=["x"]), "image_resize_strategy"
    ),
    "a number of many digits": (edited(*STATS, "q01", to=[10**400, 0, 0]), "'q01' of the action"),
    "a missing tensor": (
        both(edited(LANGUAGE, f"{LAYER}mlp.up_proj.weight", to=None), edited(INDEX, to=None)),
        "layers.1.mlp.up_proj.weight'",
    ),
    "another shape": (
        edited(LANGUAGE, f"{LAYER}mlp.up_proj.weight", to=np.zeros((9, 8), np.float32)), r"up_proj.weight' .*\[9, 8\]"
    ),
    "no head": (
        both(edited(LANGUAGE, "language_model.lm_head.weight", to=None), edited(INDEX, to=None)), "lm_head.weight'"
    ),
    "a projector of other towers": (
        edited(VISION, "projector.fc1.weight", to=np.zeros((192, 40), np.float32)), "The projector"
    ),
    "8-bit weights": (
        edited(VISION, "projector.fc1.weight", to=np.zeros((192, 48), np.int8)), "'projector.fc1.weight' .* is I8"
    ),
    "pickles": (
        both(*(edited(name, to=None) for name in (VISION, LANGUAGE, INDEX)), edited("pytorch_model.bin", to=b"\x80")),
        "a pickle, which can run code",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_checkpoint_is_named_with_its_place(tmp_path: Path, kind: str) -> None:
    edit, words = BROKEN[kind]
    files = parts()
    edit(files)
    with pytest.raises(VlatoolError, match=words) as caught:
        OpenVla.of(str(write(tmp_path / "c", files))).describe()
    assert caught.value.fix
    assert caught.value.exit_code == 3


def more(name: str, *shape: int, file: str = LANGUAGE) -> Callable[[dict[str, Any]], None]:
    return both(edited(file, name, to=np.zeros(shape, np.float32)), edited(INDEX, to=None))


UNKNOWN = {
    "a bias": more("language_model.model.layers.0.self_attn.q_proj.bias", 8),
    "a norm of queries": more("language_model.model.layers.0.self_attn.q_norm.weight", 4),
    "a layer of an adapter": more("base_model.model.language_model.model.layers.0.mlp.up_proj.lora_A.weight", 2, 8),
    "an adapter of its own": edited("adapter_model.safetensors", to={"lora_A.weight": np.zeros((2, 2), np.float32)}),
    "a norm in a tower": more("vision_backbone.featurizer.blocks.0.attn.q_norm.weight", 8, file=VISION),
    "a factor of one block": more("vision_backbone.fused_featurizer.blocks.0.ls2.gamma", 32, file=VISION),
    "a longer projector": more("projector.fc4.weight", 8, 8, file=VISION),
}


@pytest.mark.parametrize("kind", UNKNOWN)
def test_a_tensor_that_would_be_left_out_is_refused(tmp_path: Path, kind: str) -> None:
    files = parts()
    UNKNOWN[kind](files)
    with pytest.raises(SourceError, match="which the known network does not have"):
        OpenVla.of(str(write(tmp_path / "c", files))).describe()


def test_tensors_behind_the_last_block_that_runs_are_not_read(tmp_path: Path) -> None:
    files = parts()
    edited(VISION, UNREAD, to=np.zeros((1, 1, 32), np.float32))(files)
    more("language_model.model.layers.0.self_attn.rotary_emb.inv_freq", 2)(files)
    assert OpenVla.of(str(write(tmp_path / "c", files))).describe().weights


@pytest.mark.parametrize("name", ["tokenizer.json", "preprocessor_config.json", "dataset_statistics.json", INDEX])
@pytest.mark.parametrize("kind", ["a pipe", "a device"])
def test_what_has_no_end_is_not_read(tmp_path: Path, name: str, kind: str) -> None:
    folder = write(tmp_path / "c", parts())
    (folder / name).unlink(missing_ok=True)
    if kind == "a pipe":
        os.mkfifo(folder / name)
    else:
        (folder / name).symlink_to("/dev/zero")
    with pytest.raises(SourceError, match="not a regular file"):
        OpenVla.of(str(folder)).describe()


def sparse(file: Path, named: dict[str, tuple[int, ...]]) -> None:
    """Write a shard whose tensors are holes, which take no place on the disk."""
    entries, at = {}, 0
    for name, shape in named.items():
        entries[name] = {"dtype": "F16", "shape": list(shape), "data_offsets": [at, at := at + 2 * math.prod(shape)]}
    text = json.dumps(entries).encode()
    with file.open("wb") as stream:
        stream.write(struct.pack("<Q", len(text)) + text)
        stream.truncate(8 + len(text) + at)


@pytest.mark.parametrize("what", ["positions", "bins"])
def test_what_is_computed_from_claimed_sizes_is_limited(tmp_path: Path, what: str) -> None:
    files, named, grid, vocabulary = parts(), shapes(), 20_000, 2**31
    if what == "positions":
        files["config.json"]["image_sizes"] = [2 * grid] * 2
        for name in [name for name in named[VISION] if name.endswith("pos_embed")]:
            named[VISION][name] = (1, grid**2, named[VISION][name][2])
    else:
        files["config.json"]["n_action_bins"] = 2**30
        files["config.json"]["text_config"]["vocab_size"] = vocabulary
        for name in ("model.embed_tokens", "lm_head"):
            named[LANGUAGE][f"language_model.{name}.weight"] = (vocabulary, 8)
    folder = write(tmp_path / "c", {name: content for name, content in files.items() if name not in named})
    for name, shard in named.items():
        sparse(folder / name, shard)
    with pytest.raises(SourceError, match=f"The {what} of .* the limit 'elements'"):
        OpenVla.of(str(folder)).describe()


def header(text: str, data: int = 8) -> bytes:
    return struct.pack("<Q", len(text)) + text.encode() + bytes(data)


ENTRY = '{"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}'
HEADERS = {
    "nested": ("[" * 200_000 + "]" * 200_000, "nested too deep"),
    "twice the same name": (f'{{"a": {ENTRY}, "a": {ENTRY}}}', "'a' occurs twice"),
    "two in one place": (f'{{"a": {ENTRY}, "b": {ENTRY}}}', "'a' and 'b' overlap"),
    "endless": ('{"a": ' + ENTRY.replace("[1]", "[1e999]") + "}", "whole numbers"),
    "a fraction": ('{"a": ' + ENTRY.replace("[1]", "[1.5]") + "}", "whole numbers"),
    "a truth value": ('{"a": ' + ENTRY.replace("[1]", "[true]") + "}", "whole numbers"),
    "text": ('{"a": ' + ENTRY.replace("[1]", '"1"') + "}", "whole numbers"),
}


@pytest.mark.parametrize("kind", HEADERS)
def test_a_header_that_is_ambiguous_or_no_header_is_refused(tmp_path: Path, kind: str) -> None:
    text, words = HEADERS[kind]
    with pytest.raises(SourceError, match=words):
        OpenVla.of(str(write(tmp_path / "c", {**parts(), "x.safetensors": header(text)}))).describe()


@pytest.mark.parametrize("name", ["../outside.safetensors", "/outside.safetensors", "x" * 5000])
def test_an_index_names_shards_beside_it_alone(tmp_path: Path, name: str) -> None:
    files = parts()
    files[INDEX]["weight_map"]["more"] = name
    write(tmp_path, {"outside.safetensors": {"more": np.zeros(1, np.float32)}})
    with pytest.raises(SourceError, match=r"names the shard .*: it (leaves|is)"):
        OpenVla.of(str(write(tmp_path / "c", files))).describe()


def test_what_claims_a_directory(tmp_path: Path) -> None:
    folder = write(tmp_path / "c", {"config.json": CONFIG})
    assert OpenVla.claims(str(folder)) is Claim.CERTAIN
    for content in ({"model_type": "llama"}, {"type": "act"}, []):
        write(folder, {"config.json": content})
        assert OpenVla.claims(str(folder)) is Claim.NONE
    assert OpenVla.claims(str(tmp_path / "absent")) is Claim.NONE
