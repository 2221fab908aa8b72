"""Kill vlatool at random moments, again and again, and see that nothing is ever left half-written.

``python tests/validation/soak/kill9.py --kills 200 --command all`` runs a command once to the end (the reference), then
starts it again and again from nothing, kills it (every other time alone, else with its whole process group) at a moment
drawn uniformly over the duration of the reference, and checks that

- all processes that it started end, too;
- the final path is absent, or a bundle whose every file is verified and equal to the reference's; a report, and a video
  beside it, are whole in the same way;
- the same command then runs to its end, on the cache that the killed one left;
- its bundle is the reference's byte for byte (``reports/`` apart, which hold times, and ``trials``, which are chosen by
  their speed), and so are the rows of a report, and the video;
- no draft is left, neither beside the output nor in the cache, and no temporary files of vlatool's.

Prints a table of counts; the exit status is 1 when anything was violated.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from vlatool.bundle.bundle import Bundle
from vlatool.errors import BundleError, DataError
from vlatool.files.ownership import LEDGER
from vlatool.report import REPORT, read_report

COMMANDS = ("export", "quantize", "optimize", "structured", "magnitude", "video", "trials")
RECIPE = """\
schema: 1
candidates:
  dynamic_int8:
    - quantize.dynamic_int8: {}
"""
TRIALS = """\
schema: 1
candidates: {static_int8: [quantize.static_int8: {samples: 8}]}
pruning:
  trials: 2
  episodes: 4
  recover: [distill.policy: {steps: 12, every: 4, batch: 6, episodes: 2, student_episodes: 2}]
