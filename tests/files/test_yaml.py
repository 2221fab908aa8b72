from __future__ import annotations

import os
import tracemalloc
from pathlib import Path

import pytest

from vlatool.errors import ProfileError, RecipeError
from vlatool.files.yaml import read_mapping, read_yaml


def test_what_a_file_holds_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("{a: [1, é]}", encoding="utf-8")
    assert read_mapping(tmp_path / "a.yaml", "It", RecipeError) == {"a": [1, "é"]}
    (tmp_path / "b.yaml").write_text("- 1")
    assert read_yaml(tmp_path / "b.yaml", "It", RecipeError) == [1]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"{a: [", "The recipe is not valid YAML: "),
        (b"a: 2024-02-30", "The recipe is not valid YAML: day is out of range"),
        (b"\xff\xfe\x00", "The recipe is not valid YAML: it cannot be read as UTF-8"),
        (b"- 1", "The recipe must be a mapping; got list."),
        (b"", "The recipe is empty; it must be a mapping."),
        (
            b"!!python/object/apply:os.system [ls]",
            "The recipe has a value of the kind 'tag:yaml.org,2002:python",
        ),
        (b"a: !!binary aGk=", "The recipe has a value of the kind 'tag:yaml.org,2002:binary' (line 1)"),
        (b"a: !!set {x}", "The recipe has a value of the kind"),
        (b"a: !mine {x: 1}", "The recipe has a value of the kind '!mine'"),
        (b"a: 1\nb: 2\na: 3", "The recipe has the key 'a' twice (line 3)"),
        (b"x:\n  a: 1\n  'a': 3", "The recipe has the key 'a' twice (line 3)"),
        (b"a: &a [*a]", "The recipe has an alias inside the value it refers to"),
        (b"a: &a\n  <<: *a", "The recipe has an alias inside the value it refers to"),
        (b"a: *b", "The recipe is not valid YAML: found undefined alias"),
        (b"? [a, b]\n: 1", "The recipe is not valid YAML: "),
        (b"? {a: b}\n: 1", "The recipe is not valid YAML: "),
        (b"1: 2", "The recipe has the key '1', a int; keys are names."),
        (b"0: 2", "The recipe has the key '0', a int; keys are names."),
        (b"a: 1\n---\nb: 2", "The recipe is not valid YAML: "),
        (b"a: " + b"9" * 5000, "The recipe has a whole number of more than 4,300 digits."),
        (b"a: !!int x", "The recipe is not valid YAML: "),
        (b"a: !!float ''", "The recipe is not valid YAML: "),
        (b"a: !!bool x", "The recipe is not valid YAML: "),
        (b"a: !!timestamp x", "The recipe is not valid YAML: "),
        (b"a: !!null [x]", "The recipe is not valid YAML: "),
        (b"a: \x00", "The recipe is not valid YAML: "),
        (b"[" * 100_000, "The recipe has 65 levels; the limit 'yaml_depth' allows 64."),
        (b"a: " + b"{b: " * 100 + b"}" * 100, "The recipe has 65 levels; the limit 'yaml_depth' allows 64."),
        (b"a: " + b"x" * 300_000, "The recipe has 300003 bytes; the limit 'yaml_bytes' allows 262144."),
        (None, "The recipe cannot be read: No such file or directory."),
    ],
)
def test_what_is_wrong_is_said_in_the_class_of_the_caller(tmp_path: Path, content: bytes | None, says: str) -> None:
    path = tmp_path / "a.yaml"
    if content is not None:
        path.write_bytes(content)
    for raised in (RecipeError, ProfileError):
        with pytest.raises(raised) as caught:
            read_mapping(path, "The recipe", raised)
        assert caught.value.message.startswith(says)
        assert "\n" not in caught.value.message


LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 9)}]\n" for level in range(1, 10)
)
MERGES = "a0: &a0 {k: v}\n" + "".join(
    f"a{level}: &a{level} {{<<: [{', '.join([f'*a{level - 1}'] * 9)}]}}\n" for level in range(1, 10)
)


@pytest.mark.parametrize("text", [LAUGHS, MERGES], ids=["aliases", "merge keys"])
def test_aliases_are_counted_as_what_they_stand_for(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    tracemalloc.start()
    try:
        with pytest.raises(RecipeError, match="the limit 'yaml_nodes' allows 50000") as caught:
            read_mapping(tmp_path / "a.yaml", "The recipe", RecipeError)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
    assert "VLATOOL_LIMITS=yaml_nodes=" in caught.value.fix


def test_aliases_within_the_limit_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: &a {x: 1, y: 2}\nb: *a\nc: {<<: *a, y: 3}")
    found = read_mapping(tmp_path / "a.yaml", "It", RecipeError)
    assert found == {"a": {"x": 1, "y": 2}, "b": {"x": 1, "y": 2}, "c": {"x": 1, "y": 3}}


def test_a_pipe_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.yaml")
    with pytest.raises(RecipeError, match="it is not a regular file"):
        read_mapping(tmp_path / "a.yaml", "It", RecipeError)


def test_a_file_that_changes_is_read_again_and_what_is_read_is_the_callers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("{a: [1, 2]}")
    read_mapping(path, "It", RecipeError)["a"].append(3)
    assert read_mapping(path, "It", RecipeError) == {"a": [1, 2]}
    path.write_text("{a: [4, 2]}")
    os.utime(path, (0, 0))
    assert read_mapping(path, "It", RecipeError) == {"a": [4, 2]}
    monkeypatch.setenv("VLATOOL_LIMITS", "yaml_nodes=2")
    with pytest.raises(RecipeError, match="yaml_nodes"):
        read_mapping(path, "It", RecipeError)
