import contextlib
import json
import random
import warnings
from pathlib import Path

import numpy as np
import pytest

from vlatool.bundle.prompt import Prompt
from vlatool.errors import DataError, SpecError
from vlatool.runtime.tokenizer import Tokenizer

WORDS = {"kind": "words", "pad": 0, "unknown": 1, "words": {"go": 2, "to": 3, "ball": 4}}
LIBRARY = {
    "version": "1.0",
    "truncation": {"direction": "Right", "max_length": 2, "strategy": "LongestFirst", "stride": 0},
    "padding": {
        "strategy": {"Fixed": 9},
        "direction": "Right",
        "pad_to_multiple_of": None,
        "pad_id": 7,
        "pad_type_id": 0,
        "pad_token": "[PAD]",
    },
    "added_tokens": [],
    "normalizer": {"type": "Lowercase"},
    "pre_tokenizer": {"type": "Whitespace"},
    "post_processor": None,
    "decoder": None,
    "model": {
        "type": "WordLevel",
        "vocab": {"[UNK]": 0, "go": 1, "to": 2, "ball": 3, "[PAD]": 7},
        "unk_token": "[UNK]",
    },
}


def tokenizer(folder: Path, data: object, max_tokens: int = 4) -> Tokenizer:
    path = folder / "tokenizer.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return Tokenizer(path, max_tokens, "instruction")


def test_words_become_padded_ids(tmp_path: Path):
    ids = tokenizer(tmp_path, WORDS)("Go  to BALL")
    assert ids.dtype == np.int64
    np.testing.assert_array_equal(ids, [[2, 3, 4, 0]])


@pytest.mark.parametrize(("prompt", "ids"), [
    (Prompt("go to {}"), [2, 3, 4, 0, 0]), (Prompt("go to {}", last=9), [2, 3, 4, 9, 0]),
    (Prompt("{} to", last=3), [4, 3, 0, 0, 0]), (Prompt(last=0), [4, 0, 0, 0, 0]),
])  # fmt: skip
def test_a_prompt_is_written_around_a_text_and_ends_as_it_says(tmp_path: Path, prompt: Prompt, ids: list[int]):
    file = tmp_path / "tokenizer.json"
    file.write_text(json.dumps(WORDS))
    assert Tokenizer(file, 5, "instruction", prompt=prompt)("ball").tolist() == [ids]


def test_a_prompt_that_is_too_long_is_refused_not_cut(tmp_path: Path):
    file = tmp_path / "tokenizer.json"
    file.write_text(json.dumps(WORDS))
    tokenize = Tokenizer(file, 4, "instruction", prompt=Prompt("go to {}", last=9))
    assert tokenize("ball").tolist() == [[2, 3, 4, 9]]
    with pytest.raises(DataError, match="a prompt of 5 tokens; the policy takes 4"):
        tokenize("ball ball")


def test_a_prompt_case_and_braces_of_the_instruction_are_its_own():
    assert Prompt("In: {}?", lower=True).write("Open {} It") == "In: open {} it?"
    assert Prompt("In: {}?").write("Open") == "In: Open?"


def test_empty_text_is_padding(tmp_path: Path):
    np.testing.assert_array_equal(tokenizer(tmp_path, WORDS)(""), [[0, 0, 0, 0]])


def test_unknown_words_warn_and_are_named(tmp_path: Path):
    tokenize = tokenizer(tmp_path, WORDS)
    with pytest.warns(UserWarning, match="the instruction has words that the policy was not trained on: fetch, beer"):
        np.testing.assert_array_equal(tokenize("go fetch beer"), [[2, 1, 1, 0]])


def test_too_many_words_warn_and_are_cut(tmp_path: Path):
    tokenize = tokenizer(tmp_path, WORDS, max_tokens=2)
    with pytest.warns(UserWarning, match="the instruction has 3 tokens; the last 1 are cut"):
        np.testing.assert_array_equal(tokenize("go to ball"), [[2, 3]])


def test_an_instruction_warns_once(tmp_path: Path):
    tokenize = tokenizer(tmp_path, WORDS)
    with pytest.warns(UserWarning, match="fetch"):
        first = tokenize("fetch")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(tokenize("fetch"), first)


def test_the_last_instructions_are_remembered_and_no_more(tmp_path: Path):
    tokenize = tokenizer(tmp_path, {**WORDS, "words": {str(number): number for number in range(200)}})
    for number in range(200):
        np.testing.assert_array_equal(tokenize(str(number)), [[number, 0, 0, 0]])
    assert len(tokenize._cache) == Tokenizer.remembered
    assert tokenize("199") is tokenize("199")