effort: {episodes: 16, iterations: 20}
limits: {max_drop: 1.0, max_distance: 1000, hz: 1000000}
"""
FILM = "film.gif"
OPTIMIZE = ["--profile", "raspberry-pi-5", "--episodes", "4", "--iterations", "20", "--workers", "2"]
UNREACHABLE = ["--max-drop", "100%", "--hz", "1000000"]
"""With a rate that nothing reaches, the nearest candidate is kept whatever the latencies were; the exit status is 1."""


@dataclass
class Work:
    """One command in one folder: ``cache`` and what is in ``place`` are its only outputs, ``place/out`` the first."""

    arguments: list[str]
    folder: Path
    expected: int = 0
    timed: bool = False
    """Which of several candidates it writes depends on how fast they were, so that it is whole, and no more."""
    counts: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.place, self.cache, self.scratch = (self.folder / name for name in ("place", "cache", "tmp"))
        self.out, self.reference = self.place / "out", self.folder / "reference"

    def start(self) -> subprocess.Popen[str]:
        """Start the command in a process group of its own."""
        for folder in (self.place, self.scratch):
            folder.mkdir(parents=True, exist_ok=True)
        places = {"VLATOOL_CACHE": str(self.cache), "TMPDIR": str(self.scratch)}
        command = [sys.executable, "-m", "vlatool", *self.arguments, "-o", str(self.out)]
        with (self.folder / "stderr").open("w") as errors:
            return subprocess.Popen(
                command, env={**os.environ, **places, "OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL, stderr=errors,
                text=True, start_new_session=True,
            )  # fmt: skip

    def run(self) -> str:
        """Run to the end; return what was wrong with it, nothing when all is well."""
        status = self.start().wait()
        return "" if status == self.expected else f"exit {status}: {(self.folder / 'stderr').read_text()[-400:]}"

    def clear(self) -> None:
        """Remove output, cache and temporary files."""
        for folder in (self.place, self.cache, self.scratch):
            shutil.rmtree(folder, ignore_errors=True)

    def make_reference(self) -> float:
        """Run once to the end, keep what it wrote, and return the seconds it took."""
        self.clear()
        start = time.perf_counter()
        if wrong := self.run():
            raise SystemExit(f"the reference run of {self.arguments[0]} failed, {wrong}")
        seconds = time.perf_counter() - start
        shutil.copytree(self.out, self.reference)
        return seconds

    def kill(self, moment: float) -> list[str]:
        """Start, kill after ``moment`` seconds, every other time without its children; return what is violated."""
        process, group = self.start(), self.counts["killed"] % 2 == 0
        try:
            process.wait(timeout=moment)
            self.counts["ended before the kill"] += 1
        except subprocess.TimeoutExpired:
            (os.killpg if group else os.kill)(process.pid, signal.SIGKILL)
            process.wait()
            self.counts["killed"] += 1
        return self.wait_for_children() + self.look()

    def kill_once(self, moment: float) -> list[str]:
        """Start from nothing, kill after ``moment`` seconds, look, run again, look; return what was violated."""
        self.clear()
        violations = self.kill(moment)
        wrong = self.run() if not self.out.exists() else ""
        return violations + ([f"the run after the kill: {wrong}"] if wrong else self.look_at_the_end())

    def wait_for_children(self, most_s: float = 20.0) -> list[str]:
        """Wait until no process is left that has this cache: children die with their parents, not at once."""
        end_at = time.monotonic() + most_s
        while left := [entry.name for entry in Path("/proc").glob("[0-9]*") if _has_cache(entry, self.cache)]:
            if time.monotonic() > end_at:
                return [f"processes that the killed one left: {', '.join(left)}"]
            time.sleep(0.05)
        return []

    def look(self) -> list[str]:
        """After a kill: nothing, or the whole output."""
        if self.cache.is_dir() and any(self.cache.glob("stages/[!.]*")):
            self.counts["with finished stages in the cache"] += 1
        if drafts(self.folder):
            self.counts["with a draft left by the killed"] += 1
        if not self.out.exists():
            self.counts["output absent"] += 1
            return []
        self.counts["output whole"] += 1
        return self.half() or self.other()

    def other(self) -> list[str]:
        """Return in what an output is not the reference."""
        return self.half() if self.timed else differences(self.reference, self.out)

    def half(self) -> list[str]:
        """Return what is wrong with an output that is there."""
        try:
            Bundle.open(self.out)
        except BundleError as error:
            return [f"half a bundle after the kill: {error}"]
        return []

    def look_at_the_end(self) -> list[str]:
        """After the second run: what the reference wrote, and nothing left over anywhere."""
        left = [*drafts(self.folder), *self.scratch.glob("vlatool-*")]
        return self.other() + [f"left over: {path}" for path in left]


class Film(Work):
    """An evaluation that writes a report, and a video beside it."""

    @property
    def film(self) -> Path:
        """The video."""
        return self.place / FILM

    def make_reference(self) -> float:
        """Run once to the end and keep report and video."""
        seconds = super().make_reference()
        shutil.copyfile(self.film, self.reference / FILM)
        return seconds

    def kill_once(self, moment: float) -> list[str]:
        """As of any work; a video that is there already is replaced."""
        self.clear()
        violations = self.kill(moment)
        if self.film.exists() and not self.out.exists():
            self.film.unlink()
        wrong = self.run() if not self.out.exists() else ""
        return violations + ([f"the run after the kill: {wrong}"] if wrong else self.look_at_the_end())

    def look(self) -> list[str]:
        """After a kill: nothing, or the whole report and the whole video."""
        return super().look() + (self._other_film() if self.film.exists() else [])

    def half(self) -> list[str]:
        """Return what is wrong with a report that is there."""
        try:
            read_report(self.out)
        except DataError as error:
            return [f"half a report after the kill: {error}"]
        return []

    def look_at_the_end(self) -> list[str]:
        """After the second run: the reference's rows and video, and nothing left over."""
        return super().look_at_the_end() + self._other_film()

    def _other_film(self) -> list[str]:
        same = self.film.is_file() and self.film.read_bytes() == (self.reference / FILM).read_bytes()
        return [] if same else ["the video is not the reference's"]


def _has_cache(entry: Path, folder: Path) -> bool:
    try:
        return f"VLATOOL_CACHE={folder}".encode() in (entry / "environ").read_bytes().split(b"\0")
    except OSError:
        return False


def drafts(folder: Path) -> list[Path]:
    """Unfinished or outdated files and directories anywhere below a folder."""
    return sorted(path for pattern in (".*.tmp-*", ".*.old-*", ".*.part") for path in folder.rglob(pattern))


def differences(reference: Path, other: Path) -> list[str]:
    """Files that only one of two outputs has, or that differ, ``reports/`` apart; of a report its rows."""
    wanted, found = contents(reference), contents(other)
    return [
        f"differs from the reference: {name}" for name in sorted(wanted | found) if wanted.get(name) != found.get(name)
    ]


