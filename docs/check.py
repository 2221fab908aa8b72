"""Check what the pages say against the repository: links, paths, commands, quoted messages, words.

Usage: python docs/check.py
"""

from __future__ import annotations

import ast
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
OUTPUTS = "out"
"""Folder of what commands write, which the repository does not have."""
PLACES = ("", "vlatool", "tests", "docs")
"""Folders that a path on a page may start from, beside the page's own."""
GROUPS = {"control", "engines", "profiles", "commands", "sections", "videos", "claims", "measures"}
"""Entry point groups that are not packages of vlatool."""
EVERYWHERE = ("--help", "--trust", "--python", "--unnorm-key")
"""Options that every command takes, whether its help lists them or not."""
STILTED = (
    r"\bmend(s|ed|ing)?\b",
    r"\bleaves? with (code |exit code )?\d",
    r"\bnobody's business\b",
    r"\braces? each other\b",
    r"\b(is|are|was|were) held against\b",
    r"\bhanded? out\b",
    r"\bfor whoever\b",
    r"\bsomebody else's\b",
    r"\b(is|are) (told|seen) (as|to)\b",
    r"\bwhat is told\b",
    r"\bis no (bundle|policy|tokenizer|fault|measure|signature)\b",
    r"\bin the place of\b",
    r"\bwhen nothing is said\b",
    r"\bcould not be had\b",
)
"""Phrases that read as translated."""

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ +(.+)$", re.MULTILINE)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
FILE = re.compile(r"(?<![\w/.~…-])((?:[\w-]+/)+[\w.-]+\.(?:py|md|json|csv|yaml|npz|onnx))(?![\w/])")
MODULE = re.compile(r"(?<![\w.-])vlatool((?:\.[A-Za-z_]\w*)+)(?!\w)(?!:)")
PRIVATE = re.compile(r"^_[a-z][a-z0-9_]*$")
MESSAGE = re.compile(r"^\s*(?:error|warning|fix|warn +[\w ]+): (.+)$", re.MULTILINE)
TABLE_OF_MESSAGES = "what it says"


@dataclass(frozen=True)
class Page:
    """A Markdown file.

    Args:
        path: Where it is.
        text: What it says.
        root: The repository that it belongs to.
    """

    path: Path
    text: str
    root: Path = field(default=ROOT)

    @property
    def prose(self) -> str:
        """The text without its fenced blocks."""
        return FENCE.sub("", self.text)

    @property
    def blocks(self) -> Iterator[tuple[str, str]]:
        """The language and the text of each fenced block."""
        return ((block[1], block[2]) for block in FENCE.finditer(self.text))


def main() -> None:
    """Check every page; print each fault and exit with 1 when there is one."""
    pages = [Page(path, path.read_text(encoding="utf-8")) for path in page_paths(ROOT)]
    faults = [f"{page.path.relative_to(ROOT)}: {fault}" for page in pages for check in CHECKS for fault in check(page)]
    faults += pages_named_by_code(ROOT)
    if faults:
        sys.exit("\n".join(faults))
    print(f"links, paths, commands, quoted messages and words are right ({len(pages)} pages)")


def page_paths(root: Path) -> list[Path]:
    """Return the pages that people write; ``docs/reference`` is generated."""
    pages = [root / "README.md", *(root / "docs").rglob("*.md"), *(root / "sample_models").glob("*/README.md")]
    validation = (root / "tests/validation").glob("*.md")
    return sorted(page for page in (*pages, *validation) if page.parent.name != "reference")


def pages_named_by_code(root: Path) -> list[str]:
    """Return each page that the code or a test names and that does not exist."""
    sources = [*(root / "vlatool").rglob("*.py"), *(root / "tests").rglob("*.py")]
    files = [root / "Makefile", *(file for file in sources if file.parent.name != "docs")]
    return [
        f"{file.relative_to(root)}: there is no page {name}"
        for file in files
        for name in re.findall(r"\bdocs/[\w/-]+\.md\b", file.read_text(encoding="utf-8"))
        if not (root / name).is_file()
    ]


