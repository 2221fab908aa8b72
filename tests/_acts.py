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
