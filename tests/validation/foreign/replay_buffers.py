"""Hold the reader of Diffusion Policy's datasets against its own ``ReplayBuffer``, which writes them.

pip install zarr==2.18.3 numcodecs==0.13.1      # in an environment of its own: ZARR_PYTHON
python tests/validation/foreign/replay_buffers.py --python ZARR_PYTHON --source diffusion_policy/common/replay_buffer.py
"""

from __future__ import annotations

import argparse
import subprocess
from pathlib import Path

import numpy as np

from vlatool.bundle.spec import PolicySpec, TensorSpec
from vlatool.data import read_recording

WRITE = Path(__file__).with_name("replay_buffer_write.py")
SPEC = PolicySpec(
    (TensorSpec("img", (1, 24, 32, 3), "uint8"), TensorSpec("state", (1, 5))),
    (TensorSpec("action", (1, 1, 2)),),
    10.0,
    1,
)


def differences(path: Path) -> dict[str, int]:
    """Return the number of values of each part that are not those that the buffer holds."""
    recording = read_recording(path, SPEC)
    rows = np.arange(len(recording))
    found = {name: np.asarray(recording.inputs[name][rows]) for name in ("img", "state")}
    found["action"] = np.asarray(recording.actions[rows])
    found["ends"] = np.cumsum(np.unique(recording.episodes, return_counts=True)[1])
    with np.load(f"{path}.npz") as held:
        return {name: int(np.count_nonzero(values.reshape(held[name].shape) != held[name]))
                for name, values in found.items()}  # fmt: skip


def main() -> int:
    """Write, compare, print; 1 when anything differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", required=True, help="interpreter with zarr 2")
    parser.add_argument("--source", required=True, help="replay_buffer.py of Diffusion Policy")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/replay-buffers"))
    arguments = parser.parse_args()
    if not (arguments.output / "zip.zarr.zip.npz").exists():
        subprocess.run([arguments.python, WRITE, arguments.source, arguments.output], check=True)
    found = {path.stem: differences(path.with_suffix("")) for path in sorted(arguments.output.glob("*.npz"))}
    for name, each in found.items():
        print(name, each)
    return int(not found or any(value for each in found.values() for value in each.values()))


if __name__ == "__main__":
    raise SystemExit(main())
