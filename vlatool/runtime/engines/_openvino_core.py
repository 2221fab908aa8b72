"""The one OpenVINO core of a process, which is never given up.

The CPU plugin of OpenVINO (2026.4) gives the thread that compiles first an alternate stack for signals, and frees it
with the last core and the last compiled model. Where another thread gives those up, the first one keeps the address,
and the next signal that Python handles there, such as Ctrl-C, ends the process with SIGSEGV.
"""

from __future__ import annotations

import os
from typing import Any

from vlatool.errors import require

_cores: dict[int, Any] = {}
"""Process -> core: a process that was forked has none of the threads of its parent's."""


def openvino_core() -> Any:
    """Return the core of this process.

    Raises:
        MissingExtra: when openvino is not installed.
    """
    process = os.getpid()
    if process not in _cores:
        _cores[process] = require("openvino", "openvino").Core()
    return _cores[process]
