"""Count what the structure of vlatool is held to: modules at the root, private imports, circles, lines, files to write.

    python tests/structure/count.py
    python tests/structure/count.py --of OTHER_CHECKOUT
    python tests/structure/count.py --check     # whether docs/architecture.md says the same; --write: make it so

Prints one line for each count. Nothing of vlatool is imported. How many files a new entry takes is read from
``tests/plugins``: what another package has to write, the entry points aside.
"""

from __future__ import annotations

import argparse
import ast
import configparser
import re
import sys
from pathlib import Path

from imports import ROOT, circles, modules, private_imports

ENTRIES = {
    "quantization method": ("vlatool.quantize", ""),
    "kind of source": ("vlatool.sources", ""),
    "source of a directory": ("vlatool.sources", '"a directory with'),
    "engine": ("vlatool.engines", ""),
    "engine on another provider": ("vlatool.engines", "\n    providers = "),
    "reader of recordings": ("vlatool.data", ""),
    "reader of a directory": ("vlatool.data", '"a directory with'),
    "controller": ("vlatool.control", "def act("),
    "policy wrapper": ("vlatool.control", "def infer("),
    "gate claim": ("vlatool.claims", ""),
    "measure": ("vlatool.measures", ""),
    "report section": ("vlatool.sections", ""),
    "format of videos": ("vlatool.videos", ""),
    "command": ("vlatool.commands", ""),
}
"""What is added -> its group of entry points, and a text in the file of those that are meant."""
ABSENT = "no example"
BEGIN, END = "<!-- written by tests/structure/count.py: make docs -->", "<!-- end -->"


def counts(root: Path = ROOT) -> dict[str, int]:
    """Return what is counted -> how many there are."""
    known = modules(root)
    return {
        "modules at the root": sum(name.count(".") == 1 and path.name != "__init__.py" for name, path in known.items()),
        "private imports across packages": len(private_imports(root)),
        "circles of modules": len(circles(root)),
        "modules": len(known),
        "lines": sum(path.read_bytes().count(b"\n") for path in known.values()),
        "longest module": max(path.read_bytes().count(b"\n") for path in known.values()),
    }


def entry_files(root: Path = ROOT) -> dict[str, int]:
    """Return what may be added -> the fewest files that an example in ``tests/plugins`` consists of; 0 without one."""
    plugins = root / "tests/plugins"
    points = entry_points(plugins / "test_plugins.py")
    found = {}
    for what, (group, text) in ENTRIES.items():
        files = [closure(plugins, module) for module in points.get(group, ())]
        sizes = [len(each) for each in files if each and text in next(iter(each)).read_text(encoding="utf-8")]
        found[what] = min(sizes, default=0)
    return found


def entry_points(test: Path) -> dict[str, list[str]]:
    """Return each group of entry points in ``ENTRY_POINTS`` of a test -> the modules that it names."""
    for node in ast.parse(test.read_bytes()).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "ENTRY_POINTS":
            parser = configparser.ConfigParser(delimiters="=")
            parser.read_string(ast.literal_eval(node.value))
            return {group: [value.partition(":")[0] for _, value in parser.items(group)] for group in parser.sections()}
    return {}


def closure(folder: Path, module: str) -> dict[Path, None]:
    """Return the file of a module below a folder, then those that it imports there; empty if there is none."""
    found: dict[Path, None] = {}
    wanted = [module]
    while wanted:
        path = folder / (wanted.pop().replace(".", "/") + ".py")
        if not path.is_file() or path in found:
            continue
        found[path] = None
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Import):
                wanted += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                wanted += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return found


def table(root: Path = ROOT) -> str:
    """Return what docs/architecture.md says of the counts: what does not change with every commit."""
    held = {what: number for what, number in counts(root).items() if what not in ("modules", "lines", "longest module")}
    files = {f"files for a new {what}": number or ABSENT for what, number in entry_files(root).items()}
    return "\n".join(
        ["| count | |", "|---|---|", *(f"| {what} | {number} |" for what, number in (held | files).items())]
    )


def replaced(page: str, begin: str, text: str) -> str:
    """Return a page with the text between a line ``begin`` and the next ``<!-- end -->``."""
    pattern = re.compile(f"{re.escape(begin)}\n(?:.*?\n)??{re.escape(END)}", re.DOTALL)
    return pattern.sub(lambda _: f"{begin}\n{text}\n{END}", page)


def main() -> None:
    """Print the counts, or compare the page with them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--of", type=Path, default=ROOT, help="another checkout")
    parser.add_argument("--check", action="store_true", help="exit 1 when docs/architecture.md says something else")
    parser.add_argument("--write", action="store_true", help="write the counts into docs/architecture.md")
    given = parser.parse_args()
    page = given.of / "docs/architecture.md"
    if given.check or given.write:
        before = page.read_text(encoding="utf-8")
        after = replaced(before, BEGIN, table(given.of))
        if given.write:
            page.write_text(after, encoding="utf-8")
        elif after != before or BEGIN not in before:
            sys.exit("docs/architecture.md says other counts than tests/structure/count.py; run: make docs")
        return
    for what, number in counts(given.of).items():
        print(f"{what:52}{number:7}")
    for what, number in entry_files(given.of).items():
        print(f"{f'files for a new {what}':52}{number or ABSENT:>7}")


if __name__ == "__main__":
    main()
