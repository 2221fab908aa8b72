"""What every test may use: a complete tiny policy and the bundles that are made from it.

The bundles are made once in a session and must not be changed; copy one (``copied``) to damage it.
"""

from __future__ import annotations

import csv
import gc
import importlib
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _arithmetic import lacks
from _full import VARIABLE, full, small_or_full
from _shared import VARIABLE as SHARED
from _shared import found, once
from _tiny import observations, write_policy

from vlatool.benchmark import latency
from vlatool.bundle.bundle import Bundle, seal
from vlatool.runtime.engines._reference import ReferenceSession
from vlatool.runtime.engines.ort_cpu import OrtCpuSession
from vlatool.stage.base import Context, Transform
from vlatool.stage.run import run_transform
from vlatool.user_code import children, trust

os.environ.setdefault("OMP_NUM_THREADS", "1")
"""Of torch, here and in all children: two threads that meet at barriers on busy cores are ten times slower than one."""

COLUMNS = (
    "device", "power_mode", "runtime", "model", "params_m", "gflops_or_gmacs", "input", "precision", "batch", "metric",
    "value", "macts_m", "n_layers", "device_class",
)  # fmt: skip
PUBLISHED = {
    "resnet18": (1.8, 11.7, 2.5, 21),
    "resnet50": (4.1, 25.6, 11.1, 54),
    "mobilenet_v2": (0.3, 3.5, 6.7, 53),
    "vit_small": (4.6, 22.0, 11.9, 74),
    "densenet121": (2.9, 8.0, 6.9, 121),
    "yolov8n": (4.4, 3.2, 12.0, 64),
}
"""Model -> 10^9 multiply-accumulates, 10^6 weights, 10^6 activations, layers."""
MEASURED_ON = (
    ("raspberry-pi-4", "cpu", "ncnn", "fp32", 0.02), ("raspberry-pi-5", "cpu", "onnxruntime", "fp32", 0.06),
    ("rk3588", "cpu", "ncnn", "fp32", 0.07), ("i7-1360P", "cpu", "openvino", "int8", 1.5),
    ("jetson-orin-nano-8gb", "gpu", "tensorrt", "fp16", 3.6), ("jetson-agx-orin-64gb", "gpu", "tensorrt", "fp16", 15.0),
    ("rtx-4060", "gpu", "tensorrt", "fp16", 21.0), ("hailo-8", "npu", "hailort", "int8", 7.0),
    ("hailo-8l", "npu", "hailort", "int8", 3.5), ("core-ultra-7-155H", "npu", "openvino-npu", "int8", 3.0),
)  # fmt: skip
"""Device, class, runtime, precision, and 10^12 operations that it does in a second."""
LONG = frozenset({
    "test_broken_policies.py", "test_claims_accuracy.py", "test_claims_of_episodes.py", "test_confined.py",
    "test_distill_shards.py", "test_dying_engine.py", "test_kill9_small.py", "test_pipeline.py", "test_plugins.py",
    "test_rebuild.py", "test_workers_ray.py",
})  # fmt: skip
"""Files with a test or a fixture that takes ten seconds or more of a core; they begin first, so that none is last."""


def published_rows() -> list[dict[str, str]]:
    """Sixty made-up latencies in the columns of the collection: compute and layers, within 4 % of noise."""
    random = np.random.default_rng(0)
    found = []
    for device, kind, runtime, precision, speed in MEASURED_ON:
        for model, (gmacs, params, activations, layers) in PUBLISHED.items():
            ms = (2 * gmacs / speed + 0.01 * layers) * random.uniform(0.96, 1.04)
            values = (device, "", runtime, model, params, gmacs, "224", precision, "1", "latency_ms", f"{ms:.4f}",
                      activations, layers, kind)  # fmt: skip
            found.append(dict(zip(COLUMNS, map(str, values), strict=True)))
    return found


def write_points(path: Path, rows: list[dict[str, str]]) -> Path:
    """Write published latencies as a CSV file."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    return path


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add what ``make soak`` passes."""
    parser.addoption("--full", action="store_true", help="every draw, kill and case of the tests that have many")


def pytest_configure(config: pytest.Config) -> None:
    """Tell the modules of the tests, which choose their cases when they are collected; heed Ctrl-C, as children do."""
    if config.getoption("--full"):
        os.environ[VARIABLE] = "1"
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell starts what runs in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the long tests: a worker that begins one at the end keeps all others waiting.

    pytest-randomly has shuffled the tests before; the order is otherwise kept.
    """
    items.sort(key=lambda item: item.path.name not in LONG)


def pytest_collection_finish() -> None:
    """Leave what the test modules have imported out of all garbage collections: they took a third of an export."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip a test of ``make soak``, and one that needs what this processor lacks.

    Engines are asked here, never while tests are collected.
    """
    for marker in item.iter_markers("soak"):
        if not full():
            pytest.skip(f"make soak runs it; here: {marker.args[0]}")
    for marker in item.iter_markers("needs"):
        if why := lacks(*marker.args, **marker.kwargs):
            pytest.skip(why)


@pytest.fixture(scope="session", autouse=True)
def _cache_of_the_session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the tests away from the user's cache and measurements, and child processes too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(SHARED, str(found(tmp_path_factory)))
        patch.setenv("VLATOOL_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("VLATOOL_CALIBRATIONS", str(tmp_path_factory.mktemp("calibrations")))
        patch.setenv("VLATOOL_TRUST", str(tmp_path_factory.mktemp("trust") / "trusted.json"))
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_cold_starts() -> Iterator[None]:
    """Start no fresh process for each bundle that is measured in this process; tests of the cold start have some."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(latency, "COLD_STARTS", small_or_full(0, latency.COLD_STARTS))
        yield


