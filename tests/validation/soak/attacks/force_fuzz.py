"""Random directory trees and commands with --force: no file that vlatool did not write is removed or changed.

    python tests/validation/soak/attacks/force_fuzz.py --trials 1000

Each trial builds a tree out of files of a person (sources, notes, ``.git``, manifests and reports of other programs,
names of drafts, links) and of directories that vlatool wrote (some with a file added or changed since), runs one
command in this process with an output anywhere in it, and looks at every file of the person afterwards.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3]))

from _tiny import POLICY_PY, POLICY_YAML, STATISTICS, VOCABULARY, observations, write_weights

from vlatool.cli import main
from vlatool.files.ownership import LEDGER

PERSON = {
    "notes.txt": "mine", "policy.yaml": "name: mine", "manifest.json": '{"name": "extension", "manifest_version": 3}',
    "report.json": '{"kind": "mine"}', "report.html": "<html>", ".git/config": "[core]", "gate.yaml": "schema: 1",
    "graphs/main.onnx": "weights", "recipe.yaml": "schema: 1", "data/episode.npz": "recorded", "raspberry.yaml": "x: 1",
    LEDGER: '{"schema": 1, "files": {"notes.txt": "0"}}', "gate.xml": "<testsuites/>", "workload.json": "{}",
}  # fmt: skip
DRAFTS = (".out.tmp-123-abc", ".out.tmp-999999-0badcafe", ".out.old-0badcafe", ".a.tmp-999999-deadbeef", "out.kept-1")
BRIEF = ("--iterations", "20", "--duration", "0", "--no-cold")
KINDS = ("absent", "person", "ours", "ours", "mixed", "changed", "link", "file", "empty", "nested")
ANYWHERE = (".", "..", "policy", "policy/sub", "bundle", "bundle/sub", "deep", "home", "out/sub", "./out/../out",
            "policy/policy.py")  # fmt: skip
NAMES = ("out", "a", "b", "project", "deep/er")


class Work:
    """What is made once: a policy, a bundle, an int8 bundle and a report of it, all by commands."""

    def __init__(self, place: Path) -> None:
        self.place = place
        policy = place / "policy"
        policy.mkdir()
        texts = {"policy.yaml": POLICY_YAML, "policy.py": POLICY_PY, "vocabulary.json": json.dumps(VOCABULARY)}
        for name, text in {**texts, "statistics.json": json.dumps(STATISTICS)}.items():
            (policy / name).write_text(text)
        (policy / "policy.yaml").write_text(POLICY_YAML.replace("environment:\n  make: environment.py:make\n", ""))
        (policy / "policy.yaml").write_text(POLICY_YAML.partition("environment:")[0] + "parts:\n  head: [head]\n")
        np.savez(policy / "calibration.npz", **observations(8, seed=1))
        np.savez(policy / "evaluation.npz", **observations(4, seed=2))
        write_weights(policy / "weights.safetensors")
        self.made = {"bundle": place / "bundle", "int8": place / "int8", "report": place / "report"}
        for words in (
            ["export", "onnx", policy, "-o", self.made["bundle"]],
            ["quantize", "dynamic-int8", self.made["bundle"], "-o", self.made["int8"]],
            ["evaluate", "recorded", self.made["bundle"], "-o", self.made["report"]],
        ):
            code, said = run(words)
            assert code == 0, (words, code, said)


def run(words: list[object]) -> tuple[int, str]:
    """Run a command line in this process; return its exit code and what it said."""
    said = io.StringIO()
    line = [str(word) for word in words]
    with (
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
        mock.patch.object(sys, "argv", ["x", *line]),
    ):
        try:
            main(line)
        except SystemExit as left:
            return int(left.code or 0), said.getvalue()
    return 0, said.getvalue()


def plant(root: Path, work: Work, chance: random.Random) -> None:
    """Fill a directory with a random tree."""
    (root / "home").mkdir()
    shutil.copytree(work.place / "policy", root / "policy")
    for name in NAMES:
        folder = root / name
        kind = chance.choice(
            ("absent", "person", "ours", "ours", "mixed", "changed", "link", "file", "empty", "nested")
        )
        folder.parent.mkdir(parents=True, exist_ok=True)
        if kind in ("ours", "mixed", "changed", "nested"):
            shutil.copytree(work.made[chance.choice(list(work.made))], folder)
        if kind in ("person", "mixed"):
            scatter(folder, chance)
        elif kind == "changed":
            file = chance.choice([path for path in folder.rglob("*") if path.is_file()])
            file.write_bytes(chance.choice((b"", b"changed", file.read_bytes() + b"\n")))
        elif kind == "nested":
            shutil.copytree(work.made["bundle"], folder / chance.choice(("sub", "graphs/sub")))
        elif kind == "link":
            folder.symlink_to(chance.choice(("policy", "nowhere", "bundle", "../policy")))
        elif kind == "file":
            folder.write_text("mine")
        elif kind == "empty":
            folder.mkdir()
    for draft in chance.sample(DRAFTS, 2):
        scatter(root / draft, chance)
    if chance.random() < 0.3:
        scatter(root, chance)


def scatter(folder: Path, chance: random.Random) -> None:
    """Put files of a person into a directory."""
    for name in chance.sample(list(PERSON), chance.randint(1, 4)):
        path = folder / name
        if not os.path.lexists(path):
            with contextlib.suppress(OSError):
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(PERSON[name] + f" {chance.random()}")


def ours(root: Path, work: Work) -> set[Path]:
    """Files in directories that hold what vlatool wrote and nothing else: these may go."""
    shapes = [files_of(made) for made in work.made.values()]
    found: set[Path] = set()
    for folder in [path for path in root.rglob("*") if path.is_dir()]:
        if folder.is_dir() and not folder.is_symlink() and files_of(folder) in shapes:
            found |= {path for path in folder.rglob("*") if path.is_file()}
    return found


def listed(path: Path) -> bool:
    """Say whether a file is a list that vlatool keeps, to which it adds what it writes later."""
    return path.name == LEDGER and '"The files that vlatool wrote here' in path.read_text()


def files_of(folder: Path) -> dict[str, str]:
    """Relative path -> hash of every file, links by where they lead."""
    return {
        str(path.relative_to(folder)): f"-> {path.readlink()}" if path.is_symlink() else digest(path)
        for path in sorted(folder.rglob("*")) if path.is_symlink() or path.is_file()
    }  # fmt: skip


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def command(root: Path, chance: random.Random) -> list[object]:
    """Return a random command with a random output."""
    out = chance.choice((*NAMES, *NAMES, *ANYWHERE, str(root / "out"), f"../{root.name}"))
    folder = chance.choice((out, out, "/"))
    source = chance.choice(("bundle", "bundle", "policy", "policy/policy.py:make", *NAMES))
    force = ["--force"] if chance.random() < 0.85 else []
    cheap: list[Callable[[], list[object]]] = [
        lambda: ["evaluate", "recorded", source, "-o", folder, *force],
        lambda: ["compare", "report", chance.choice(("report", *NAMES)), "-o", out, *force],
        lambda: ["gate", "init", out, *force],
        lambda: ["profiles", "new", "mine", "-o", chance.choice((out, f"{out}/mine.yaml", f"{out}/notes.txt")), *force],
        lambda: ["quantize", "dynamic-int8", source, "-o", out, *force],
        lambda: ["optimize", source, "-o", out, "--dry-run", *force],
        lambda: ["hwselect", "bundle", "--boards", "raspberry-pi-5", "-o", out, *force],
        lambda: ["rebuild", source, "--source", "policy", "-o", out, *force],
        lambda: [
            "gate",
            source,
            "--baseline",
            "bundle",
            "--junit",
            f"{out}/gate.xml",
            "-o",
            out,
            "--margin",
            "x",
            *force,
        ],
        lambda: ["gate", "missing", "--baseline", "bundle", "--junit", chance.choice((out, f"{out}/gate.xml")), *force],
        lambda: ["samples", "make", "nothing", "-o", out, *force],
    ]
    dear: list[Callable[[], list[object]]] = [
        lambda: ["export", "onnx", source, "-o", out, *force],
        lambda: [
            "benchmark",
            "latency",
            source,
            "-o",
            out,
            "--iterations",
            "20",
            "--duration",
            "0",
            "--no-cold",
            *force,
        ],
        lambda: ["explain", source, "-o", out, "--no-suggest", "--samples", "1", *force],
        lambda: ["quantize", "weight-only", source, "-o", out, *force],
    ]
    return chance.choice(dear if chance.random() < 0.1 else cheap)()


def trial(work: Work, seed: int) -> tuple[str, list[str]]:
    """Run one command in one tree; return what came of it and every file that is missing or changed."""
    chance = random.Random(seed)
    root = Path(tempfile.mkdtemp(prefix="force-", dir=work.place / "trials"))
    plant(root, work, chance)
    for name, made in work.made.items():
        if name != "int8":
            shutil.copytree(made, root / name)
    replaceable = ours(root, work)
    kept = {name: value for name, value in files_of(root).items() if root / name not in replaceable}
    before = {name: value for name, value in kept.items() if not listed(root / name)}
    words = command(root, chance)
    here = Path.cwd()
    os.chdir(root)
    try:
        with mock.patch.dict(os.environ, {"HOME": str(root / "home"), "VLATOOL_CACHE": str(work.place / "cache")}):
            code, said = run(words)
    finally:
        os.chdir(here)
    after = files_of(root)
    lost = [f"{name} is missing or changed" for name in before if after.get(name) != before[name]]
    crashed = [f"exit {code}: {said[-300:]}"] if code == 70 or "Traceback" in said else []
    wrong = [f"seed {seed}: vlatool {' '.join(map(str, words))}: {each}" for each in (*lost, *crashed)]
    shutil.rmtree(root)
    return f"{words[0]} exit {code}", wrong


def fuzz(trials: int, seed: int, place: Path, tell: Callable[[str], None] = print) -> list[str]:
    """Run trials and return what went wrong; ``tell`` gets each of these and a table of outcomes."""
    (place / "trials").mkdir()
    with mock.patch.dict(os.environ, {"VLATOOL_CACHE": str(place / "cache")}):
        work = Work(place)
    outcomes: Counter[str] = Counter()
    wrong: list[str] = []
    for number in range(trials):
        outcome, found = trial(work, seed + number)
        outcomes[outcome] += 1
        wrong += found
        for each in found:
            tell(each)
    for outcome, count in sorted(outcomes.items()):
        tell(f"{count:6}  {outcome}")
    tell(f"{trials} trials, {len(wrong)} files lost or changed")
    return wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="force-fuzz-") as folder:
        sys.exit(bool(fuzz(arguments.trials, arguments.seed, Path(folder))))
