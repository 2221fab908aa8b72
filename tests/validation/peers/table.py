"""The peer table: the tools that others use, and ourselves, in one interleaved run on one core.

    python tests/validation/peers/table.py --workloads vit-s resnet18
    python tests/validation/peers/table.py --workloads vit-s --ours vit-s=out/my-bundle --skip 'torch*'
    python tests/validation/peers/table.py --report            # print again what was measured last

Models are made once and kept below --work; docs/measurements/peers.md says what is compared and how.
Exits 1 when a check fails.
"""

from __future__ import annotations

import argparse
import fnmatch
import importlib.metadata
import os
import platform
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

from _copies import without_copies  # noqa: E402
from _interleave import CLOCKS, Contest, Contestant, build  # noqa: E402
from _limits import LIMITS, macs_of  # noqa: E402
from _ours import COMMANDS, HALF, MARK, bundle_of  # noqa: E402
from _peers import PEERS, REFERENCE  # noqa: E402
from _report import Table, markdown, read, save  # noqa: E402
from _workload import WORKLOADS, PeersError, Workload, remove  # noqa: E402

from vlatool.machine.host import isa  # noqa: E402
from vlatool.machine.instruction_sets import rung  # noqa: E402

PACKAGES = ("torch", "torchao", "onnx", "onnxruntime", "openvino", "nncf", "numpy")
UNITS = ("avx2", "avx_vnni", "avx512f", "avx512_vnni", "avx512_bf16", "amx_int8", "amx_bf16")


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    cache = Path(os.environ.get("VLATOOL_CACHE") or Path.home() / ".cache" / "vlatool") / "peers"
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workloads", nargs="+", default=list(WORKLOADS), choices=WORKLOADS, metavar="NAME")
    parser.add_argument(
        "--ours", nargs="+", action="extend", default=[], metavar="NAME=BUNDLE", help="further bundles of a workload"
    )
    parser.add_argument("--rounds", type=int, default=15, help="turns of each contestant (15)")
    parser.add_argument("--block", type=int, default=3, help="timed inferences in one turn (3)")
    parser.add_argument("--only", nargs="+", default=["*"], metavar="GLOB", help="contestants by name")
    parser.add_argument("--skip", nargs="+", default=[], metavar="GLOB", help="contestants to leave out")
    parser.add_argument("--remake", nargs="+", default=[], metavar="GLOB", help="make the models of these again")
    parser.add_argument("--core", type=int, default=max(os.sched_getaffinity(0)), help="the core that all share")
    parser.add_argument("--memory-gb", type=float, default=10.0, help="resident memory of all workers at once (10)")
    parser.add_argument("--clock", choices=CLOCKS, default="cpu", help="what the checks compare (cpu)")
    parser.add_argument("--work", type=Path, default=cache, help=f"where models and results are kept ({cache})")
    parser.add_argument("--build", action="store_true", help="make the models and stop")
    parser.add_argument("--report", action="store_true", help="measure nothing: print the last results")
    parser.add_argument("-o", "--output", type=Path, help="write the tables to this Markdown file, too")
    return parser.parse_args(arguments)


def main() -> int:
    """Run the workloads one after the other."""
    given = parse()
    sections, passed = [], True
    for name in given.workloads:
        workload = Workload(name, given.work.resolve() / name)
        try:
            if not given.report:
                contestants = built(workload, given)
                if given.build:
                    continue
                measure(workload, contestants, given)
            rows, about = read(result_file(workload))
        except (PeersError, FileNotFoundError) as error:
            print(f"{name}: {error}", file=sys.stderr)
            passed = False
            continue
        table = Table(name, rows, given.clock, about.get("macs", 0.0), about.get("set", ""))
        section = f"{markdown(table)}\n{told(about)} {share(rows)}\n"
        passed = passed and all(check.passed for check in table.checks())
        print(section, flush=True)
        sections.append(section)
        if given.output:
            given.output.write_text("\n".join(sections), encoding="utf-8")
    return 0 if passed and (sections or given.build) else 1


def result_file(workload: Workload) -> Path:
    """Return where the figures of a workload are."""
    return workload.folder / "result.json"


def built(workload: Workload, given: argparse.Namespace) -> list[Contestant]:
    """Make what is missing; return all contestants."""
    tell(f"{workload.name}: preparing")
    workload.prepare()
    contestants = chosen(workload, given)
    for contestant in contestants:
        if any(fnmatch.fnmatch(contestant.name, glob) for glob in given.remake):
            forget(workload, contestant)
    for contestant in contestants:
        start = time.perf_counter()
        build(workload, contestant)
        if contestant.failed:
            tell(f"  {contestant.name}: {contestant.failed}")
        elif time.perf_counter() - start > 1:
            tell(f"  {contestant.name}: made in {time.perf_counter() - start:.0f} s")
    return without_copies(workload, contestants, tell)


