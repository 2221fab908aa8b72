"""Every message of every process goes through JSON and comes back as it was, and what is no such message is refused."""

from __future__ import annotations

import importlib
import json
import math
import random
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

import pytest

from vlatool.errors import SpecError
from vlatool.files.messages import Number, field_values, from_json, to_json

ROUNDS = 40
MODULES = (
    "vlatool.episodes.play", "vlatool.measurement.agreement", "vlatool.measurement.child",
    "vlatool.measurement.cold_start", "vlatool.measurement.jobs", "vlatool.measurement.results",
    "vlatool.measurement.pairs", "vlatool.optimize.pipeline", "vlatool.remote._validate_replies",
    "vlatool.workers._remote_worker",
)  # fmt: skip
"""Where messages are defined; what they are made of is followed from there."""
NO_MESSAGES = {"_Call", "Proposals"}


def messages() -> list[type]:
    kinds = [kind for name in MODULES for kind in vars(importlib.import_module(name)).values()
             if isinstance(kind, type) and is_dataclass(kind) and kind.__module__ == name]  # fmt: skip
    return [kind for kind in kinds if kind.__name__ not in NO_MESSAGES]


def drawn(kind: Any, random: random.Random) -> Any:
    """Return an object of a type, of any size and any value that the type has."""
    origin, inside = get_origin(kind), get_args(kind)
    if is_dataclass(kind):
        types = get_type_hints(kind)
        kept = [field for field in fields(kind) if _needed(field) or random.random() < 0.7]
        return kind(**{field.name: drawn(types[field.name], random) for field in kept})
    if NoneType in inside:
        (other,) = (each for each in inside if each is not NoneType)
        return None if random.random() < 0.3 else drawn(other, random)
    if origin is tuple:
        kinds = inside if inside[-1] is not ... else inside[:1] * random.randrange(4)
        return tuple(drawn(each, random) for each in kinds)
    if origin in (dict, Mapping):
        return {drawn(str, random): drawn(inside[1], random) for _ in range(random.randrange(4))}
    values = {
        str: lambda: "".join(random.choices('aß"\\\n\u202e \U0001f600', k=random.randrange(5))),
        int: lambda: random.randrange(-(2**62), 2**62),
        float: lambda: random.choice([0.0, -1.5, 1e-300, 1e300, random.random()]),
        bool: lambda: random.random() < 0.5,
        Any: lambda: random.choice([None, "x", [1, {"a": []}], {"b": 1.5}]),
    }
    return values[kind]()


def _needed(field: Any) -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def there_and_back(message: Any) -> Any:
    return from_json(type(message), json.loads(json.dumps(to_json(message), allow_nan=False)))


@pytest.mark.parametrize("kind", messages(), ids=lambda kind: kind.__name__)
def test_a_message_comes_back_as_it_was(kind):
    seeded = random.Random(kind.__name__)
    for _ in range(ROUNDS):
        message = drawn(kind, seeded)
        assert there_and_back(message) == message
        assert hash(kind) is not None
        assert kind.__dataclass_params__.frozen


def test_every_process_is_covered():
    names = {kind.__name__ for kind in messages()}
    assert {"LatencyJob", "Benchmark", "PairJob", "Pairs", "Agreement", "ColdStart", "Request", "Played"} <= names


def whole() -> dict[str, Any]:
    from vlatool.measurement.jobs import LatencyJob, Limits

    value: dict[str, Any] = to_json(LatencyJob(("a",), limits=Limits((1,), 2, 3.5)))
    return value


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"bundles": "a"}, "'message.bundles' is 'a', not a list"),
        ({"bundles": [1]}, r"'message.bundles\[0\]' is 1, not text"),
        ({"threads": 1.5}, "'message.threads' is 1.5, not a whole number"),
        ({"threads": True}, "'message.threads' is True, not a whole number"),
        ({"duration": "1"}, "'message.duration' is '1', not a number"),
        ({"duration": True}, "'message.duration' is True, not a number"),
        ({"duration": 10**400}, "'message' has a number that is too large"),
        ({"check": 1}, "'message.check' is 1, not true or false"),
        ({"engine": None}, "'message.engine' is None, not text"),
        ({"limits": []}, r"'message.limits' is \[\], not a mapping"),
        ({"limits": {"cpu": [1]}}, "'message.limits' has the unknown field 'cpu'"),
    ],
)
def test_what_is_not_of_its_type_is_refused_by_name(change, reason):
    from vlatool.measurement.jobs import LatencyJob

    assert from_json(LatencyJob, whole()).limits.memory_mb == 3.5
    with pytest.raises(ValueError, match=reason):
        from_json(LatencyJob, whole() | change)