def links(page: Page) -> Iterator[str]:
    """Yield each link that leads nowhere."""
    for target in LINK.findall(page.prose):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        path = page.path.parent / name
        if name and not path.exists():
            yield f"the link {target} leads nowhere"
        elif anchor and anchor not in anchors(path.read_text(encoding="utf-8") if name else page.text):
            yield f"the link {target} names a heading that the page does not have"


def anchors(text: str) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a page."""
    titles = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title) for title in HEADING.findall(FENCE.sub("", text)))
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


def paths(page: Page) -> Iterator[str]:
    """Yield each file, module and private part that a page names and the repository does not have."""
    shown = set(re.findall(r"^`([^`\n]+)`$", page.text, re.MULTILINE))
    for code in [*CODE.findall(page.prose), *(text for _, text in page.blocks)]:
        for name in FILE.findall(code):
            if name not in shown and belongs(name, page.root) and not exists(name, page):
                yield f"there is no file {name}"
        for dotted in MODULE.findall(code):
            if not has_module(dotted.strip(".").split("."), page.root):
                yield f"there is no module vlatool{dotted}"
        if PRIVATE.match(code) and not private_part(code, page.root):
            yield f"no file is called {code}.py"


def belongs(name: str, root: Path) -> bool:
    """Say whether a path claims to be in the repository; a bundle and a policy have ``.json`` files of their own."""
    first, end = name.split("/")[0], Path(name).suffix
    return (first != OUTPUTS and (root / first).is_dir()) or (
        end in (".py", ".md") and any((root / place / first).is_dir() for place in PLACES)
    )


def exists(name: str, page: Page) -> bool:
    """Say whether a path is there, from the root, from a folder of ``PLACES`` or beside the page."""
    return any((base / name).exists() for base in (*(page.root / place for place in PLACES), page.path.parent))


def has_module(parts: list[str], root: Path) -> bool:
    """Say whether ``vlatool.a.b`` is a module, or a name that the module holds."""
    place = root / "vlatool"
    for index, part in enumerate(parts):
        if (place / part).is_dir():
            place /= part
            continue
        file = place / f"{part}.py"
        if file.is_file():
            return len(parts) == index + 1 or bool(re.search(rf"\b{parts[index + 1]}\b", file.read_text("utf-8")))
        init = place / "__init__.py"
        return (index == 0 and part in GROUPS) or (
            init.is_file() and bool(re.search(rf"\b{part}\b", init.read_text("utf-8")))
        )
    return True


@cache
def private_part(name: str, root: Path) -> bool:
    """Say whether a private module or package of that name is in the sources or the tests."""
    return any(
        next((root / place).rglob(f"{name}{suffix}"), None) for place in ("vlatool", "tests") for suffix in ("", ".py")
    )


def commands(page: Page) -> Iterator[str]:
    """Yield each command of vlatool or make that a page shows and that does not exist."""
    shown = [line for kind, text in page.blocks if kind in ("", "sh", "text") for line in joined(text)]
    targets = set(re.findall(r"^([a-z0-9]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    for line in [*shown, *(code for code in CODE.findall(page.prose) if re.match(r"(vlatool|make) [a-z-]", code))]:
        for words in simple_commands(line):
            if words[0] == "make" and len(words) > 1 and words[1] not in targets:
                yield f"make has no target {words[1]}: {line}"
            if words[0] == "vlatool":
                yield from (f"{fault}: {line}" for fault in unknown_words(words[1:]))


def joined(text: str) -> list[str]:
    """Return the lines of a block, those that end in a backslash joined with the next one."""
    return text.replace("\\\n", " ").splitlines()


def simple_commands(line: str) -> Iterator[list[str]]:
    """Yield the words of each command of ``vlatool`` or ``make`` on a line of a shell."""
    try:
        words = shlex.split(line.replace("…", "..."), comments=True)
    except ValueError:
        return
    commands: list[list[str]] = [[]]
    for word in words:
        commands.append([]) if word in ("&&", "|", ";") else commands[-1].append(word)
    for command in commands:
        while command and (re.match(r"[A-Z_]+=", command[0]) or command[0] in ("time", "/usr/bin/time", "-v", "sudo")):
            command = command[1:]
        if len(command) > 1 and command[0] in ("vlatool", "make"):
            yield command


def unknown_words(words: list[str]) -> Iterator[str]:
    """Yield the commands and options of ``words`` that the command line does not take."""
    node = command_tree()
    if words[0] not in node.commands and not words[0].startswith("-"):
        if re.fullmatch(r"[a-z-]+", words[0]):
            yield f"vlatool has no command {words[0]}"
        return
    while words and words[0] in getattr(node, "commands", {}):
        node, words = node.commands[words[0]], words[1:]
    known = options(node)
    for word in words:
        name = word.partition("=")[0]
        if name.startswith("--") and name != "--" and name not in known:
            yield f"{node.name or 'vlatool'} has no option {name}"


def options(node: Any) -> set[str]:
    """Return the options of a command and, for a group, those of its commands: one of them may be the default."""
    own = {name for parameter in node.params for name in (*parameter.opts, *parameter.secondary_opts)}
    return own.union(EVERYWHERE, *(options(child) for child in getattr(node, "commands", {}).values()))


@cache
def command_tree() -> Any:
    """Return the command line as click sees it, every command loaded."""
    import typer

    from vlatool.cli import app

    return loaded(typer.main.get_command(app))


def loaded(node: Any) -> Any:
    """Return a group whose ``commands`` holds what ``list_commands`` lists."""
    lister = getattr(node, "list_commands", None)
    if lister:
        node.commands = {name: loaded(node.get_command(None, name)) for name in lister(None)}
    return node


def messages(page: Page) -> Iterator[str]:
    """Yield each message that a page quotes and the source does not have (``…`` stands for what differs)."""
    quoted = [text for kind, block in page.blocks if kind in ("", "text") for text in MESSAGE.findall(block)]
    for quote in [*quoted, *quotes_in_tables(page.prose)]:
        if not any(says(message, quote) for message in source_messages(page.root)):
            yield f"no message of the source reads: {quote}"


def says(message: str, quote: str) -> bool:
    """Say whether a message of the source holds the quote, or becomes it when its values are put in."""
    if quote.strip("… ") in message:
        return True
    literals = message.split("…")
    if len(literals) == 1 or sum(map(len, literals)) < 12:
        return False
    return bool(re.fullmatch(".*".join(map(re.escape, literals)), quote))


def quotes_in_tables(prose: str) -> Iterator[str]:
    """Yield the code spans in the first column of each table whose first column is what a program says."""
    for table in re.findall(r"(?:^\|.*\n)+", prose, re.MULTILINE):
        rows = [re.split(r"(?<!\\)\|", row)[1].strip() for row in table.splitlines()]
        if rows[0] == TABLE_OF_MESSAGES:
            yield from (quote for row in rows[2:] for quote in CODE.findall(row))


@cache
def source_messages(root: Path) -> tuple[str, ...]:
    """Return every string of the source, with ``…`` where a value is put in."""
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in sorted((root / "vlatool").rglob("*.py")))
    return tuple(dict.fromkeys(text for tree in trees for node in ast.walk(tree) if (text := rendered(node))))


def rendered(node: ast.AST) -> str:
    """Return a string of the syntax tree as a person reads it; empty for anything else."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(rendered(value) or "…" for value in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = rendered(node.left), rendered(node.right)
        return f"{left or '…'}{right or '…'}" if left or right else ""
    return ""


def words(page: Page) -> Iterator[str]:
    """Yield each stilted phrase."""
    for pattern in STILTED:
        for phrase in re.finditer(pattern, page.prose, re.IGNORECASE):
            yield f"not idiomatic: {phrase[0]!r}"


CHECKS: tuple[Callable[[Page], Iterator[str]], ...] = (links, paths, commands, messages, words)

if __name__ == "__main__":
    main()
