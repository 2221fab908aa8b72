"""Calls of engines that may end the process: the parent process is notified before each.

A graph that nobody has run yet can make an engine abort, crash or hang. The build side opens and runs such graphs in
child processes (``vlatool.user_code.children``); a child tells its parent here what it does, so that the parent can say
it where no answer comes. A process that nobody watches, such as a robot's, tells nobody.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from vlatool.errors import GraphError

EngineCall = tuple[str, str, str]
"""Which library (``ONNX Runtime 1.23.2``), what it does in the past tense, and the package that installs it."""
REMEDY = (
    "where the graph was quantized, leave layers out with --exclude or use another --layout; otherwise use another "
    "release of {package}"
)

_listener: Callable[[EngineCall | None], None] | None = None
_now: EngineCall | None = None


def listen(listener: Callable[[EngineCall | None], None] | None) -> None:
    """Set a listener that receives each call as it begins, and None when none is running."""
    global _listener, _now
    _listener, _now = listener, None


@contextlib.contextmanager
def engine_call(engine: Any, deed: str) -> Iterator[None]:
    """Notify the parent process of what an engine does in the block.

    Args:
        engine: a class of ``vlatool.runtime.engine``.
        deed: what the engine does, in the past tense: ``opened the graph 'main'``.

    Raises:
        GraphError: when it wants to leave the process.
    """
    if _listener is None:
        yield
        return
    before, doing = _now, (_title(engine), deed, str(getattr(engine, "package", "")))
    _notify(doing)
    try:
        yield
    except SystemExit as left:
        raise engine_crash(doing, f"called sys.exit({left.code})") from None
    finally:
        _notify(before)


def engine_crash(doing: EngineCall, how: str, last: str = "") -> GraphError:
    """Return the error of an engine that ended its process, or wanted to.

    Args:
        doing: call that was running.
        how: how it ended, in the past tense.
        last: last line of its output.
    """
    title, deed, package = doing
    said = f" It said last: {last}" if last else ""
    return GraphError(f"{title} {how} when it {deed}.{said}", REMEDY.format(package=package or "the engine"))


def _notify(doing: EngineCall | None) -> None:
    global _now
    _now = doing
    if _listener is not None:
        _listener(doing)


def _title(engine: Any) -> str:
    title = str(getattr(engine, "title", "") or getattr(engine, "__name__", "the engine"))
    with contextlib.suppress(Exception):  # a package of its own may have no version
        title = f"{title} {engine.version()}".rstrip()
    return title
