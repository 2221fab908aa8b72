import sys
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import pytest

from vlatool import errors
from vlatool.errors import MissingExtra, VlatoolError, nearest, require

EXIT_CODES = {
    "VlatoolError": 70,
    "UsageError": 2,
    "InputError": 3,
    "BundleError": 3,
    "SpecError": 3,
    "SourceError": 3,
    "DataError": 3,
    "GraphError": 3,
    "ProfileError": 3,
    "RecipeError": 3,
    "OutputError": 3,
    "TargetError": 3,
    "InstallationError": 3,
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


def test_nearest_puts_the_likely_name_first():
    assert nearest("proprioo", ["image", "proprio"]) == "did you mean 'proprio'? known: image, proprio"


def test_nearest_lists_what_is_known_when_nothing_is_near():
    assert nearest("xyz", ["proprio", "image"]) == "known: image, proprio"
    assert nearest("xyz", []) == "known: none"


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
