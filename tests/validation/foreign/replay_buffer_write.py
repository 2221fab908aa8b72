"""Write datasets with Diffusion Policy's own ``ReplayBuffer``, in an interpreter with zarr 2 and numpy.

ZARR_PYTHON tests/validation/foreign/replay_buffer_write.py REPLAY_BUFFER_PY FOLDER
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import zarr

LENGTHS = (35, 50, 20, 44)


def fill(buffer: Any, *, drop: bool) -> None:
    """Add episodes of random values; the last one is dropped again, as a person does who recorded a bad one."""
    random = np.random.default_rng(0)
    for length in LENGTHS:
        values = {"state": random.normal(size=(length, 5)), "action": random.normal(size=(length, 2))}
        pictures = random.integers(0, 256, (length, 24, 32, 3), np.uint8)
        buffer.add_episode({**{name: value.astype(np.float32) for name, value in values.items()}, "img": pictures})
    if drop:
        buffer.drop_episode()


def main() -> None:
    """Write a directory from the disk, one from memory, and a zip; beside each what the buffer itself holds."""
    spec = importlib.util.spec_from_file_location("replay_buffer", sys.argv[1])
    module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    spec.loader.exec_module(module)  # type: ignore[union-attr]
    folder = Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    disk = module.ReplayBuffer.create_empty_zarr(storage=zarr.DirectoryStore(folder / "disk.zarr"))
    fill(disk, drop=True)
    memory = module.ReplayBuffer.create_empty_numpy()
    fill(memory, drop=False)
    memory.save_to_path(str(folder / "memory.zarr"))
    with zarr.ZipStore(folder / "zip.zarr.zip", mode="w") as store:
        memory.save_to_store(store)
    for name, buffer in (("disk.zarr", disk), ("memory.zarr", memory), ("zip.zarr.zip", memory)):
        values = {key: buffer[key][:] for key in ("img", "state", "action")}
        np.savez(folder / f"{name}.npz", ends=buffer.episode_ends[:], **values)


if __name__ == "__main__":
    main()
