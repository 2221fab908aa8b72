"""Seven policies that nobody of this project wrote, through every command: a table of what works and what is refused.

    python tests/validation/foreign/table.py --common VENV --lerobot VENV -o out/foreign
    python tests/validation/foreign/table.py ... --only ppo_mlp --rows 'quantize*'
    python tests/validation/foreign/table.py -o out/foreign --report        # print again what was found last
    python tests/validation/foreign/table.py --common VENV --lerobot VENV -o out/foreign --guides   # the guides, too

Each policy is made anew from its original, and each command runs in a process of its own. What was found is kept below
the output, so that an interrupted run goes on; --fresh forgets it. Exits 1 when a cell is neither right nor refused
with a remedy, or a guide does not run.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from _cells import ANSWERS, VLATOOL, Cell, cells, gate_file
from _foreign import BY_NAME, HERE, POLICIES, Foreign
from _guide import GUIDES, GuideError, follow
from _verdict import FAULT, GOOD, MISSING, Verdict, judge, markdown

LIMIT_S = 1800.0
"""A command that takes longer is a fault."""


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--common", type=Path, help="environment with transformers and stable-baselines3")
    parser.add_argument("--lerobot", type=Path, help="environment with lerobot")
    parser.add_argument("--only", nargs="+", default=["*"], metavar="GLOB", help="policies by name")
    parser.add_argument("--rows", nargs="+", default=["*"], metavar="GLOB", help="rows by name")
    parser.add_argument("--fresh", action="store_true", help="run again what was run before")
    parser.add_argument("--report", action="store_true", help="run nothing: print what was found last")
    parser.add_argument("--guides", nargs="*", metavar="GLOB", help="also follow the guides, all or by name")
    parser.add_argument("-o", "--output", type=Path, required=True, help="where everything is made")
    return parser.parse_args(arguments)


def main() -> int:
    """Run what is asked for, and print the table."""
    asked = parse()
    folder = asked.output.resolve()
    chosen = [policy for policy in POLICIES if wanted(policy.name, asked.only)]
    if not asked.report:
        for policy in chosen:
            run(policy, asked, folder)
    found = {place: verdict for policy in chosen for place, verdict in verdicts(policy, folder).items()}
    text = markdown([(policy.name, policy.title) for policy in chosen], rows_of(chosen, found), found)
    (folder / "table.md").write_text(text, encoding="utf-8")
    print(text)
    guides = asked.guides is None or followed(asked, folder)
    bad = [f"{name}: {row}" for (name, row), verdict in found.items() if verdict.kind not in GOOD]
    done = sum(verdict.kind != MISSING for verdict in found.values())
    print(f"{done} of {len(found)} cells run, {len(bad)} not good" + "".join(f"\n  {line}" for line in bad))
    return 1 if bad or not guides else 0


def wanted(name: str, globs: Sequence[str]) -> bool:
    """Whether a name is among those that were asked for."""
    return any(fnmatch.fnmatchcase(name, glob) for glob in globs)


def rows_of(chosen: Sequence[Foreign], found: dict[tuple[str, str], Verdict]) -> list[str]:
    """The rows of the table, in their order."""
    order = dict.fromkeys(cell.row for policy in chosen for cell in cells(policy))
    return [row for row in order if any((policy.name, row) in found for policy in chosen)]


def run(policy: Foreign, asked: argparse.Namespace, folder: Path) -> None:
    """Make a policy and do every command with it that was not done before."""
    venv = environment(asked, policy.packages)
    done = {} if asked.fresh else kept(folder, policy)
    make(policy, folder, venv)
    for cell in cells(policy):
        if cell.row in done or not wanted(cell.row, asked.rows):
            continue
        start = time.monotonic()
        verdict = tried(cell, folder, venv)
        print(f"{policy.name}: {cell.row}: {verdict.kind} ({time.monotonic() - start:.0f} s) {verdict.why}", flush=True)
        done[cell.row] = verdict
        results(folder, policy).write_text(json.dumps({row: asdict(found) for row, found in done.items()}, indent=1))


def environment(asked: argparse.Namespace, packages: str) -> Path:
    """The virtual environment of a policy."""
    venv: Path | None = getattr(asked, packages)
    if venv is None:
        raise SystemExit(f"--{packages} is missing: the environment that `make foreign` makes")
    return venv.absolute()


def results(folder: Path, policy: Foreign) -> Path:
    """Where the verdicts of a policy are kept."""
    return folder / f"{policy.name}.json"


def kept(folder: Path, policy: Foreign) -> dict[str, Verdict]:
    """What was found before, by row."""
    file = results(folder, policy)
    return {row: Verdict(**said) for row, said in json.loads(file.read_text()).items()} if file.exists() else {}


def verdicts(policy: Foreign, folder: Path) -> dict[tuple[str, str], Verdict]:
    """(Policy, row) -> what was found, for every cell of a policy."""
    done = kept(folder, policy)
    return {(policy.name, cell.row): done.get(cell.row, Verdict(MISSING)) for cell in cells(policy)}


def make(policy: Foreign, folder: Path, venv: Path) -> None:
    """Copy the policy's files, and let its scripts make checkpoint and recordings where they are not there yet."""
    place, gate = folder / policy.name, folder / "out" / policy.name / "gate.yaml"
    place.mkdir(parents=True, exist_ok=True)
    for file in policy.files.values():
        shutil.copy(file, place)
    gate.parent.mkdir(parents=True, exist_ok=True)
    gate.write_text(gate_file(policy))
    if not (place / "evaluation.npz").exists():
        for script in policy.scripts:
            subprocess.run([venv / "bin/python", script], cwd=place, env=variables(folder, venv), check=True)


