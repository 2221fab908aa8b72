"""Resized pictures of whole numbers are the same on each processor, whose products of matrices add in other orders."""

import os
import platform
import subprocess
import sys

import pytest

RESIZE = """
import hashlib
import numpy as np
from vlatool.runtime.resampling import resampler
picture = np.random.default_rng(0).integers(0, 256, (97, 131, 3), np.uint8)
found = [resampler(*case, (97, 131), (42, 56))(picture).tobytes() for case in (
    ("torch_uint8", "area", False), ("opencv", "area", False), ("opencv", "bicubic", False), ("pil", "lanczos", True)
)]
print(*(hashlib.sha256(content).hexdigest()[:16] for content in found))
"""
CORES = ("Haswell", "Zen", "Prescott", "SkylakeX")
"""Processors of OpenBLAS, which NumPy's wheels take from this variable; the last one needs AVX512."""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="these are x86 processors")
def test_whole_numbers_are_the_same_whatever_the_order_of_sums():
    found = {}
    for core in (*CORES[: 4 if "avx512f" in cpu_flags() else 3], ""):
        done = subprocess.run([sys.executable, "-c", RESIZE], env={**os.environ, "OPENBLAS_CORETYPE": core}, check=True,
                              capture_output=True, text=True)  # fmt: skip
        found[core] = done.stdout.split()
    assert all(each == found[""] for each in found.values()), found


def cpu_flags() -> str:
    with open("/proc/cpuinfo", encoding="utf-8") as file:
        return file.read()
