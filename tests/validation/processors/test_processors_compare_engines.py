"""Two engines of one machine compared: equal policies are close, a bundle that one refuses is a row that says so."""

from pathlib import Path

import pytest
from compare_engines import main

from vlatool.bundle.bundle import Bundle


def test_a_row_has_times_and_errors_and_a_refusal_is_a_row(float_bundle: Bundle, tmp_path: Path, capsys) -> None:
    main(["openvino", "ort_cpu", str(float_bundle.path), str(tmp_path), "--observations", "3"])
    _, _, row, refused = capsys.readouterr().out.splitlines()
    name, first, second, median, largest, golden = (cell.strip() for cell in row.strip("|").split("|"))
    assert name == float_bundle.path.name
    assert all(float(cell.removesuffix(" ms")) > 0 for cell in (first, second))
    assert 0 <= float(median) <= float(largest) < 1e-3
    assert float(golden) == pytest.approx(0, abs=1e-3)
    assert refused.startswith(f"| {tmp_path.name} | refused: ")