def variables(folder: Path, venv: Path) -> dict[str, str]:
    """The environment of every command: its own packages first, a cache of its own, no model hub."""
    path = f"{venv / 'bin'}{os.pathsep}{os.environ.get('PATH', '')}"
    return {**os.environ, "PATH": path, "VLATOOL_CACHE": str(folder / "cache"), "HF_HUB_OFFLINE": "1"}


def tried(cell: Cell, folder: Path, venv: Path) -> Verdict:
    """Run a cell's command and say what its end means; what needs a bundle that was refused before is not run."""
    if cell.program == ANSWERS and not (folder / cell.words[0]).is_dir():
        return Verdict(MISSING)
    programs = {VLATOOL: [str(venv / "bin/vlatool")], ANSWERS: [str(venv / "bin/python"), str(HERE / "_answers.py")]}
    force = ["--force"] if cell.program == VLATOOL and "-o" in cell.words and "--force" not in cell.words else []
    command = [*programs[cell.program], *cell.words, *force]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=variables(folder, venv),
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Verdict(FAULT, f"took longer than {LIMIT_S:g} s")
    return judge(cell, done.returncode, done.stdout, done.stderr)


def followed(asked: argparse.Namespace, folder: Path) -> bool:
    """Follow every guide; return whether all of them ran."""
    return False not in [guide(name, asked, folder) for name in GUIDES if wanted(name, asked.guides or ["*"])]


def guide(name: str, asked: argparse.Namespace, folder: Path) -> bool:
    """Follow a guide in a new folder where its policy's original lies; return whether every command ran."""
    made = GUIDES[name]
    venv = environment(asked, made.packages)
    place = folder / "guides" / name
    shutil.rmtree(place, ignore_errors=True)
    given = place / made.folder
    given.mkdir(parents=True)
    for file in made.given:
        shutil.copy(BY_NAME[made.policy].files[file], given)
    subprocess.run([venv / "bin/python", made.given[0]], cwd=given, env=variables(folder, venv), check=True)
    start = time.monotonic()
    try:
        count = follow(made.page, place, variables(folder, venv), sys.stdout)
    except GuideError as error:
        print(f"{name}: {error}")
        return False
    print(f"{name}: {count} commands ran as written, in {time.monotonic() - start:.0f} s")
    return True


if __name__ == "__main__":
    sys.exit(main())
