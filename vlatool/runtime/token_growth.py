"""How much longer a ``tokenizer.json`` can make a text: read from the file, before the library opens it.

Forty steps that write two letters for one make a terabyte of a word, inside of a library that ends the process when
memory runs out. Lengths are counted in characters, and in tokens from the model on.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from vlatool.errors import SpecError
from vlatool.files.limits import check_limit, limit

STEPS = {
    "BertNormalizer": 24, "Lowercase": 2, "NFC": 3, "NFD": 4, "NFKC": 18, "NFKD": 18, "Nmt": 1, "Strip": 1,
    "StripAccents": 1, "BertPreTokenizer": 1, "CharDelimiterSplit": 1, "Delimiter": 1, "Digits": 1, "FixedLength": 1,
    "Punctuation": 1, "Split": 1, "UnicodeScripts": 1, "Whitespace": 1, "WhitespaceSplit": 1,
    "Metaspace": 2, "ByteLevel": 4, "Replace": 0, "Prepend": 0, "Precompiled": 0,
}  # fmt: skip
"""Type of a normalizer or pre-tokenizer -> characters that it makes of one at most; 0 where that depends on its fields.
``ByteLevel`` writes a character for each byte of UTF-8."""
ADDED_TOKENS = {"ByteLevel": 0, "BertProcessing": 2, "RobertaProcessing": 2}
"""Type of a post-processor -> tokens that it adds."""
INNER = ("normalizers", "pretokenizers", "processors")
BYTES_OF_A_CHARACTER = 4


def growth(data: Mapping[str, Any], where: str) -> int:
    """Return how many times as long as a text its tokens, or what they are made of, can be.

    Args:
        where: What it is, as the start of a sentence.

    Raises:
        SpecError: when that is above the limit ``tokenizer_growth``, a step is of an unknown type, or there are more of
            them than the limit ``steps``.
    """
    factor = 1.0
    for role in ("normalizer", "pre_tokenizer"):
        for step in _steps(data.get(role), where):
            factor = _checked(factor * _factor(step, where), where)
    factor = _checked(factor * _of_model(data.get("model")), where)
    more = 0.0
    for step in _steps(data.get("post_processor"), where):
        times, added = _processed(step, where)
        factor, more = factor * times, more * times + added
        _checked(factor + more, where)
    times_longer = int(_checked(factor + more, where))
    check_limit(
        "text_characters",
        _added_tokens(data) * times_longer,
        f"{where}: its added tokens, as it may lengthen them,",
        SpecError,
    )
    return times_longer


def _checked(factor: float, where: str) -> float:
    if factor > limit("tokenizer_growth"):
        check_limit("tokenizer_growth", int(factor) + 1, f"{where}: what it makes of a character", SpecError)
    return factor


def _steps(step: Any, where: str) -> Iterator[Mapping[str, Any]]:
    """Yield the steps of a normalizer, pre-tokenizer or post-processor; those of a sequence one by one."""
    pending, seen = [step], 0
    while pending:
        step = pending.pop()
        if step is None:
            continue
        seen += 1
        check_limit("steps", seen, where, SpecError)
        if not isinstance(step, dict):
            raise SpecError(
                f"{where} is not a file of the tokenizers library: one of its steps is not a mapping.",
                "save it again with tokenizer.save(FILE) of the tokenizers library",
            )
        if step.get("type") == "Sequence":
            for inner in (step.get(key) for key in INNER):
                pending += reversed(inner) if isinstance(inner, list) else []
        else:
            yield step


def _factor(step: Mapping[str, Any], where: str) -> float:
    kind = step.get("type")
    if not isinstance(kind, str) or kind not in STEPS:
        raise _unknown(kind, where)
    match kind:
        case "Replace":
            return _replaced(step.get("pattern"), _length(step.get("content")))
        case "Prepend":
            return 1 + _length(step.get("prepend"))
        case "Precompiled":
            return _precompiled(step.get("precompiled_charsmap"))
        case "ByteLevel":
            return STEPS[kind] * (1 if step.get("add_prefix_space") is False else 2)
    return STEPS[kind]


def _replaced(pattern: Any, length: int) -> float:
    """A text is replaced as often as it holds the pattern; an expression can match between any two characters."""
    text = pattern.get("String") if isinstance(pattern, dict) and list(pattern) == ["String"] else None
    return max(1.0, length / len(text)) if isinstance(text, str) and text else 1 + 2 * length


def _precompiled(charsmap: Any) -> int:
    """The longest text in a table of SentencePiece: its size, a trie of that size, and texts that end in a zero."""
    try:
        import base64  # for the few tokenizers that have one

        table = base64.b64decode(charsmap or "")
        texts = table[4 + int.from_bytes(table[:4], "little") :]
    except (ValueError, TypeError):
        return 1  # the library does not open it
    return max(1, *(len(text.decode("utf-8", "replace")) for text in texts.split(b"\0")))


def _of_model(model: Any) -> int:
    """Tokens of one character, and what is written beside it to look a part of a word up."""
    if not isinstance(model, dict):
        return 1
    beside = _length(model.get("continuing_subword_prefix")) + _length(model.get("end_of_word_suffix"))
    return (1 + beside) * (BYTES_OF_A_CHARACTER if model.get("byte_fallback") else 1)


def _processed(step: Mapping[str, Any], where: str) -> tuple[int, int]:
    """Return how often a post-processor gives the tokens, and how many it adds."""
    kind = step.get("type")
    if isinstance(kind, str) and kind in ADDED_TOKENS:
        return 1, ADDED_TOKENS[kind]
    if kind != "TemplateProcessing":
        raise _unknown(kind, where)
    special = step.get("special_tokens")
    tokens = special if isinstance(special, dict) else {}
    template = step.get("single")
    pieces = [piece for piece in (template if isinstance(template, list) else []) if isinstance(piece, dict)]
    added = sum(_ids(tokens.get(str(_id(piece)))) for piece in pieces if "SpecialToken" in piece)
    return max(1, sum("Sequence" in piece for piece in pieces)), added


def _id(piece: Mapping[str, Any]) -> Any:
    special = piece["SpecialToken"]
    return special.get("id") if isinstance(special, dict) else None


def _ids(token: Any) -> int:
    ids = token.get("ids") if isinstance(token, dict) else None
    return len(ids) if isinstance(ids, list) else 0


def _added_tokens(data: Mapping[str, Any]) -> int:
    """The library takes added tokens through the normalizer when it opens the file."""
    added = data.get("added_tokens")
    return (
        sum(_length(token.get("content")) for token in added if isinstance(token, dict))
        if isinstance(added, list)
        else 0
    )


def _length(text: Any) -> int:
    return len(text) if isinstance(text, str) else 0


def _unknown(kind: Any, where: str) -> SpecError:
    return SpecError(
        f"{where} has a step of the type {str(kind)[:40]!r}, whose effect on the length of a text is not known.",
        f"use other steps; known: {', '.join(sorted({*STEPS, *ADDED_TOKENS, 'TemplateProcessing'}))}",
    )
