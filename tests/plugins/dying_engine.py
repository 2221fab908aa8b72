"""An ONNX Runtime that ends its process on some graphs: imported by every Python of an environment (``.pth``).

``DIES`` says how and when (``abort:open``); ``DIES_OF`` is what stands in the graphs that it dies of.
"""

import ctypes
import os
import signal
import sys

HOW = {
    "abort": lambda: (os.write(2, b"engine.cc:1130: Assertion '__n < this->size()' failed.\n"), os.abort()),
    "crash": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "leave": lambda: sys.exit(0),
    "end": lambda: os._exit(0),
    "hang": lambda: [ctypes.PyDLL(None).pause() for _ in iter(int, 1)],
}


def plant() -> None:
    """Let sessions die as the variables say then."""
    from vlatool.runtime.engines.ort_cpu import OrtCpuSession

    begin, run, probe = OrtCpuSession.__init__, OrtCpuSession.run, OrtCpuSession.arithmetic

    def die(when: str, graph: bytes) -> None:
        how, _, moment = os.environ.get("DIES", "").partition(":")
        if when == moment and os.environ["DIES_OF"].encode() in graph:
            HOW[how]()

    def open_or_die(self, path, threads=None, compute="", opened=None):
        self.graph = opened if isinstance(opened, bytes) else path.read_bytes()
        die("open", self.graph)
        begin(self, path, threads, compute, opened)

    def run_or_die(self, feeds):
        die("run", self.graph)
        return run(self, feeds)

    def probe_or_die():
        die("probe", b"")
        return probe()

    OrtCpuSession.__init__, OrtCpuSession.run = open_or_die, run_or_die
    OrtCpuSession.arithmetic = staticmethod(probe_or_die)


plant()
