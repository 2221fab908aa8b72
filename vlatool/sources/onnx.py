"""A policy that is one ONNX file already."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from vlatool.bundle.bundle import Bundle
from vlatool.errors import SourceError
from vlatool.module.description import FILE, Description
from vlatool.registry import Claim
from vlatool.sources._graph_source import GraphSource
from vlatool.sources._onnx_files import load_onnx, refuse_bare
from vlatool.sources._onnx_operators import refuse_operators
from vlatool.stage.base import Context

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlatool.hardware.profile import Profile


class OnnxFile(GraphSource):
    """A policy that is one ONNX file; the spec comes from a description, or from the file's inputs and outputs."""

    needs: ClassVar[str] = "a .onnx file"

    @classmethod
    def claims(cls, typed: str) -> Claim:
        """Claim a .onnx file; perhaps a directory that holds one and describes nothing."""
        path = Path(typed)
        if not path.is_dir():
            return Claim.CERTAIN if path.suffix == ".onnx" else Claim.NONE
        return Claim.MAYBE if any(path.glob("*.onnx")) and not (path / FILE).is_file() else Claim.NONE

    @classmethod
    def of(cls, typed: str) -> Self:
        """Return the stage for a .onnx file; point out the file where a directory holds one."""
        if (path := Path(typed)).is_dir():
            refuse_bare(path)
        return super().of(typed)

    def check(self, source: Bundle | None, profile: Profile | None) -> None:
        """The file exists."""
        if not self.model.is_file():
            raise SourceError(f"No such ONNX file: {self.model}.", "check the path")

    def read(self, description: Description | None, context: Context) -> tuple[Any, Any]:
        """Load the file, whose operators must be known."""
        model = load_onnx(self.model)
        refuse_operators(model, self.model)
        return model, None
