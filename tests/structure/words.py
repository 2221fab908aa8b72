"""Names of vlatool that do not say what they hold or do: bare participles, adverbs, pronouns; constants without a noun.

    python tests/structure/words.py                # fails where a count is above that of words_baseline.json
    python tests/structure/words.py --count        # the counts
    python tests/structure/words.py --list         # each name, where it is, and what to do about it
    python tests/structure/words.py --lower        # write lower counts to words_baseline.json

The counts may only fall. A word is judged alone: ``kept`` is a participle, ``kept_files`` names files. The lists of
words are in words.json.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from imports import ROOT, modules

BASELINE = Path(__file__).with_name("words_baseline.json")
LISTS = json.loads(Path(__file__).with_name("words.json").read_text())
"""Kind of word -> words. Participles that are verbs and nouns, too (read, run, set, cut, split), are left out."""
IRREGULAR, NO_PARTICIPLES, ADVERBS, NO_ADVERBS, PRONOUNS, ADJECTIVES = (
    frozenset(LISTS[kind].split())
    for kind in (
        "participles that do not end in -ed", "words in -ed that are not participles", "adverbs that do not end in -ly",
        "words in -ly that are not adverbs", "pronouns", "adjectives, for constants",
    )
)  # fmt: skip
ALLOWED = {
    "chunked": "controller: the term of the field for executing a whole chunk of actions",
    "disturbed": "claim `disturbed` of a gate: its module is found by this name",
    "interleaved": "kind of measurement: variants in turns",
    "named": "`RobotLimits.named`: the limits of a robot by its name",
    "paced": "kind of measurement: at a fixed rate",
    "recorded": "command `evaluate recorded`: its module is found by this name",
    "sorted": "as in the standard library",
    "structured": "command `prune structured`",
}
"""Names that are terms of the field, or names of commands."""
FIXES = {
    "told": "`describe`, `summary`, or the name of what it returns",
    "made": "a verb (`build`), or the name of what was built",
    "kept": "`store`, `retained_...`, or what is stored",
    "MOST": "MAX_..., with what is limited",
    "LEAST": "MIN_..., with what is limited",
}
IS_NO = re.compile(r"(?<!there )(?<!There )\b(?:is|are) no (?!longer\b|more\b)")


@dataclass(frozen=True, order=True)
class Finding:
    """One name or phrase.

    Args:
        kind: What is counted.
        where: ``file:line``.
        word: The name or phrase.
        fix: A suggestion.
    """

    kind: str
    where: str
    word: str
    fix: str = ""


def kind_of_word(word: str) -> str:
    """Return ``participle``, ``adverb`` or ``pronoun``; empty for any other word and for several."""
    if "_" in word:
        return ""
    if word in IRREGULAR or (word.endswith("ed") and word not in NO_PARTICIPLES):
        return "participle"
    if word in ADVERBS or (word.endswith("ly") and word not in NO_ADVERBS):
        return "adverb"
    return "pronoun" if word in PRONOUNS else ""


def lacks_noun(constant: str) -> bool:
    """Say whether no word of a constant's name can be a noun: ``MOST``, ``KEPT``, ``AT_MOST``."""
    small = {"a", "an", "and", "as", "at", "by", "for", "from", "in", "of", "on", "or", "to", "too", "up", "with"}
    words = constant.strip("_").lower().split("_")
    return all(word in small or word in ADJECTIVES or kind_of_word(word) for word in words)


def fix_for(word: str, kind: str) -> str:
    """Return what to do about a name."""
    return FIXES.get(word) or f"{kind} alone: add the noun that it goes with, or use a noun or a verb"


KINDS = (
    "modules named by a participle", "modules named by an adverb or a pronoun", "functions named by a participle",
    "functions named by an adverb or a pronoun", "functions named told", "constants without a noun",
    "constants named MOST", '"is no" in texts', "variables named place",
)  # fmt: skip


