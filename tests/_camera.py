"""The tiny policy behind a camera: frames of 16 x 20 in BGR, of which its network sees (3, 8, 8) in RGB, -1 to 1."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from _shared import once
from _tiny import ENVIRONMENT_PY, POLICY_PY, POLICY_YAML, observations, with_expert, write_policy

IMAGE = """{frame: bgr, like: opencv, range: [-1, 1], camera: [16, 20], steps: [
       {op: crop, size: [16, 16]}, {op: resize, size: [8, 8], filter: nearest}]}"""
CHANGES = {
    "policy.yaml": (
        POLICY_YAML,
        "{name: image, shape: [1, 8, 8, 3], dtype: uint8, unit: rgb}",
        f"{{name: image, shape: [1, 3, 8, 8], dtype: float32, image: {IMAGE}}}",
    ),
    "policy.py": (POLICY_PY, "image.permute(0, 3, 1, 2).float() / 127.5 - 1.0", "image"),
}
SEEN = 'torch.from_numpy(np.moveaxis(observation["image"][::2, 2:-2:2, ::-1], -1, 0) / np.float32(127.5) - 1)[None]'


def frames(count: int, seed: int) -> Any:
    """What the camera gives, (count, 16, 20, 3)."""
    return np.random.default_rng(seed).integers(0, 256, (count, 16, 20, 3), np.uint8)


def write_camera_policy(folder: Path) -> Path:
    """Write it into a new folder, with recordings of frames."""
    write_policy(folder)
    for name, (text, before, after) in CHANGES.items():
        assert before in text, name
        (folder / name).write_text(text.replace(before, after))
    world = ENVIRONMENT_PY.replace('torch.from_numpy(observation["image"].copy())[None]', SEEN)
    (folder / "environment.py").write_text(world.replace("(8, 8, 3)", "(16, 20, 3)"))
    for name, count, seed in (("calibration", 24, 1), ("evaluation", 16, 2)):
        recorded = observations(count, seed) | {"image": frames(count, seed)}
        np.savez(folder / f"{name}.npz", **with_expert(recorded, folder))
    return folder


def camera_source() -> Any:
    """Its source bundle; read only."""
    from vlatool.sources.torch_module import TorchModule
    from vlatool.user_code import trust

    policy = once("camera", write_camera_policy)
    trust.allow(policy)
    return _bundle("camera-source", TorchModule(policy=policy), None)


def camera_bundle() -> Any:
    """The policy as exported, float32; read only."""
    from vlatool.export.onnx import ExportOnnx

    return _bundle("camera-float", ExportOnnx(), camera_source())


def _bundle(name: str, stage: Any, source: Any) -> Any:
    from vlatool.bundle.bundle import Bundle
    from vlatool.stage.base import Context

    def make(folder: Path) -> None:
        (folder / "bundle").mkdir(parents=True)
        stage.run(source, folder / "bundle", Context())

    return Bundle.open(once(name, make) / "bundle")
