"""Maps of any policy as they are typed: names, and a file that is read as strictly as JSON."""

from __future__ import annotations

import pytest

from vlatool.errors import DataError, UsageError
from vlatool.nodes.map_file import read_map, split_maps


@pytest.mark.parametrize("name", ["map.yaml", "map.json"])
def test_a_map_is_read_from_yaml_and_json(tmp_path, name):
    path = tmp_path / name
    path.write_text('{"inputs": {"a": {"topic": "/a"}}}')
    assert read_map(path) == {"inputs": {"a": {"topic": "/a"}}}
    assert split_maps([str(path), "scan=/front"], takes_file=True) == ({"scan": "/front"}, {"map": read_map(path)})


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("map.yaml", "output: {topic: /a}\noutput: {topic: /b}\n", "twice"),
        ("map.json", '{"output": 1, "output": 2}', "occurs twice"),
        ("map.yaml", "", "is empty"),
        ("map.yaml", "[1]", "must be a mapping"),
        ("map.yaml", "a: &a [x, x]\nb: &b [*a, *a]\n" + "".join(f"c{n}: [*b, *b]\n" for n in range(100_000)), "bytes"),
        ("map.yaml", "a: !!python/object/apply:os.system [x]", "only plain values"),
        ("map.yaml", "\x00", "not valid YAML"),
        ("map.json", "[1]", "is not a mapping"),
    ],
    ids=["twice", "twice in JSON", "empty", "list", "large", "code", "zero", "list in JSON"],
)
def test_a_map_that_is_none_is_refused(tmp_path, name, text, words):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(DataError, match=words):
        read_map(path)


@pytest.mark.parametrize("words", [["scan"], ["scan=/a", "scan=/b"], ["=/a"], ["scan="]])
def test_words_that_map_nothing_are_refused(words):
    with pytest.raises(UsageError):
        split_maps(words, takes_file=False)
