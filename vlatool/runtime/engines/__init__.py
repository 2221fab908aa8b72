"""Inference libraries, one file each: the only ones that open one."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vlatool.runtime.engines._reference import ReferenceSession


def reference() -> type[ReferenceSession]:
    """Return the session that computes each operator as it is written: what engines are held against.

    Raises:
        MissingExtra: when the library that computes so is not installed.
    """
    from vlatool.runtime.engines._reference import ReferenceSession

    return ReferenceSession