def test_what_is_missing_is_named_and_what_has_a_default_may_be():
    from vlatool.measurement.jobs import ColdStartJob

    value = {"bundle": "a", "engine": "", "threads": 1, "begun_ns": 5}
    assert from_json(ColdStartJob, value) == ColdStartJob("a", "", 1, 5)
    del value["threads"]
    with pytest.raises(ValueError, match="'message' lacks 'threads'"):
        from_json(ColdStartJob, value)


def test_a_tuple_of_other_lengths_is_refused():
    with pytest.raises(ValueError, match="'pair' has 3 values, not 2"):
        from_json(tuple[int, str], [1, "a", 2], "pair")
    assert from_json(tuple[float, ...], [1, 2.5]) == (1.0, 2.5)
    with pytest.raises(ValueError, match=r"'series\[1\]' is None, not a number"):
        from_json(tuple[float, ...], [1, None], "series")


@dataclass(frozen=True)
class Inner:
    name: str
    axes: tuple[int | str, ...] = ()


@dataclass(frozen=True)
class Outer:
    inner: tuple[Inner, ...]
    unit: str | tuple[str, ...] = ""
    file: Path | None = None
    values: dict[str, list[Number]] = field(default_factory=dict)
    scale: Number = 1.0


def test_what_has_its_default_is_left_out_where_asked_at_any_depth():
    outer = Outer((Inner("a"), Inner("", (1, "n"))), scale=2.0)
    assert to_json(outer, defaults=False) == {"inner": [{"name": "a"}, {"name": "", "axes": [1, "n"]}], "scale": 2.0}
    assert to_json(Outer(())) == {"inner": [], "unit": "", "file": None, "values": {}, "scale": 1.0}
    assert to_json(Outer((), values={}), defaults=False) == {"inner": []}


def test_a_path_is_text():
    outer = Outer((), file=Path("a/b"))
    assert to_json(outer, defaults=False) == {"inner": [], "file": "a/b"}
    assert from_json(Outer, {"inner": [], "file": "a/b"}) == outer
    with pytest.raises(ValueError, match=r"'message\.file' is 3, not text"):
        from_json(Outer, {"inner": [], "file": 3})


def test_null_is_nan_for_a_number_of_a_report_and_a_whole_number_stays_one():
    read = from_json(Outer, {"inner": [], "scale": 3, "values": {"a": [1, 2.5], "b": [1, None]}})
    assert (type(read.scale), read.values["a"], type(read.values["a"])) == (int, [1, 2.5], list)
    assert math.isnan(read.values["b"][1])
    assert math.isnan(from_json(Outer, {"inner": [], "scale": None}).scale)
    for wrong in ("1", True, [1]):
        with pytest.raises(ValueError, match=r"'report\.scale' is .*, not a number"):
            from_json(Outer, {"inner": [], "scale": wrong}, "report")
    with pytest.raises(ValueError, match=r"'report\.values\.a' is 1\.5, not a list"):
        from_json(Outer, {"inner": [], "values": {"a": 1.5}}, "report")


def test_a_dataclass_that_checks_itself_gets_tuples_for_lists_and_no_unknown_field():
    values = field_values(Outer, {"inner": [1], "unit": ["m", "s"], "values": {"a": [1]}}, "The spec", SpecError)
    assert values == {"inner": (1,), "unit": ("m", "s"), "values": {"a": [1]}}
    assert field_values(Outer, {"unit": "m"}, "The spec", SpecError) == {"unit": "m"}
    with pytest.raises(SpecError, match="The spec has the unknown key 'units'; did you mean 'unit'"):
        field_values(Outer, {"units": "m"}, "The spec", SpecError)
    with pytest.raises(SpecError, match="The spec must be a mapping; got 3"):
        field_values(Outer, 3, "The spec", SpecError)
