import sys
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import pytest

from tests._raised import made, made_in
from vlatool import errors
from vlatool.errors import MissingExtra, VlatoolError, fix_for, require, suggest

EXIT_CODES = {
    "VlatoolError": 70,
    "UsageError": 2,
    "InputError": 3,
    "BundleError": 3,
    "SpecError": 3,
    "SourceError": 3,
    "DataError": 3,
    "GraphError": 3,
    "DeadlineMissed": 3,
    "AnomalyAlarm": 3,
    "ProfileError": 3,
    "RecipeError": 3,
    "OutputError": 3,
    "TargetError": 3,
    "InstallationError": 3,
    "DeploymentError": 3,
    "ServingError": 3,
    "BusError": 3,
    "SignatureError": 3,
    "PluginError": 3,
    "MissingExtra": 4,
    "GateFailed": 1,
    "Inconclusive": 5,
    "FallsShort": 5,
}
CLASSES = [value for value in vars(errors).values() if isinstance(value, type) and issubclass(value, VlatoolError)]


def test_every_error_has_the_exit_code_that_the_tree_draws():
    assert {kind.__name__: kind.exit_code for kind in CLASSES} == EXIT_CODES
    for name in EXIT_CODES:
        assert name in (errors.__doc__ or "")


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_an_error_crosses_a_process_border_whole(kind):
    again = ForkingPickler.loads(ForkingPickler.dumps(kind("it broke", "mend it")))
    assert type(again) is kind
    assert (again.message, again.fix) == ("it broke", "mend it")
    assert str(again) == "it broke\n  fix: mend it"


def test_an_error_without_a_fix_is_its_message():
    assert str(VlatoolError("it broke")) == "it broke"


def test_an_error_without_a_fix_of_its_own_has_that_of_its_class():
    assert errors.BundleError("it is half").fix == errors.BundleError.remedy != ""
    assert errors.BundleError("it is half", "mend it").fix == "mend it"


def test_every_error_says_what_to_do():
    found = list(made())
    assert len(found) > 700
    assert [each.where for each in found if each.without_remedy] == []


@pytest.mark.parametrize(
    ("source", "without"),
    [
        ('raise DataError("it broke")', True),
        ('raise DataError("it broke", "mend it")', False),
        ('raise DataError("it broke", fix="")', True),
        ('raise errors.DataError("it broke", FIX)', False),
        ('raise BundleError("it broke")', False),
        ('raise DataError("it broke", "mend it" if broken else "")', True),
        ('raise DataError("it broke", remedy_of(error) or "mend it")', False),
        ('fix = ""\nraise DataError("it broke", fix)', True),
        ('def remedy(x):\n    return "mend it" if x else ""\nraise DataError("it broke", remedy(1))', True),
        ('def broken(error: type[InputError]):\n    return error("it broke")', True),
        ('def broken(error: type[BundleError]):\n    return error("it broke")', False),
        ('class Lost(DataError):\n    pass\nraise Lost("it broke")', True),
        ('raise type(error)(error.message)', True),
        ('from vlatool.module.failures import remedy_for\nraise DataError("it broke", remedy_for(error))', True),
    ],
)  # fmt: skip
def test_an_error_without_a_remedy_is_found(source, without):
    (only,) = made_in(source, "here.py")
    assert only.without_remedy is without


def test_instead_names_what_is_near_or_says_what_there_is():
    assert fix_for("proprioo", ["image", "proprio"]) == "write 'proprio'"
    assert fix_for("xyz", ["proprio"]) == "write 'proprio'"
    assert fix_for("xyz", ["proprio", "image"]) == "choose one of those that are known"
    assert fix_for("xyz", []) == "leave it out: there is nothing to choose from"


def test_nearest_puts_the_likely_name_first():
    assert suggest("proprioo", ["image", "proprio"]) == "did you mean 'proprio'? known: image, proprio"


def test_nearest_lists_what_is_known_when_nothing_is_near():
    assert suggest("xyz", ["proprio", "image"]) == "known: image, proprio"
    assert suggest("xyz", []) == "known: none"


def test_require_gives_the_module():
    assert require("json.decoder", "build") is sys.modules["json.decoder"]


def test_require_names_the_extra_of_a_missing_package():
    with pytest.raises(MissingExtra, match=r"'no_such_package'.*'build'") as caught:
        require("no_such_package.part", "build")
    assert caught.value.fix == "pip install 'vlatool[build]'"


def test_require_tells_a_missing_dependency_from_a_missing_package(tmp_path: Path, monkeypatch):
    (tmp_path / "half_installed_thing.py").write_text("import its_absent_dependency\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingExtra, match="'half_installed_thing' is installed, but 'its_absent_dependency'"):
        require("half_installed_thing", "text")


@pytest.mark.parametrize(
    ("line", "why"),
    [("raise ImportError('lib.so: failed to map segment from shared object')", "lib.so: failed to map segment"),
     ("raise ImportError('libc.so.6: version GLIBC_2.34 not found')", "GLIBC_2.34"),
     ("from json import nothing", "cannot import name 'nothing' from 'json'"),
     ("raise RuntimeError('compiled against another ABI')", "compiled against another ABI"),
     ("raise ImportError", "ImportError"),
     ("raise ImportError('IMPORTANT: read\\n\\nOriginal error was: no')", "error was: no")],
)  # fmt: skip
def test_require_says_why_an_installed_package_cannot_be_imported(line: str, why: str, tmp_path: Path, monkeypatch):
    monkeypatch.delitem(sys.modules, "damaged_thing", raising=False)
    (tmp_path / "damaged_thing.py").write_text(f"{line}\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingExtra, match="'damaged_thing' is installed, but cannot be imported: ") as caught:
        require("damaged_thing", "text")
    assert why in str(caught.value)
    assert "damaged" in str(caught.value.fix)
