"""What may be typed as a budget."""

import pytest

from vlatool.cli.optimize import budget
from vlatool.errors import UsageError


@pytest.mark.parametrize(
    ("text", "means"),
    [
        ("1%", {"max_drop": 0.01, "metric": "", "max_metric": None}),
        ("0.02", {"max_drop": 0.02, "metric": "", "max_metric": None}),
        ("relative_error=0.04", {"metric": "relative_error", "max_metric": 0.04}),
        ("gripper_flips_baseline = 1%", {"metric": "gripper_flips_baseline", "max_metric": 0.01}),
        ("error_baseline.dx=2e-3", {"metric": "error_baseline.dx", "max_metric": 0.002}),
        ("0.002m", {"metric": "unit:m", "max_metric": 0.002}),
        ("0.5 deg", {"metric": "unit:deg", "max_metric": 0.5}),
    ],
)
def test_a_budget(text: str, means: dict[str, object]) -> None:
    assert budget(text) == means


@pytest.mark.parametrize(
    "text", ["", "one", "=3", "relative_error=", "relative_error=-1", "101%", "nan", "1%%", "dx=1=2"]
)
def test_what_is_no_budget(text: str) -> None:
    with pytest.raises(UsageError, match="--max-drop"):
        budget(text)
