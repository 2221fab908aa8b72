"""Things that a user's code may do to the process that runs it, and what is then said."""

from __future__ import annotations

ENDS = {
    "sys.exit": ("import sys; sys.exit(0)", r"sys\.exit\(0\)"),
    "os._exit": ("import os; os._exit(0)", "exit code 0"),
    "kill": ("import os; os.kill(os.getpid(), 9)", "SIGKILL"),
    "crash": ("import ctypes; ctypes.string_at(0)", "SIGSEGV"),
    "raise": ("raise type('Stop', (BaseException,), {})('enough')", "raised Stop: enough"),
}
"""Name -> statement that ends the process, and a part of the message."""
SAY = """\
import os, stat
for fd in map(int, os.listdir("/proc/self/fd")):
    try:
        if stat.S_ISSOCK(os.fstat(fd).st_mode): os.write(fd, {line!r})
    except OSError:
        pass
"""
NONSENSE = "answered nonsense"
FORGES = {
    "mute": ("class X(Exception):\n    def __str__(self): raise ValueError()\nraise X()", "its text cannot be read"),
    "mute base": ("class X(BaseException):\n    def __str__(self): raise ValueError()\nraise X()", "raised X"),
    "verdict": ("import vlatool.errors as e; raise e.GateFailed('slow', '')", "raised GateFailed: slow"),
    "base": ("import vlatool.errors as e; raise e.VlatoolError('x', 'y')", "raised VlatoolError: x"),
    "pipe": ("raise BrokenPipeError(32, 'x')", "BrokenPipeError"),
    "progress_bad_args": (SAY.format(line=b'{"progress": [1, 2, 3, 4]}\n'), NONSENSE),
    "progress_int": (SAY.format(line=b'{"progress": 3}\n'), NONSENSE),
    "deep_json": (SAY.format(line=b"[" * 50_000 + b"\n"), NONSENSE),
    "error_vlatool": (SAY.format(line=b'{"error": "VlatoolError", "message": "x", "fix": ""}\n'), "VlatoolError: x"),
    "gate": (SAY.format(line=b'{"error": "GateFailed", "message": "x", "fix": ""}\n'), "failed: GateFailed: x"),
    "ours": (SAY.format(line=b'{"raised": "X", "message": "m", "ours": true}\n'), "failed: X: m"),
    "broken pipe": (SAY.format(line=b'{"errno": 32, "message": "x", "file": null}\n'), NONSENSE),
}
"""Name -> statements that pretend to be vlatool, or have no words, and a part of the message."""
DISTURBS = """\
import os, signal, sys, threading, time
print("printed by the policy")
os.write(1, b'{"written": "to descriptor 1"}\\\\n')
os.write(2, b"written to descriptor 2\\\\n")
os.chdir("/")
os.environ["DISTURBED"] = "1"
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
threading.Thread(target=lambda: [(time.sleep(0.2), os.write(1, b"late")) for _ in range(600)]).start()
""".replace("\\\\", "\\")
"""Statements that leave nothing as it was, and a thread that goes on printing."""


def policy(at_import: str = "", in_make: str = "", in_forward: str = "") -> str:
    """Return a policy.py of one linear layer that does these things."""
    return f"""\
import torch
from torch import nn
{at_import}

class Policy(nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.linear = nn.Linear(3, 2)

    def forward(self, x):
{_indented(in_forward, 8)}
        return self.linear(x)

def make():
{_indented(in_make, 4)}
    return Policy()
"""


def environment(at_import: str = "", in_make: str = "", in_reset: str = "", in_step: str = "") -> str:
    """Return an environment.py for that policy, of episodes of one step."""
    return f"""\
import numpy as np
{at_import}

class World:
    def reset(self, *, seed=None):
{_indented(in_reset, 8)}
        return {{"x": np.zeros(3, np.float32)}}, {{}}

    def step(self, action):
{_indented(in_step, 8)}
        return self.reset()[0], 0.0, True, False, {{"success": True}}

def make(task):
{_indented(in_make, 4)}
    return World()
"""


def _indented(text: str, spaces: int) -> str:
    return "\n".join(" " * spaces + line for line in (text or "pass").splitlines())


POLICY_YAML = """\
name: plain
source: policy.py:make
spec:
  inputs: [{name: x, shape: [1, 3]}]
  outputs: [{name: y, shape: [1, 2]}]
  control_hz: 10
environment: {make: environment.py:make, tasks: [reach]}
"""
