from __future__ import annotations

from pathlib import Path

import pytest

from vlatool.errors import ProfileError, RecipeError
from vlatool.yaml_files import read_mapping, read_yaml


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
        (b"", "The recipe must be a mapping; got NoneType."),
        (b"!!python/object/apply:os.system [ls]", "The recipe is not valid YAML: could not determine a constructor"),
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