def measure(workload: Workload, contestants: list[Contestant], given: argparse.Namespace) -> None:
    """Time all contestants and keep the figures."""
    start = time.perf_counter()
    Contest(workload, given.core, given.rounds, given.block, given.memory_gb * 1e3, tell).run(contestants)
    about = {
        "workload": workload.name,
        "macs": macs_of(workload.bundle),
        "set": rung(isa() or ()),
        "processor": processor(),
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        "rounds": given.rounds,
        "block": given.block,
        "core": given.core,
        "seconds": round(time.perf_counter() - start),
        "load_average": [round(value, 1) for value in os.getloadavg()],
        "date": time.strftime("%Y-%m-%d %H:%M"),
    }
    save(result_file(workload), contestants, about)


def chosen(workload: Workload, given: argparse.Namespace) -> list[Contestant]:
    """Return the contestants, the reference first; those in one group with the fastest are at the front."""
    names = [REFERENCE, *(f"{MARK}{name}" for name in COMMANDS), *(name for name in PEERS if name != REFERENCE)]
    found = [Contestant(name, name) for name in (*LIMITS, *names)]
    for text in given.ours:
        name, _, path = text.partition("=")
        if name not in WORKLOADS or not Path(path, "manifest.json").is_file():
            raise PeersError(f"--ours {text}: wanted WORKLOAD=BUNDLE with a bundle's directory")
        if name == workload.name:
            folder = Path(path).resolve()
            found.insert(1, Contestant(f"{MARK}{folder.name} (given)", f"{MARK}{folder}"))

    def wanted(name: str) -> bool:
        return any(fnmatch.fnmatch(name, glob) for glob in given.only) and not any(
            fnmatch.fnmatch(name, glob) for glob in given.skip
        )

    fits = [each for each in found if HALF == "bf16" or not needs_bfloat16(each.name)]
    lacks = [each.name for each in found if each not in fits]
    if lacks:
        tell(f"  left out, since this processor does not compute in bfloat16: {', '.join(lacks)}")
    always = (REFERENCE, *LIMITS)
    return [each for each in fits if each.name in always or wanted(each.name)]


def needs_bfloat16(name: str) -> bool:
    """Say whether a contestant computes in bfloat16."""
    return any(word in name for word in ("bf16", "bfloat16"))


def forget(workload: Workload, contestant: Contestant) -> None:
    """Remove the model that was made before."""
    own = contestant.name.removeprefix(MARK)
    if contestant.ours and COMMANDS.get(own):
        remove(bundle_of(workload, own))
    elif not contestant.ours and contestant.name not in LIMITS and PEERS[contestant.name].make is not None:
        remove(PEERS[contestant.name].model(workload).parent)


def processor() -> str:
    """Return the processor's name and what of it matters for int8 and bfloat16."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    facts = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    flags = facts.get("flags", "").split()
    units = [flag for flag in UNITS if flag in flags]
    return f"{facts.get('model name', platform.machine())} ({', '.join(units)}), {os.cpu_count()} cores"


def told(about: dict[str, Any]) -> str:
    """Return one line on the run."""
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    return (
        f"{about['date']}, {about['processor']}, core {about['core']}, load average {about['load_average'][0]}, "
        f"{about['rounds']} rounds of {about['block']} inferences; Python {about['python']}, {versions}."
    )


def share(rows: Sequence[Contestant]) -> str:
    """Say how much of the core was ours: the less, the more the neighbours' use of the caches is in the figures."""
    reference = next(row for row in rows if row.name == REFERENCE)
    found = sum(reference.rounds["cpu"]) / sum(reference.rounds["wall"])
    low, high = min(reference.rounds["cpu"]), max(reference.rounds["cpu"])
    text = f"Neighbours left {found:.0%} of the core to the run; {REFERENCE} took {low:.0f}-{high:.0f} ms in a round."
    for row in rows:
        if row.name == f"{MARK}float32" and row.rounds["cpu"]:
            ratios = [own / base for own, base in zip(row.rounds["cpu"], row.reference["cpu"], strict=True)]
            text += (
                f" Control: {row.name}, the same graph in another process, took {median(ratios):.3f} of {REFERENCE}."
            )
    return text


def tell(line: str) -> None:
    """Show progress."""
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
