"""Selection of the parts that may be removed: ``--include``, ``--exclude``, and protected names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from vlatool.errors import RecipeError
from vlatool.graph.nodes import matches


@dataclass(frozen=True)
class Selection:
    """Parts by name.

    Args:
        include, exclude: Globs of names; everything unprotected when nothing is included.
        protected: Words in the names of parts that stay unless they are included.
        parts: Globs of other parts that stay unless they are included.
    """

    include: tuple[str, ...]
    exclude: tuple[str, ...]
    protected: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()

    @classmethod
    def protecting(
        cls, words: tuple[str, ...], parts: Mapping[str, Sequence[str]],
        include: tuple[str, ...] = (), exclude: tuple[str, ...] = (),
    ) -> Selection:  # fmt: skip
        """Return the selection where names with these words are protected, and parts that a description names so.

        Args:
            parts: Name of a part, such as ``action_head`` -> globs of modules.
        """
        globs = [glob for name, globs in parts.items() if _has_word(name, words) for glob in globs]
        return cls(include, exclude, words, tuple(globs))

    def check(self, names: Sequence[str], what: str) -> None:
        """Refuse a pattern that matches nothing."""
        for pattern in (*self.include, *self.exclude):
            if not any(matches(name, (pattern,)) for name in names):
                raise RecipeError.unknown(f"No {what} matches '{pattern}'", pattern, names)

    def selects(self, names: Iterable[str]) -> bool:
        """Return whether a part with these names may be removed: one of them is included, and none is excluded."""
        listed = list(names)
        included = any(matches(name, self.include) if self.include else not self.protects(name) for name in listed)
        return included and not any(matches(name, self.exclude) for name in listed)

    def protects(self, name: str) -> bool:
        """Return whether a part stays unless it is included."""
        return _has_word(name, self.protected) or matches(name, self.parts)


def _has_word(name: str, words: Sequence[str]) -> bool:
    return any(word in part for part in name.lower().split(".") for word in words)