def findings(root: Path = ROOT) -> list[Finding]:
    """Return everything that is counted, in the modules of vlatool."""
    found = []
    for path in modules(root).values():
        where = path.relative_to(root).as_posix()
        found += [*_of_module(path, where), *of_tree(ast.parse(path.read_bytes()), where)]
    return sorted(found)


def _of_module(path: Path, where: str) -> Iterator[Finding]:
    yield from _of_name("modules", (path.parent.name if path.stem == "__init__" else path.stem).strip("_"), where)


def _of_name(what: str, name: str, where: str) -> Iterator[Finding]:
    if name in ALLOWED or not (kind := kind_of_word(name)):
        return
    group = "a participle" if kind == "participle" else "an adverb or a pronoun"
    yield Finding(f"{what} named by {group}", where, name, fix_for(name, kind))


def of_tree(tree: ast.Module, where: str) -> Iterator[Finding]:
    for name, line in _constants(tree):
        if lacks_noun(name):
            yield Finding(
                "constants without a noun", f"{where}:{line}", name, fix_for(name, "adjective, participle or pronoun")
            )
        if name.strip("_") == "MOST":
            yield Finding("constants named MOST", f"{where}:{line}", name, FIXES["MOST"])
    for node in ast.walk(tree):
        line = f"{where}:{getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            if not node.name.startswith("_"):
                yield from _of_name("functions", node.name, line)
            if node.name.strip("_") == "told":
                yield Finding("functions named told", line, node.name, FIXES["told"])
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            for phrase in IS_NO.finditer(node.value):
                yield Finding(
                    '"is no" in texts', line, " ".join(node.value[phrase.start() :][:40].split()), "`is not a ...`"
                )
        elif _binds(node) == "place":
            yield Finding("variables named place", line, "place", "`index`, `path`, `offset`, `position`")


def _constants(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Yield each module-level name in capitals that is assigned, and its line."""
    for node in tree.body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        for target in targets:
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            yield from ((each.id, node.lineno) for each in names if isinstance(each, ast.Name) and each.id.isupper())


def _binds(node: ast.AST) -> str:
    """Return the name that a node binds: an argument, a variable or a field."""
    if isinstance(node, ast.arg):
        return node.arg
    return node.id if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) else ""


def counts(found: list[Finding]) -> dict[str, int]:
    """Return what is counted -> how many there are."""
    return {kind: sum(each.kind == kind for each in found) for kind in KINDS}


def exceeded(found: list[Finding], allowed: dict[str, int]) -> list[str]:
    """Return a line for each count above what is allowed, and one for each name of that kind."""
    lines = []
    for kind, number in counts(found).items():
        if number > allowed.get(kind, 0):
            lines.append(f"{kind}: {number}, at most {allowed.get(kind, 0)} allowed (words_baseline.json)")
            lines += [f"  {each.where}: {each.word}: {each.fix}" for each in found if each.kind == kind]
    return lines


def main() -> None:
    """Check, count, list or lower."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", action="store_true", help="print the counts")
    parser.add_argument("--list", action="store_true", help="print each finding")
    parser.add_argument("--lower", action="store_true", help="write lower counts to words_baseline.json")
    parser.add_argument("--of", type=Path, default=ROOT, help="another checkout")
    given = parser.parse_args()
    found, allowed = findings(given.of), json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    if given.list:
        print("\n".join(f"{each.kind}: {each.where}: {each.word}: {each.fix}" for each in found))
    if given.count:
        print("\n".join(f"{kind:44}{number:6}" for kind, number in counts(found).items()))
    if given.lower:
        lowered = {kind: min(number, allowed.get(kind, number)) for kind, number in counts(found).items()}
        BASELINE.write_text(json.dumps(lowered, indent=2) + "\n")
    elif not (given.list or given.count):
        if lines := exceeded(found, allowed):
            sys.exit("\n".join(lines))
        print("names: no count is above that of tests/structure/words_baseline.json")


if __name__ == "__main__":
    main()
