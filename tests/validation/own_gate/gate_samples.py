"""Hold the sample policies, as this tree makes them, against those that another commit makes.

    python tests/validation/own_gate/gate_samples.py --base origin/main -o out/gate

For each sample the base commit's code makes an int8 bundle from its own copy of the sample, and this tree's code makes
one from this tree's; ``vlatool gate`` then decides by ``sample_models/NAME/gate.yaml``. Where both made the same
graphs, byte for byte, there is nothing to measure, which is said. Leaves with the worst exit code of the gates: 0, 1
or 5.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).parents[3]
WORST = (1, 5, 0)
"""Exit codes of a gate from the worst to the best; any other one ends the run."""
EVERYWHERE = ("--no-reduce-range",)
"""Options with which the same code makes the same bundle on every processor."""


def main() -> int:
    """Gate every sample that has a gate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--base", default="", help="commit of the baseline; where this branch left origin/main if unset"
    )
    parser.add_argument("--always", action="store_true", help="measure also where the graphs are the same")
    parser.add_argument(
        "-o", "--output", type=Path, default=ROOT / "out/gate", help="directory for bundles and reports"
    )
    given = parser.parse_args()
    base = given.base or base_commit()
    if not base:
        print("no earlier commit to hold this one against: nothing to gate")
        return 0
    codes = []
    with checked_out(base) as tree:
        for gate in sorted(ROOT.glob("sample_models/*/gate.yaml")):
            sample = gate.parent.relative_to(ROOT)
            out = given.output.resolve() / gate.parent.name
            if not (tree / sample / "policy.yaml").is_file():
                print(f"{sample}: not in {base[:12]}, so there is nothing to hold it against")
                continue
            with ThreadPoolExecutor(2) as both:  # nothing is measured yet
                baseline, candidate = both.map(
                    quantized, (tree, ROOT), (sample,) * 2, (out / "baseline", out / "candidate")
                )
            codes.append(gated(candidate, baseline, gate, out, given.always))
    return next((code for code in WORST if code in codes), 0)


def base_commit() -> str:
    """Return where this branch left origin/main, or, on it, the commit before this one; nothing when there is none."""
    head = git("rev-parse", "HEAD")
    for words in (("merge-base", "HEAD", "origin/main"), ("rev-parse", "--verify", "--quiet", "HEAD~1")):
        found = git(*words)
        if found and found != head:
            return found
    return ""


def git(*words: str) -> str:
    """Return what git prints; nothing when it fails."""
    done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""


@contextlib.contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """Yield a directory with the tree of a commit, and remove it in the end."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "base"
        git("worktree", "prune")  # what a run that was killed left
        subprocess.run(
            ["git", "-C", str(ROOT), "worktree", "add", "--quiet", "--detach", str(tree), commit], check=True
        )
        try:
            yield tree
        finally:
            subprocess.run(["git", "-C", str(ROOT), "worktree", "remove", "--force", str(tree)], check=False)


def quantized(tree: Path, sample: Path, out: Path) -> Path:
    """Make the int8 bundle of a sample with the code of a tree.

    Raises:
        SystemExit: when that fails.
    """
    command = [sys.executable, "-m", "vlatool", "quantize", str(sample), "-o", str(out), "--force", *EVERYWHERE]
    place = {**os.environ, "PYTHONPATH": str(tree), "VLATOOL_CACHE": str(out.parent / f"{out.name}-cache")}
    if subprocess.run(command, cwd=tree, env=place, check=False).returncode:
        raise SystemExit(f"{sample} cannot be quantized with the code of {tree}")
    return out


def graphs(bundle: Path) -> dict[str, str]:
    """Return file -> SHA-256 of what the engine runs, and how."""
    manifest = json.loads((bundle / "manifest.json").read_text())
    files = {
        name: entry["sha256"] for name, entry in manifest["files"].items() if name.startswith(("graphs/", "assets/"))
    }
    return {**files, "program": json.dumps(manifest["program"], sort_keys=True), "engine": manifest.get("engine", "")}


def gated(candidate: Path, baseline: Path, gate: Path, out: Path, always: bool) -> int:
    """Return the exit code of a gate."""
    if graphs(candidate) == graphs(baseline) and not always:
        print(f"{gate.parent.name}: the same graphs, byte for byte: nothing to measure")
        return 0
    options = ["--baseline", baseline, "--config", gate, "-o", out / "report", "--junit", out / "gate.xml", "--force"]
    command = [sys.executable, "-m", "vlatool", "gate", str(candidate), *map(str, options)]
    code = subprocess.run(command, cwd=ROOT, check=False).returncode
    if code not in WORST:
        raise SystemExit(code)
    return code


if __name__ == "__main__":
    sys.exit(main())
