"""What the robot imports, and what the command line does not: each in a fresh process."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np

CONTROLLER = Path(__file__).parents[1] / "robot/controller.py"
BUILD_PACKAGES = tuple(sorted(runpy.run_path(str(CONTROLLER))["BLOCKED"]))
"""What a robot does not have."""
ROBOT = f"""
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {BUILD_PACKAGES!r}:
            raise ModuleNotFoundError(f"{{name}} is blocked", name=name)

sys.meta_path.insert(0, Blocked())
import json
import numpy as np
import vlatool.runtime

policy = vlatool.runtime.load(sys.argv[1], threads=1)
data = np.load(sys.argv[1] + "/data/evaluation.npz")
action = policy.infer({{name: data[name][0] for name in ("image", "proprio", "instruction")}})
print(json.dumps({{"chunk": action.chunk.tolist(), "loaded": sorted(set({BUILD_PACKAGES!r}) & set(sys.modules))}}))
"""


def python(code: str, *arguments: str) -> str:
    command = [sys.executable, "-W", "error", "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded_after(statement: str, *modules: str) -> list[str]:
    """Which of the modules are loaded after the statement in a fresh process."""
    return json.loads(
        python(f"import json, sys\n{statement}\nprint(json.dumps(sorted(set({modules!r}) & set(sys.modules))))")
    )


def test_a_robot_without_any_build_package_loads_a_bundle_and_infers(int8_bundle):
    from vlatool.runtime import load

    told = json.loads(python(ROBOT, str(int8_bundle.path)))
    assert told["loaded"] == []
    with np.load(int8_bundle.path / "data/evaluation.npz") as data:
        here = load(int8_bundle.path, threads=1).infer(
            {name: data[name][0] for name in ("image", "proprio", "instruction")}
        )
    np.testing.assert_allclose(told["chunk"], here.chunk, rtol=1e-5, atol=1e-6)


def test_import_vlatool_is_light():
    assert loaded_after("import vlatool", "numpy", "torch", "onnxruntime", "pydantic", "vlatool.runtime") == []


def test_load_is_there_when_it_is_asked_for():
    import vlatool
    import vlatool.runtime

    assert vlatool.load is vlatool.runtime.load
    assert loaded_after("import vlatool; vlatool.load", "vlatool.runtime", "torch") == ["vlatool.runtime"]


def test_vlatool_has_no_other_lazy_names():
    import pytest

    import vlatool

    with pytest.raises(AttributeError, match="no attribute 'lod'"):
        vlatool.lod  # noqa: B018


def test_the_runtime_opens_no_engine_before_it_is_asked_to():
    assert loaded_after("import vlatool.runtime", "onnxruntime", *BUILD_PACKAGES) == []


def test_the_command_line_does_not_import_torch_or_an_engine():
    assert loaded_after("import vlatool.cli", "torch", "onnx", "onnxruntime") == []


def test_what_measures_on_a_target_imports_numpy_alone():
    statement = "import vlatool.measurement.agent, vlatool.measurement.worker, vlatool.measurement.pairs"
    assert loaded_after(statement, "onnxruntime", *BUILD_PACKAGES) == []


def test_stages_are_imported_without_torch_onnx_and_engines():
    statement = "from vlatool.stage import build as stage\n" + "\n".join(
        f"stage.stage_class('{name}')"
        for name in ("sources.torch_module", "sources.onnx", "export.onnx", "quantize.static_int8")
    )
    assert loaded_after(statement, "torch", "onnx", "onnxruntime") == []


def test_help_runs():
    done = subprocess.run([sys.executable, "-m", "vlatool", "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "quantize" in done.stdout