def test_a_file_of_the_tokenizers_library(tmp_path: Path):
    tokenize = tokenizer(tmp_path, LIBRARY)
    np.testing.assert_array_equal(tokenize("go to ball"), [[1, 2, 3, 7]])
    np.testing.assert_array_equal(tokenize("fly"), [[0, 7, 7, 7]])


def test_the_cut_of_the_library_is_ours_so_that_it_warns(tmp_path: Path):
    tokenize = tokenizer(tmp_path, LIBRARY, max_tokens=2)
    with pytest.warns(UserWarning, match="the last 1 are cut"):
        np.testing.assert_array_equal(tokenize("go to ball"), [[1, 2]])


def test_a_library_file_without_padding_pads_with_zero(tmp_path: Path):
    np.testing.assert_array_equal(tokenizer(tmp_path, {**LIBRARY, "padding": None})("go"), [[1, 0, 0, 0]])


@pytest.mark.parametrize(
    "data", [{"model": {}}, {"model": {"type": "WordLevel"}}, {**LIBRARY, "model": 3}], ids=["empty", "half", "number"]
)
def test_a_broken_library_file_is_a_spec_error_and_no_traceback(tmp_path: Path, data):
    with pytest.raises(SpecError, match=r"tokenizer.json"):
        tokenizer(tmp_path, data)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("{", "'instruction' is not valid JSON"),
        ([], "must be a mapping"),
        ({}, "neither 'model' .* nor the kind 'words'"),
        ({"kind": "letters"}, "is not a tokenizer"),
        ({"kind": "words"}, "needs 'words'"),
        ({**WORDS, "pad": "0"}, "'pad' and 'unknown'"),
        ({**WORDS, "unknown": None}, "'pad' and 'unknown'"),
        ({**WORDS, "words": ["go"]}, "'words' \\(a mapping\\)"),
    ],
)
def test_a_file_that_is_no_tokenizer(tmp_path: Path, data, message):
    with pytest.raises(SpecError, match=message):
        tokenizer(tmp_path, data)


def test_ids_of_a_vocabulary_are_whole_numbers(tmp_path: Path):
    with pytest.raises(SpecError, match="'words'"):
        tokenizer(tmp_path, {**WORDS, "words": {"go": "two"}})


def test_a_missing_file(tmp_path: Path):
    with pytest.raises(SpecError, match=r"'instruction' cannot be read: .*absent.json \(No such file"):
        Tokenizer(tmp_path / "absent.json", 4, "instruction")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("[" * 100_000, "nested too deep"),
        ('{"kind": "words", "kind": "words"}', "'kind' occurs twice"),
        ({**WORDS, "pad": True}, "'pad' and 'unknown'"),
        ({**WORDS, "unknown": 2**64}, "'pad' and 'unknown'"),
        ({**WORDS, "words": {"go": True}}, "'words'"),
        ({**WORDS, "words": {"go": 2**80}}, "'words'"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_a_damaged_vocabulary_is_a_spec_error_and_no_traceback(tmp_path: Path, data, message):
    with pytest.raises(SpecError, match=message):
        tokenizer(tmp_path, data)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"\x80", b""])
def test_bytes_that_are_no_text(content):
    with pytest.raises(SpecError, match=r"tokenizer of 'say' is not valid JSON|words.json of 'say' is not valid JSON"):
        Tokenizer(Path("words.json"), 4, "say", content)


def test_a_bomb_is_not_read(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "tokenizer_bytes=1000")
    with pytest.raises(SpecError, match="the limit 'tokenizer_bytes' allows 1000"):
        tokenizer(tmp_path, {**WORDS, "words": {str(number): number for number in range(1000)}})


def test_a_link_is_not_followed(tmp_path: Path):
    (tmp_path / "words.json").write_text(json.dumps(WORDS))
    (tmp_path / "link.json").symlink_to(tmp_path / "words.json")
    with pytest.raises(SpecError, match="'say' cannot be read"):
        Tokenizer(tmp_path / "link.json", 4, "say")


def test_text_that_the_library_refuses_is_a_data_error(tmp_path: Path):
    tokenize = tokenizer(tmp_path, LIBRARY)
    with pytest.raises(DataError, match="The instruction cannot be turned into tokens"):
        tokenize("half of a character: \ud800")


def test_whatever_is_changed_in_a_file_of_the_library_it_is_a_spec_error(tmp_path: Path):
    chance = random.Random(0)
    original = json.dumps(LIBRARY).encode()
    for _ in range(300):
        changed = bytearray(original)
        for _ in range(chance.choice((1, 3))):
            changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
        with contextlib.suppress(SpecError):
            Tokenizer(tmp_path / "t.json", 4, "say", bytes(changed))
