"""The end of a process while a thread is still in an engine: with the exit code of the program, not with SIGABRT.

Python ends a thread that comes back to it while it shuts down by unwinding the thread's stack (``pthread_exit``), which
the C++ code of an engine does not allow: ``std::terminate``, "terminate called without an active exception". Later,
``exit`` destroys objects that the engine still uses.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import weakref
from typing import Protocol

EXIT_S = 1.0
"""Seconds for which the process, when it ends, waits for the threads that are in an engine."""


class EngineThread(Protocol):
    """A thread that calls an engine, and knows how to be ended."""

    @property
    def busy(self) -> bool:
        """Whether it is in a call."""

    def close(self, seconds: float = EXIT_S) -> None:
        """End it, after the call in progress, which is stopped if it can be and waited for so many seconds."""


_THREADS: weakref.WeakSet[EngineThread] = weakref.WeakSet()


def close_at_exit(thread: EngineThread) -> None:
    """Close a thread before Python shuts down."""
    _THREADS.add(thread)


def _close_all() -> None:
    threads = list(_THREADS)
    for thread in threads:
        thread.close(EXIT_S)
    if any(thread.busy for thread in threads):
        leave_busy_threads()


def leave_busy_threads() -> None:
    """Let the process end beside a thread that does not: nothing is destroyed that the thread may use.

    A thread that comes back meanwhile sleeps where it would end the process. ``exit`` writes what C libraries hold
    for files and then ends the process at once, with its status. Python shuts down as always before that. Where the C
    library has no ``on_exit`` (it is glibc's), nothing changes.
    """
    with contextlib.suppress(ImportError, AttributeError, OSError):
        import ctypes

        libc = ctypes.CDLL(None)
        register, code_at = libc.on_exit, ctypes.c_void_p
        register.argtypes = [code_at, code_at]
        register(ctypes.cast(libc._exit, code_at), None)  # called first: with the status, before what was registered
        register_plain = libc.__cxa_atexit
        register_plain.argtypes = [code_at, code_at, code_at]
        register_plain(ctypes.cast(libc.fflush, code_at), None, None)  # and this before it
        cxx = ctypes.CDLL("libstdc++.so.6", mode=os.RTLD_NOLOAD | os.RTLD_NOW)  # the one that the engine has loaded
        set_terminate = cxx._ZSt13set_terminatePFvvE  # std::set_terminate(void (*)())
        set_terminate.argtypes, set_terminate.restype = [code_at], code_at
        set_terminate(ctypes.cast(libc.pause, code_at))


atexit.register(_close_all)
