"""A source: a text file with the path of an ONNX file."""

from pathlib import Path

from vlatool.sources.onnx import OnnxFile


class AcmeFile(OnnxFile):
    """A policy that a .acme file points to."""

    @classmethod
    def accepting(cls, typed):
        """Take a .acme file."""
        path = Path(typed)
        if path.suffix != ".acme":
            return None
        return cls(model=path.with_name(path.read_text().strip()))
