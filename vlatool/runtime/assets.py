"""Files that a spec names (statistics, tokenizers): read from a bundle, verified, or from a folder."""

from __future__ import annotations

import os
from pathlib import Path

from vlatool.bundle.bundle import ASSETS, Bundle
from vlatool.errors import SpecError
from vlatool.files.limits import check_limit
from vlatool.files.validate import path_problem, short_repr
from vlatool.files.verified_read import open_regular, read_all

Assets = Path | Bundle
"""A folder, or a bundle, which stands for its ``assets/``."""


def read_asset(assets: Assets, name: str, allowed: str) -> bytes:
    """Return the content of an asset.

    Raises:
        BundleError: when a bundle does not record it, or it is not what the manifest says.
        SpecError: when it is not inside the folder, or larger than the limit.
        OSError: when it is not in the folder, or a link.
    """
    if isinstance(assets, Bundle):
        return assets.asset(name, allowed)
    if reason := path_problem(name):
        raise SpecError(f"The spec names the file {short_repr(name)}: {reason}.")
    with open_regular(assets, name) as handle:
        size = os.fstat(handle).st_size
        check_limit(allowed, size, str(assets / name), SpecError)
        return read_all(handle, size)


def asset_path(assets: Assets, name: str) -> Path:
    """Return the path of an asset, for messages."""
    return (assets.path / ASSETS if isinstance(assets, Bundle) else assets) / name
