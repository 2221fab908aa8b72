"""Virtual environments that are confined to an instruction set: their libraries believe that the processor has no more.

Each CPUID instruction of the environment's libraries is replaced by one that traps, and the environment's Python is
replaced by a program that starts the real one with a library that answers these traps without the hidden features
(``confined/hide.c``, ``confined/launch.c``). Where AVX-VNNI is wanted and the host has AVX512-VNNI instead, that
library has the instructions of the one carried out by those of the other (``confined/avx_vnni.h``). Whatever starts the
environment's Python is confined with it: children, isolated ones (``-I``) and those with an empty environment. Another
Python is not.
"""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _cpuid
from _sets import ANY, InstructionSet, RefusedError, masks

SOURCES = Path(__file__).with_name("confined")
SEEN = Path(__file__).with_name("seen.py")
LIBRARY = re.compile(r"\.so(\.|-|$)")
NEEDED = ("capstone", "elftools")
SECONDS = 600
"""How long the libraries may take to say what they see."""


class UnconfinedError(Exception):
    """A library sees what is hidden, so that nothing it computes is of the set."""


@dataclass(frozen=True)
class Environment:
    """A virtual environment.

    Args:
        root: Its directory.
    """

    root: Path

    @property
    def python(self) -> Path:
        """Its interpreter."""
        return self.root / "bin/python"

    @property
    def folder(self) -> Path:
        """Where what confines it is kept."""
        return self.root / "confined"

    @property
    def settings(self) -> dict[str, str]:
        """What ``pyvenv.cfg`` says."""
        lines = (self.root / "pyvenv.cfg").read_text(encoding="utf-8").splitlines()
        return {key.strip(): value.strip() for key, _, value in (line.partition("=") for line in lines)}

    def real_python(self) -> Path:
        """Return the interpreter that it was made with.

        Raises:
            RefusedError: when it is gone.
        """
        version = ".".join(self.settings.get("version", self.settings.get("version_info", "")).split(".")[:2])
        found = Path(self.settings.get("home", "")) / f"python{version}"
        if not os.access(found, os.X_OK):
            raise RefusedError(f"the Python that {self.root} was made with, {found}, does not exist.")
        return found.resolve()

    def interpreters(self) -> Iterator[Path]:
        """Yield what is started as Python in it."""
        return (path for path in (self.root / "bin").iterdir() if re.fullmatch(r"python[\d.]*", path.name))

    def libraries(self) -> Iterator[Path]:
        """Yield its shared libraries, each once."""
        for path in sorted((self.root / "lib").rglob("*.so*")):
            if LIBRARY.search(path.name) and path.is_file() and not path.is_symlink():
                yield path


def environment(path: Path) -> Environment:
    """Return the virtual environment in a directory, if this host can confine it.

    Raises:
        RefusedError: when it cannot, or there is none.
    """
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise RefusedError(
            f"environments are confined on Linux on x86-64; this is {sys.platform} on {platform.machine()}."
        )
    root = path.absolute()
    if not (root / "pyvenv.cfg").is_file() or not (root / "bin/python").exists():
        raise RefusedError(f"{path} is not a virtual environment: make one with python3 -m venv {path}.")
    if re.search(r"[\s:]", str(root)):
        raise RefusedError(f"the path {root} holds a blank or a colon, which LD_PRELOAD cannot name.")
    for folder in (root, root / "bin", root / "lib"):
        if not os.access(folder, os.W_OK):
            raise RefusedError(f"{folder} cannot be written, and confining changes what is in it.")
    return Environment(root)


def confine(
    place: Environment, target: InstructionSet, has: Collection[str], tell: Callable[[str], None] = print
) -> int:
    """Confine an environment, again where packages were installed since, and return how many libraries it changed.

    Args:
        place: The environment.
        target: The set.
        has: The features of this host's processor.
        tell: Takes a line for each library that is changed.

    Raises:
        RefusedError: when something that this takes is missing.
    """
    missing = [name for name in NEEDED if not can_import(name)]
    if missing:
        raise RefusedError(f"{' and '.join(missing)} cannot be imported: install capstone and pyelftools.")
    real = place.real_python()
    place.folder.mkdir(exist_ok=True)
    (place.folder / "hidden.h").write_text(header(target, place.folder / "hide.so", has), encoding="utf-8")
    compiled("hide.c", place.folder / "hide.so", place, "-shared", "-fPIC")
    if not (place.folder / "probe.so").exists():
        compiled("probe.c", place.folder / "probe.so", place, "-shared", "-fPIC")
    launcher = place.folder / "python"
    preloaded = f'-DPRELOADED="{place.folder / "hide.so"}"'
    compiled("launch.c", launcher, place, f'-DPYTHON="{real}"', preloaded)
    for path in list(place.interpreters()):
        put(launcher, path)
    return patched(place, tell)


