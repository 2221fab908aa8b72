"""Engines of another package on execution providers other than the processor's, which compute real answers.

The packages of these providers come from an index, and one of them takes the place of onnxruntime: ``make`` installs
neither. They are installed into an environment of their own from the folder that ``VLATOOL_PROVIDERS`` names:

    pip download --no-deps -d providers onnxruntime-openvino onnxruntime-ggml
    VLATOOL_PROVIDERS=providers pytest tests/plugins/test_providers.py

``test_plugins`` always runs an engine on a provider that every wheel of ONNX Runtime has (Azure's) and that leaves all
nodes to the processor: it proves that the providers of a class and their options reach the session and are checked, and
nothing about computing elsewhere.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import onnx
import onnx.parser
import pytest
from _console import Console
from _environment import environment_beside
from test_plugins import ok, wheel

from vlatool.bundle.bundle import Bundle

FOLDER = Path(os.environ.get("VLATOOL_PROVIDERS", "providers")).resolve()
LAYERS = """<ir_version: 10, opset_import: ["" : 20]> g (float[1,2] x) => (float[1,2] y)
<float[2,2] w = {1, 2, 3, -4}> { h = MatMul(x, w) y = Relu(h) }"""


@contextmanager
def console_with(package: str, place: Path) -> Iterator[Callable[..., subprocess.CompletedProcess[str]]]:
    """Run vlatool in a fresh environment with Acme's package and the one that brings a provider."""
    found = sorted(FOLDER.glob(f"{package}-*.whl"))
    if not found:
        pytest.skip(f"VLATOOL_PROVIDERS names no folder with a wheel of {package}")
    python = environment_beside(place / "venv")
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-index", "--no-deps"]
    subprocess.run([*install, "--ignore-installed", str(wheel(place)), str(found[-1])], check=True)
    environment = {**os.environ, "VLATOOL_CACHE": str(place / "cache"), "COLUMNS": "200", "ORT_GGML_LOG": "error"}
    with Console(place, python, environment) as console:
        yield console.run


def test_a_policy_runs_on_another_provider_of_the_library_and_gives_its_golden_action(
    tmp_path: Path, float_bundle: Bundle
):
    with console_with("onnxruntime_openvino", tmp_path) as run:
        few = ["--iterations", "20", "--duration", "0"]
        line = ["benchmark", str(float_bundle.path), "--engine", "openvino-provider", *few, "--json"]
        (row,) = json.loads(ok(run(*line)))["rows"]
        assert row["details"]["engine"][0]["providers"].startswith('OpenVINOExecutionProvider {"device_type": "CPU"}; ')
        code = (
            f"import vlatool; policy = vlatool.load({str(float_bundle.path)!r}, engine='openvino-provider'); "
            "print(*(session._session.get_providers()[0] for session in policy.program.sessions.values())); "
            "print(policy.golden_error)"
        )
        provider, error = ok(run(code=code)).splitlines()
        assert provider == "OpenVINOExecutionProvider"
        assert 0 <= float(error) < 0.001


def test_a_provider_that_is_a_plug_in_computes_and_refuses_a_graph_that_it_does_not_run_whole(
    tmp_path: Path, float_bundle: Bundle
):
    onnx.save(onnx.parser.parse_model(LAYERS), str(tmp_path / "layers.onnx"))
    with console_with("onnxruntime_ggml", tmp_path) as run:
        code = (
            "from pathlib import Path; import numpy; from vlatool.runtime.engine import engine_class; "
            f"session = engine_class('ggml-provider')(Path({str(tmp_path / 'layers.onnx')!r}), 1); "
            "print(*session._session.get_providers()); "
            "print(session.run({'x': numpy.array([[1, 2]], numpy.float32)})['y'].tolist())"
        )
        assert ok(run(code=code)).splitlines()[-2:] == ["ggml CPUExecutionProvider", "[[7.0, 0.0]]"]
        refused = run("benchmark", str(float_bundle.path), "--engine", "ggml-provider", "--iterations", "20")
        assert refused.returncode == 3
        assert "ggml does not run every node of it: use another engine" in refused.stderr
