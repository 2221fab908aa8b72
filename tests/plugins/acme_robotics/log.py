"""A format of recordings: a directory with a log.json, and a file of raw rows for each large signal."""

import json

import numpy as np

from vlatool.data import Reader, build_recording
from vlatool.files.rows import OpenFile, Plain, Rows
from vlatool.registry import Claim


class AcmeLog(Reader):
    """Reads what an Acme robot logs."""

    needs = "a directory with a log.json"

    @classmethod
    def claims(cls, path):
        """Claim a directory with a log.json."""
        return Claim.CERTAIN if (path / "log.json").is_file() else Claim.NONE

    def open(self, path, spec, names):
        """Open a log; rows of large signals are read from their files when they are asked for."""
        log = json.loads((path / "log.json").read_text())
        arrays = {name: np.array(values) for name, values in log["small"].items()}
        for name, signal in log["large"].items():
            rows = Plain(OpenFile.at(path / f"{name}.raw"), start=0)
            arrays[name] = Rows(rows, tuple(signal["shape"]), np.dtype(signal["dtype"]), f"'{name}' in {path}")
        return build_recording(path, arrays, spec, names, times=np.array(log["times"]))
