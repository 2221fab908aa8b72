import base64
import json
from pathlib import Path
from typing import Any

import pytest

from vlatool.errors import DataError, SpecError
from vlatool.runtime.token_growth import growth
from vlatool.runtime.tokenizer import Tokenizer

MODEL = {"type": "WordLevel", "vocab": {"go": 2, "[UNK]": 1}, "unk_token": "[UNK]"}


def replace(pattern: str, content: str, kind: str = "String") -> dict[str, Any]:
    return {"type": "Replace", "pattern": {kind: pattern}, "content": content}


def sequence(*steps: dict[str, Any], key: str = "normalizers") -> dict[str, Any]:
    return {"type": "Sequence", key: list(steps)}


def kind(name: str, **fields: Any) -> dict[str, Any]:
    return {"type": name, **fields}


def charsmap(*texts: str) -> dict[str, Any]:
    content = (8).to_bytes(4, "little") + b"\x01" * 8 + b"\0".join(text.encode() for text in texts) + b"\0"
    return kind("Precompiled", precompiled_charsmap=base64.b64encode(content).decode())


def template(*pieces: str, ids: int = 1) -> dict[str, Any]:
    single = [{"Sequence" if piece == "A" else "SpecialToken": {"id": piece, "type_id": 0}} for piece in pieces]
    special = {piece: {"id": piece, "ids": [1] * ids, "tokens": [piece] * ids} for piece in pieces if piece != "A"}
    return {"type": "TemplateProcessing", "single": single, "pair": single, "special_tokens": special}


BYTES = kind("ByteLevel", add_prefix_space=False, trim_offsets=True, use_regex=True)
SPACES = kind("Metaspace", replacement="▁", prepend_scheme="always", split=True)
NFKC = charsmap("a" * 18, "b")
REAL = {
    "llama": ({"normalizer": sequence(kind("Prepend", prepend="▁"), replace(" ", "▁")),
               "model": {**MODEL, "byte_fallback": True}, "post_processor": template("<s>", "A")}, 2 * 4 + 1),
    "gemma": ({"normalizer": replace(" ", "▁"), "pre_tokenizer": kind("Split"), "model": {**MODEL, "byte_fallback": 1},
               "post_processor": template("<bos>", "A")}, 5),
    "bert": ({"normalizer": kind("BertNormalizer"), "pre_tokenizer": kind("BertPreTokenizer"),
              "model": {**MODEL, "continuing_subword_prefix": "##"}, "post_processor": template("c", "A", "s")}, 74),
    "gpt-2": ({"pre_tokenizer": BYTES, "post_processor": BYTES}, 4),
    "qwen": ({"normalizer": kind("NFC"), "pre_tokenizer": sequence(kind("Split"), BYTES, key="pretokenizers"),
              "post_processor": BYTES}, 12),
    "t5": ({"normalizer": NFKC, "pre_tokenizer": sequence(kind("WhitespaceSplit"), SPACES, key="pretokenizers"),
            "post_processor": template("A", "</s>")}, 37),
    "xlnet": ({"normalizer": sequence(replace("``", '"'), replace("''", '"'), kind("NFKD"), kind("StripAccents"),
                                      kind("Lowercase"), NFKC, replace(" {2,}", " ", "Regex")),
               "pre_tokenizer": SPACES, "post_processor": template("A", "<sep>", "<cls>")}, 3890),
    "clip": ({"normalizer": sequence(kind("NFC"), replace(r"\s+", " ", "Regex"), kind("Lowercase")),
              "pre_tokenizer": BYTES, "model": {**MODEL, "end_of_word_suffix": "</w>"},
              "post_processor": kind("RobertaProcessing")}, 362),
}  # fmt: skip
BOMBS = {
    "replace": {"normalizer": sequence(*[replace("o", "oo")] * 40)},
    "nested": {"normalizer": sequence(sequence(sequence(*[replace("o", "oo")] * 20)))},
    "one step": {"normalizer": replace("o", "o" * 20_000)},
    "between characters": {"normalizer": sequence(*[replace("(?=o)", "o" * 30, "Regex")] * 3)},
    "an empty pattern": {"normalizer": sequence(*[replace("", "ab")] * 9)},
    "prepend": {"normalizer": kind("Prepend", prepend="a" * 20_000)},
    "compatibility": {"normalizer": sequence(*[kind("NFKD")] * 4)},
    "a table": {"normalizer": charsmap("a" * 20_000)},
    "bytes": {"pre_tokenizer": sequence(*[kind("ByteLevel")] * 10, key="pretokenizers")},
    "a suffix": {"model": {**MODEL, "end_of_word_suffix": "a" * 20_000}},
    "the text again and again": {"post_processor": template(*["A"] * 20_000)},
    "tokens in a template": {"post_processor": template(*["s"] * 200, "A", ids=200)},
}