def can_import(name: str) -> bool:
    """Say whether a module is installed here."""
    import importlib.util

    return importlib.util.find_spec(name) is not None


def header(target: InstructionSet, preloaded: Path, has: Collection[str]) -> str:
    """Return what ``hide.c`` includes: the bits and names of the hidden features, and whether AVX-VNNI is added."""
    rows = [
        f"  {{{leaf:#x}u, {subleaf:#x}u, {{{', '.join(f'{word:#x}u' for word in words)}}}}},"
        for (leaf, subleaf), words in masks(target.hidden).items()
    ]
    names = ", ".join(f'"{name}"' for name in sorted(target.hidden))
    return "\n".join(
        [
            f"// {target.name}",
            f"#define ANY {ANY:#x}u",
            f'#define PRELOADED "{preloaded}"',
            f"#define AVX_VNNI {int('avx_vnni' in target.added(has))}",
            "static const struct { unsigned leaf, subleaf, bits[4]; } hidden[] = {",
            *rows,
            "};",
            f"static const char *const names[] = {{{names}}};",
            "",
        ]
    )


def compiled(source: str, target: Path, place: Environment, *options: str) -> None:
    """Compile a source file, in one step for whoever uses the old result meanwhile.

    Raises:
        RefusedError: when there is no compiler, or it fails.
    """
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise RefusedError("there is no gcc: install it (apt-get install gcc libc6-dev).")
    draft = target.with_name(f".{target.name}.draft")
    words = [compiler, "-O2", "-U_FORTIFY_SOURCE", f"-I{place.folder}", *options, "-o", str(draft)]
    done = subprocess.run([*words, str(SOURCES / source), "-ldl"], capture_output=True, text=True, check=False)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error" in line] or ["it says nothing"]
        raise RefusedError(f"gcc does not compile {source}: {lines[0].strip()[:200]}")
    draft.replace(target)


def put(file: Path, target: Path) -> None:
    """Copy a file onto another in one step, a link itself and not what it links to."""
    draft = target.with_name(f".{target.name}.draft")
    shutil.copy2(file, draft)
    draft.replace(target)


def patched(place: Environment, tell: Callable[[str], None]) -> int:
    """Replace CPUID in what was not looked at before, and return how many libraries that changed."""
    file = place.folder / "libraries.json"
    known: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    looked_at, changed = {}, 0
    for path in [*place.libraries(), place.folder / "probe.so"]:
        name = str(path.relative_to(place.root))
        if known.get(name) != identity(path):
            found = _cpuid.search(path)
            if found.instructions:
                _cpuid.replace(path, found.instructions)
                changed += 1
                tell(f"{name}: {len(found.instructions)} CPUID replaced, {found.others} look-alikes left")
        looked_at[name] = identity(path)
    file.write_text(json.dumps(looked_at, indent=0))
    return changed


def identity(path: Path) -> list[int]:
    """Return what tells a file from another that takes its place."""
    state = path.stat()
    return [state.st_size, state.st_mtime_ns, state.st_ino]


def check(place: Environment, target: InstructionSet) -> dict[str, dict[str, bool]]:
    """Ask the environment's libraries what they see, in a process of its own Python, and return that.

    Raises:
        UnconfinedError: when one sees a hidden feature, lacks one that the set has, or cannot be asked.
    """
    words = [str(place.python), "-I", str(SEEN), str(place.folder / "probe.so")]
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        raise UnconfinedError(f"the libraries do not say within {SECONDS} s what they see.") from None
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise UnconfinedError(f"asking the libraries what they see ended with {done.returncode}: {last[:200]}")
    seen: dict[str, dict[str, bool]] = json.loads(done.stdout.splitlines()[-1])
    if wrong := faults(seen, target):
        raise UnconfinedError("; ".join(wrong) + ".")
    return seen


def faults(seen: Mapping[str, Mapping[str, bool | str]], target: InstructionSet) -> list[str]:
    """Return what libraries see that they must not, and what they do not see and should."""
    wrong = []
    for library, states in seen.items():
        if error := states.get("error"):
            wrong.append(f"{library} cannot be asked ({error})")
            continue
        wanted = target.expected
        more = [feature for feature, state in states.items() if state and wanted.get(feature) is False]
        less = [feature for feature, state in states.items() if not state and wanted.get(feature) is True]
        if more:
            wrong.append(f"{library} still sees {', '.join(more)}")
        if less:
            wrong.append(f"{library} does not see {', '.join(less)}, which {target.name} has")
    return wrong