@pytest.fixture(scope="session")
def policy_template() -> Path:
    """The folder of the tiny policy; read only."""
    return once("tiny", write_policy)


@pytest.fixture
def policy_dir(policy_template: Path, tmp_path: Path) -> Path:
    """A folder of the tiny policy that the test may change."""
    return Path(shutil.copytree(policy_template, tmp_path / "tiny"))


def made_once(name: str, stage: Transform, source: Bundle | None) -> Bundle:
    """Return what a stage makes of a bundle."""

    def make(folder: Path) -> None:
        (folder / "bundle").mkdir(parents=True)
        stage.run(source, folder / "bundle", Context())

    return Bundle.open(once(name, make) / "bundle")


@pytest.fixture(scope="session")
def source_bundle(policy_template: Path) -> Bundle:
    """The source bundle of the tiny policy; read only."""
    from vlatool.sources.torch_module import TorchModule

    trust.allow(policy_template)  # as making the bundle does, in the process that makes it
    return made_once("source", TorchModule(policy=policy_template), None)


@pytest.fixture(scope="session")
def float_bundle(source_bundle: Bundle) -> Bundle:
    """The tiny policy as exported, float32; read only."""
    from vlatool.export.onnx import ExportOnnx

    return made_once("float", ExportOnnx(), source_bundle)


@pytest.fixture(scope="session")
def int8_bundle(float_bundle: Bundle) -> Bundle:
    """The tiny policy in static int8; read only."""
    from vlatool.quantize.static_int8 import StaticInt8

    return made_once("int8", StaticInt8(), float_bundle)


@pytest.fixture(scope="session")
def pruned_once(source_bundle: Bundle) -> Bundle:
    """The tiny policy without most of its hidden neurons; read only."""
    from vlatool.prune.neurons import Neurons

    place = once(
        "pruned", lambda folder: run_transform(Neurons(ratio=0.7), source_bundle, folder / "bundle", Context()).bundle
    )
    return Bundle.open(place / "bundle")


@pytest.fixture
def onnx_file(float_bundle: Bundle, tmp_path: Path) -> Path:
    """An ONNX file of the tiny policy that the test may change."""
    return Path(shutil.copyfile(float_bundle.path / "graphs/main.onnx", tmp_path / "tiny.onnx"))


@pytest.fixture
def observation() -> dict[str, Any]:
    """One observation that fits the tiny policy, without the batch axis."""
    recorded = observations(1, seed=3)
    return {name: recorded[name][0] for name in ("image", "proprio")} | {"instruction": "go to the red"}


@pytest.fixture
def published() -> list[dict[str, str]]:
    """Rows of published latencies that the test may change."""
    return published_rows()


@pytest.fixture
def points_at(tmp_path: Path) -> Callable[[list[dict[str, str]]], Path]:
    """A function that writes rows of published latencies to a CSV file."""
    return lambda rows: write_points(tmp_path / "points.csv", rows)


@pytest.fixture(scope="session")
def points_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixty published latencies, made up; read only."""
    return write_points(tmp_path_factory.mktemp("points") / "points.csv", published_rows())


@pytest.fixture
def points_file(points_template: Path, tmp_path: Path) -> Path:
    """Sixty published latencies that the test may change."""
    return Path(shutil.copyfile(points_template, tmp_path / "points.csv"))


@pytest.fixture
def wrong_engine(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """A function that lets ONNX Runtime give so many times what the graph says, as a wrong kernel would.

    What would run in a child process, which has an ONNX Runtime of its own, runs in this one.
    """
    real, apart = OrtCpuSession.run, children.call

    def make(factor: float) -> None:
        def run(self: OrtCpuSession, feeds: Any) -> dict[str, Any]:
            by = np.float32(1 if isinstance(self, ReferenceSession) else factor)
            return {name: value * by for name, value in real(self, feeds).items()}

        def call(function: str, job: Any, tell: Any, *rest: Any, own: bool = False, **more: Any) -> Any:
            if not own:
                return apart(function, job, tell, *rest, **more)
            module, _, name = function.partition(":")
            return getattr(importlib.import_module(module), name)(job, tell)

        monkeypatch.setattr(OrtCpuSession, "run", run)
        monkeypatch.setattr(children, "call", call)

    return make


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[Bundle], Bundle]:
    """A function that copies a bundle to a place where the test may damage it."""

    def copy(bundle: Bundle) -> Bundle:
        return Bundle(Path(shutil.copytree(bundle.path, tmp_path / "copied")), bundle.manifest)

    return copy


@pytest.fixture
def resealed() -> Callable[[Bundle], Bundle]:
    """A function that hashes the files of a bundle again, so that a damage is no longer seen as a changed file."""

    def again(bundle: Bundle) -> Bundle:
        return seal(bundle.path, bundle.manifest)

    return again
