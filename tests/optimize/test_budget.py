import pytest

from vlatool.bundle.spec import TensorSpec
from vlatool.errors import RecipeError
from vlatool.optimize.budget import Budget

ACTION = TensorSpec("action", (1, 2), unit=("m", "rad"), labels=("dx", "turn"))


@pytest.mark.parametrize("name", ["relative_error", "dx", "unit:m", "disagreement"])
def test_a_budget_may_name_a_measure_an_element_or_a_unit(name: str) -> None:
    Budget(name, 0.1).check_name(ACTION)


@pytest.mark.parametrize(("name", "hint"), [
    ("foo", "known:"), ("relative_eror", "did you mean 'relative_error'"), ("unit:mm", "did you mean 'unit:m'"),
])  # fmt: skip
def test_a_name_that_nothing_has_is_refused_as_such(name: str, hint: str) -> None:
    with pytest.raises(RecipeError, match=f"names '{name}', which vlatool does not measure") as caught:
        Budget(name, 0.1).check_name(ACTION)
    assert hint in caught.value.message
