"""The candidate takes no more space on disk than the baseline and a margin."""

from __future__ import annotations

from vlatool.bundle.bundle import DIGEST, LOCATION, MANIFEST, Bundle
from vlatool.data import OBSERVATIONS_FILE, is_of_recording
from vlatool.files.ownership import LEDGER
from vlatool.gate.claims._growth import Growth
from vlatool.gate.evidence import Evidence
from vlatool.gate.verdict import Verdict
from vlatool.measures.resources import SIZE

ABOUT = (MANIFEST, DIGEST, LEDGER, LOCATION, OBSERVATIONS_FILE, "recipe.yaml", "SIGNATURE",
         "reports/report.html", "reports/report.md", "reports/report.json", "reports/difference.json",
         "reports/smooth_quant.json", "reports/weights.json")  # fmt: skip
"""Files of a bundle that no robot needs, beside the golden one and recordings."""


class Size(Growth):
    """The graphs and assets of the candidate are not larger than the baseline's by more than a margin."""

    order = 50
    example = "\nsize:\n  margin: 0.10         # graphs and assets on disk\n"

    def examine(self, evidence: Evidence) -> Verdict:
        """Examine the bytes of the graphs and assets."""
        mine, theirs = (deployed_bytes(bundle) / 1e6 for bundle in (evidence.candidate, evidence.baseline))
        return self.judge(SIZE.measurement(mine, note="graphs and assets on disk"), theirs)


def deployed_bytes(bundle: Bundle) -> int:
    """Return the bytes of everything in a bundle that a robot may need, whether the manifest names it or not.

    Weights may lie in any file, so every file counts but those that are known for what else they are; and a recorded
    file that is a graph, or lies in the folder of one, counts whatever it is called: its weights may be there.
    """
    folders = tuple(graph.file.rpartition("/")[0] for graph in bundle.manifest.graphs.values())
    within = tuple(f"{folder}/" if folder else "" for folder in folders)
    opened = {name for name in bundle.manifest.files if name.startswith(within)}
    spared = {*ABOUT, bundle.manifest.golden, *filter(is_of_recording, bundle.manifest.files)} - opened
    files = (path for path in bundle.path.rglob("*") if path.is_file())
    return sum(path.stat().st_size for path in files if path.relative_to(bundle.path).as_posix() not in spared)
