"""A source: a text file with the path of an ONNX file."""

from pathlib import Path

from vlatool.registry import Claim
from vlatool.sources.onnx import OnnxFile


class AcmeFile(OnnxFile):
    """A policy that a .acme file points to."""

    needs = "a .acme file"

    @classmethod
    def claims(cls, typed):
        """Claim a .acme file."""
        return Claim.CERTAIN if typed.endswith(".acme") else Claim.NONE

    @classmethod
    def of(cls, typed):
        """Return the stage for the file that it points to."""
        path = Path(typed)
        return cls(model=path.with_name(path.read_text().strip()))
