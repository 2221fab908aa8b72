"""int8 through OpenVINO under each instruction set that this host can be confined to, in a child each.

What is claimed of processors with VNNI, and of those without, so holds of both wherever the tests run.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from vlatool.bundle.bundle import Bundle
from vlatool.machine.host import MAX_CPU_ISA
from vlatool.machine.instruction_sets import RUNGS, SATURATING
from vlatool.machine.processes import python_code
from vlatool.quantize.static_int8 import StaticInt8
from vlatool.stage.base import Context
from vlatool.stage.run import run_transform

ASK = """\
import json, sys
from vlatool.errors import GraphError
from vlatool.runtime import load
from vlatool.runtime.engines.openvino import OpenvinoSession
told = {"arithmetic": OpenvinoSession.arithmetic()}
for path in sys.argv[1:]:
    try:
        load(path, threads=1, golden_tolerance=0.05, accept=["engine-difference"])
        told[path] = "loads"
    except GraphError as error:
        told[path] = error.message
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def ranges(float_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The policy in int8 with weights of the full range, and of the reduced one."""
    folder = tmp_path_factory.mktemp("ranges")
    for name, reduced in (("full", False), ("reduced", True)):
        stage = StaticInt8(samples=8, layout="openvino", reduce_range=reduced)
        run_transform(stage, float_bundle, folder / name, Context())
    return {name: folder / name for name in ("full", "reduced")}


@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=pytest.mark.needs(each, reason="a child is confined to it")) for each in RUNGS]
)
def test_int8_is_what_the_graph_says_or_is_refused(ranges: dict[str, Path], name: str) -> None:
    command = [*python_code(ASK), *map(str, ranges.values())]
    environment = {**os.environ, MAX_CPU_ISA: name}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    told = json.loads(done.stdout.splitlines()[-1])
    assert told[str(ranges["reduced"])] == "loads"
    if name in SATURATING:
        assert told["arithmetic"].startswith("saturating")
        assert "a different golden action than recorded" in told[str(ranges["full"])]
        assert "Its int8 products are saturating" in told[str(ranges["full"])]
    else:
        assert told["arithmetic"] == "exact"
        assert told[str(ranges["full"])] == "loads"
