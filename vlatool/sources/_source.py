"""What every source is: a stage that starts a chain, and that knows what a person types to name it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from vlatool.bundle.bundle import Bundle
from vlatool.stage.base import Transform

if TYPE_CHECKING:
    from typing_extensions import Self


class Source(Transform):
    """A way of obtaining a policy."""

    has_graphs: ClassVar[bool] = False
    """Whether its bundle has graphs, so that nothing is exported."""
    policy: Path | None = None

    @classmethod
    def accepting(cls, typed: str) -> Self | None:
        """Return the stage for what a person types as SOURCE, None where that is another kind of source.

        Raises:
            SourceError: when it is this kind, and wrong.
        """
        raise NotImplementedError

    def as_recorded(self, entry: Mapping[str, Any], bundle: Bundle) -> Self:
        """Return the same source with the options that the build record of a bundle has for it.

        Raises:
            SourceError: when the record does not fit this source.
        """
        return self