def contents(bundle: Path) -> dict[str, bytes]:
    """Relative path -> bytes of every file but the reports and the list of their hashes; of a report its rows."""
    if (report := bundle / REPORT).is_file():
        return {"rows": json.dumps(json.loads(report.read_text())["rows"]).encode()}
    files = {path.relative_to(bundle).as_posix(): path for path in bundle.rglob("*") if path.is_file()}
    kept = {name: path for name, path in files.items() if not name.startswith("reports/") and name != LEDGER}
    return {name: path.read_bytes() for name, path in kept.items()}


def make_policy(folder: Path) -> Path:
    """Write the tiny policy of the tests."""
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from _tiny import write_policy

    return write_policy(folder)


def works(folder: Path, names: list[str]) -> dict[str, Work]:
    """Prepare the commands; what comes before the one that is killed is made here, once."""
    policy = make_policy(folder / "tiny")
    export = Work(["export", str(policy)], folder / "export")
    recipe = folder / "recipe.yaml"
    recipe.write_text(RECIPE)
    found = {"export": export, "trials": trials_of(policy, folder / "trials")}
    for method in ("structured", "magnitude"):
        found[method] = Work(["prune", method, str(policy)], folder / method)
    if {*names} - {"export"}:
        bundle = Work(["export", str(policy)], folder / "float")
        bundle.make_reference()
        model = shutil.copyfile(bundle.reference / "graphs/main.onnx", policy / "tiny.onnx")
        found["quantize"] = Work(["quantize", str(bundle.reference)], folder / "quantize")
        found["video"] = film_of(bundle.reference, policy, folder / "video")
        options = ["--recipe", str(recipe), *OPTIMIZE, *UNREACHABLE]
        found["optimize"] = Work(["optimize", str(model), *options], folder / "optimize", expected=1)
    return {name: found[name] for name in names}


def film_of(bundle: Path, policy: Path, folder: Path) -> Film:
    """Prepare an evaluation with a video."""
    words = ["evaluate", "closed-loop", str(bundle), "--policy", str(policy), "--episodes", "20", "--workers", "1"]
    return Film([*words, "--video", str(folder / "place" / FILM)], folder)


def trials_of(policy: Path, folder: Path) -> Work:
    """Prepare trials of pruned policies that are kept in the journal of a study."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "recipe.yaml").write_text(TRIALS)
    study = ["--study", str(folder / "place" / "trials.journal")]
    words = ["optimize", str(policy), "--recipe", str(folder / "recipe.yaml"), *study, "--workers", "1"]
    return Work([*words, "--profile", "raspberry-pi-5"], folder, expected=1, timed=True)


def soak(work: Work, kills: int, seed: int, tell: Callable[[str], None] = print) -> list[str]:
    """Make the reference, kill ``kills`` times and return every violation."""
    seconds = work.make_reference()
    tell(f"{work.arguments[0]}: one run takes {seconds:.1f} s")
    moments = random.Random(seed)
    violations = []
    for number in range(kills):
        moment = moments.uniform(0, seconds)
        for violation in work.kill_once(moment):
            violations.append(violation)
            tell(f"VIOLATED {work.arguments[0]}, kill {number} at {moment:.3f} s: {violation}")
    work.counts["violations"] += len(violations)
    return violations


def main() -> int:
    """Soak and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200, help="kills in all, shared out to the commands")
    parser.add_argument("--command", choices=(*COMMANDS, "all"), default="all")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    names = list(COMMANDS) if given.command == "all" else [given.command]
    bad = 0
    with tempfile.TemporaryDirectory(prefix="vlatool-kill9-") as scratch:
        prepared = works(Path(scratch), names)
        for index, (name, work) in enumerate(prepared.items()):
            share = given.kills // len(names) + (index < given.kills % len(names))
            start = time.perf_counter()
            bad += len(soak(work, share, given.seed))
            print(f"{name}: {share} kills in {time.perf_counter() - start:.0f} s", flush=True)
        kinds = list(dict.fromkeys(kind for work in prepared.values() for kind in work.counts))
        print(f"{'':36}" + "".join(f"{name:>10}" for name in prepared))
        for kind in kinds:
            print(f"{kind:36}" + "".join(f"{work.counts[kind]:>10}" for work in prepared.values()))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
