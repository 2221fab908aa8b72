"""The engine that ``auto`` stands for, and why."""

from __future__ import annotations

from dataclasses import dataclass

from vlatool.bundle.manifest import Manifest
from vlatool.errors import MissingExtra, VlatoolError
from vlatool.runtime.engine import DEFAULT_ENGINE, engine_class, usable_engines


@dataclass(frozen=True)
class EngineChoice:
    """A chosen engine.

    Args:
        engine: Its name.
        reason: Why it was chosen, as a sentence.
        replaces: Engine that the bundle was made for, where another was chosen; else empty.
    """

    engine: str
    reason: str
    replaces: str = ""


def choose_engine(manifest: Manifest) -> EngineChoice:
    """Return the engine that a bundle was made for if it can be used here, else the first one that can.

    ``optimize --profile`` makes a bundle for an engine of the board's profile, so that the first follows the profile.
    The golden action shows whether another engine computes the same; in which precision, ``engine_proof`` does.

    Raises:
        MissingExtra: when no engine can be used on this machine.
        UsageError: when the bundle names an engine that is not known.
    """
    made_for = manifest.engine or DEFAULT_ENGINE
    board = str(manifest.made_by.get("profile") or "")
    about = f"the bundle was made for {made_for}{f' on {board}' if board else ''}"
    trouble = trouble_of(made_for)
    if not trouble:
        return EngineChoice(made_for, f"{about}.")
    for name in usable_engines():
        if name != made_for and not trouble_of(name):
            return EngineChoice(name, f"{about}, which cannot be used here: {trouble} {name} can.", made_for)
    raise MissingExtra(f"No engine can be used here; {about}: {trouble}", engine_class(made_for).installation())


def trouble_of(engine: str) -> str:
    """Return why an engine cannot be used on this machine; empty where it can."""
    library = engine_class(engine)
    try:
        library.library()
        library.execution_providers()
    except VlatoolError as error:
        return error.message
    except Exception as error:  # the seam: a library may fail in its own way when it is loaded
        return f"{type(error).__name__}: {error}"
    return ""
