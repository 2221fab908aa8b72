from pathlib import Path

import pytest

import vlatool
from vlatool import registry
from vlatool.errors import UsageError

ROOT = Path(vlatool.__file__).parent


@pytest.fixture
def kind(tmp_path: Path, monkeypatch):
    """A function that adds a folder of entries to the vlatool package for one test, and gives its name."""
    monkeypatch.setattr(vlatool, "__path__", [*vlatool.__path__, str(tmp_path)])

    def add(name: str, **files: str) -> str:
        folder = tmp_path / name
        folder.mkdir()
        (folder / "__init__.py").touch()
        for stem, text in files.items():
            (folder / f"{stem}.py").write_text(text)
        return name

    return add


@pytest.mark.parametrize("kind_of_files", ["quantize", "sources", "export", "data"])
def test_the_names_of_a_kind_are_its_files(kind_of_files):
    files = {path.stem for path in (ROOT / kind_of_files).glob("*.py") if not path.stem.startswith("_")}
    assert registry.names(kind_of_files) == sorted(files)


def test_engines_live_in_the_runtime():
    assert "ort_cpu" in registry.names("engines")
    assert registry.load("engines", "ort_cpu").__name__ == "OrtCpuSession"


def test_files_with_an_underscore_are_no_entries(kind):
    assert registry.names(kind("gadgets_a", _shared="", lamp="")) == ["lamp"]


def test_sub_packages_are_not_entries(kind, tmp_path):
    name = kind("gadgets_parts", lamp="")
    (tmp_path / name / "parts").mkdir()
    (tmp_path / name / "parts/__init__.py").touch()
    assert registry.names(name) == ["lamp"]


def test_listing_imports_nothing(kind):
    assert registry.names(kind("gadgets_b", broken="raise RuntimeError")) == ["broken"]


def test_an_unknown_kind_has_no_names():
    assert registry.names("no_such_kind") == []


def test_a_plain_module_has_no_names():
    assert registry.names("errors") == []


def test_a_wrong_name_gets_the_nearest_one():
    with pytest.raises(UsageError, match="Unknown quantization method 'static_in8'; did you mean 'static_int8'"):
        registry.load("quantize", "static_in8")


def test_a_shared_file_cannot_be_loaded():
    with pytest.raises(UsageError, match="Unknown quantization method '_graphs'"):
        registry.load("quantize", "_graphs")


def test_dashes_stand_for_underscores():
    assert registry.load("quantize", "static-int8") is registry.load("quantize", "static_int8")


def test_the_entry_is_the_one_public_class(kind):
    name = kind("gadgets_c", lamp="from pathlib import Path\nclass _Wire: ...\nclass Lamp: ...\n")
    assert registry.load(name, "lamp").__name__ == "Lamp"


@pytest.mark.parametrize("text", ["", "class A: ...\nclass B: ...\n"])
def test_a_file_without_one_public_class_is_a_fault(kind, text):
    name = kind(f"gadgets_d{len(text)}", lamp=text)
    with pytest.raises(TypeError, match=f"exactly one public class, it defines {text.count('class')}"):
        registry.load(name, "lamp")