@pytest.mark.parametrize("name", REAL)
def test_tokenizers_as_they_are_pass(name: str):
    given, wanted = REAL[name]
    assert growth({"model": MODEL, **given}, "it") == wanted


@pytest.mark.parametrize("name", BOMBS)
def test_what_makes_a_text_too_long_is_refused(name: str):
    with pytest.raises(
        SpecError, match=r"makes of a character has \d+ characters; the limit 'tokenizer_growth' all"
    ) as e:
        growth({"model": MODEL, **BOMBS[name]}, "The tokenizer x")
    assert "VLATOOL_LIMITS=tokenizer_growth=" in e.value.fix


@pytest.mark.parametrize(
    "step", [{"type": "New"}, {"pattern": {"String": "o"}, "content": "oo"}, {"type": ["Replace"]}]
)
@pytest.mark.parametrize("role", ["normalizer", "pre_tokenizer", "post_processor"])
def test_a_step_that_is_not_known_is_refused(step: dict[str, Any], role: str):
    with pytest.raises(SpecError, match="whose effect on the length of a text is not known"):
        growth({role: step}, "The tokenizer x")


def test_a_step_that_is_no_mapping_is_refused():
    with pytest.raises(SpecError, match="one of its steps is not a mapping"):
        growth({"normalizer": sequence([])}, "The tokenizer x")  # type: ignore[arg-type]


def test_a_million_steps_that_do_nothing_are_refused():
    with pytest.raises(SpecError, match=r"has 1025 steps; the limit 'steps' allows 1024"):
        growth({"normalizer": sequence(*[kind("Strip")] * 2000)}, "The tokenizer x")


def test_added_tokens_count_since_they_are_normalized_when_the_file_is_opened():
    added = [{"id": 1, "content": "o" * 10_000, "normalized": True}]
    with pytest.raises(SpecError, match="its added tokens, as it may lengthen them, has 10000000 characters"):
        growth({"normalizer": replace("o", "o" * 1000), "added_tokens": added}, "The tokenizer x")


def test_a_bomb_is_refused_before_the_library_has_it_and_a_long_text_before_it_is_lengthened(tmp_path: Path):
    file = tmp_path / "tokenizer.json"
    plain = {"version": "1.0", "truncation": None, "padding": None, "added_tokens": [], "pre_tokenizer": None,
             "post_processor": None, "decoder": None, "model": MODEL}  # fmt: skip
    file.write_text(json.dumps({**plain, "normalizer": sequence(*[replace("o", "oo")] * 20)}))
    with pytest.raises(SpecError, match="'tokenizer_growth'"):
        Tokenizer(file, 4, "instruction")
    file.write_text(json.dumps({**plain, "normalizer": sequence(*[replace("o", "oo")] * 13)}))
    tokenize = Tokenizer(file, 4, "instruction")
    assert tokenize("o").tolist() == [[1, 0, 0, 0]]
    with pytest.raises(DataError, match=r"The instruction, as .* has 8192000 characters; the limit 'text_characters'"):
        tokenize("o" * 1000)
