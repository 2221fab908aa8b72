"""What an explanation says of the time, from operators that are made up."""

from vlatool.explain._operators import Operator
from vlatool.explain._tables import reach_sentence


def operator(kind: str, precision: str, ms: float) -> Operator:
    return Operator("main", kind, kind, precision, "", 1, ms)


OPERATORS = [operator("MatMulIntegerToFloat", "int8", 60.0), operator("Gelu", "float32", 12.0),
             operator("Softmax", "float32", 8.0), operator("Reshape", "moving data", 0.1)]  # fmt: skip


def test_the_rest_is_what_products_lose_and_every_other_operator() -> None:
    (text,) = reach_sentence(OPERATORS, {"int8": 4_000_000_000, "float32": 0}, {"int8": 100.0, "float32": 50.0})
    assert "(int8 100 GMAC/s) its MACs would take 40 of the 80.1 ms (50%)" in text
    assert "its products take 20 ms more than that, everything else 20 ms: Gelu 12 ms, Softmax 8 ms." in text


def test_products_at_that_speed_lose_nothing() -> None:
    (text,) = reach_sentence(OPERATORS, {"int8": 6_000_000_000}, {"int8": 100.0})
    assert "The rest: everything else 20 ms" in text


def test_nothing_is_said_where_a_dtype_was_not_timed() -> None:
    assert reach_sentence(OPERATORS, {"float16": 1}, {"int8": 100.0}) == []
    assert reach_sentence([], {"int8": 1}, {"int8": 100.0}) == []


def test_more_than_the_large_products_speed_is_explained():
    (text,) = reach_sentence(OPERATORS, {"int8": 40_000_000_000}, {"int8": 100.0})
    assert "More than all of it: other work slowed the large product down" in text
    (text,) = reach_sentence(OPERATORS, {"int8": 6_000_000_000}, {"int8": 100.0})
    assert "More than all of it" not in text
