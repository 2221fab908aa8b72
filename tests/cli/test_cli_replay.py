"""``vlatool record`` and ``vlatool replay`` as typed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from _slots import bundle_of

from vlatool.runtime.telemetry.run_file import Frame, FrameKind, RunWriter, read_run


@pytest.fixture
def recorded(vlatool, tmp_path: Path) -> tuple[Path, Path]:
    bundle, file = bundle_of(tmp_path / "bundle", 1).path, tmp_path / "run"
    code, out, err = vlatool("record", bundle, "-o", file, "--steps", 5, "--threads", 1)
    assert (code, err) == (0, "")
    assert "5 control steps" in out
    return bundle, file


def test_a_run_is_bit_equal(vlatool, recorded: tuple[Path, Path]) -> None:
    bundle, file = recorded
    assert vlatool("replay", file, bundle) == (0, "5 control steps: bit-equal\n", "")
    code, _, err = vlatool("record", bundle, "-o", file, "--steps", 5)
    assert (code, "File exists" in err) == (3, True)


def test_the_first_difference_is_named_and_ends_with_1(vlatool, recorded: tuple[Path, Path]) -> None:
    bundle, file = recorded
    writer = RunWriter(file.with_name("changed"))
    for frame in read_run(file):
        arrays = {name: array.copy() for name, array in frame.arrays.items()}
        if frame.kind is FrameKind.TICK and frame.values["step"] == 3:
            arrays["action"][-1] = np.nextafter(arrays["action"][-1], np.float32(9e9))
        writer.append(Frame(frame.kind, frame.values, arrays))
    writer.close()
    code, out, err = vlatool("replay", file.with_name("changed"), bundle)
    assert code == 1
    assert out.startswith("step 3, action[")
    assert "is not computed again as it was" in err
    code, out, _ = vlatool("replay", file.with_name("changed"), bundle, "--json")
    found = json.loads(out)
    assert (code, found["equal"], found["difference"]["step"]) == (1, False, 3)


def test_a_damaged_file_is_refused(vlatool, recorded: tuple[Path, Path]) -> None:
    bundle, file = recorded
    content = bytearray(file.read_bytes())
    content[100] ^= 1
    file.write_bytes(content)
    code, _, err = vlatool("replay", file, bundle)
    assert (code, "is not as it was written" in err) == (3, True)
