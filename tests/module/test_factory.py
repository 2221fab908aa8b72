import sys
from pathlib import Path

import pytest

from vlatool.errors import MissingExtra, SourceError
from vlatool.module.factory import call_factory, factory_file, import_factory, iterate_function, split_factory
from vlatool.stats.intervals import wilson


def write(folder: Path, text: str, name: str = "policy.py") -> Path:
    (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("factory", "parts"),
    [("policy.py:make", ("policy.py", "make")), ("a.b:make", ("a.b", "make")), ("C:/p.py:make", ("C:/p.py", "make"))],
)
def test_a_factory_is_a_place_and_a_function(factory, parts):
    assert split_factory(factory) == parts


@pytest.mark.parametrize("factory", ["", "policy.py:", ":make", "policy.py:make()", "policy.py:a.b"])
def test_what_is_no_factory(factory):
    with pytest.raises(SourceError, match="names no factory") as caught:
        split_factory(factory)
    assert "policy.py:make" in caught.value.fix


@pytest.mark.parametrize(
    ("named", "says", "fix"),
    [
        ("model.onnx", "is neither a Python function nor a file that is there", "put the file there"),
        ("original.py", "names a file but no function", "original.py:NAME"),
    ],
)
def test_what_a_person_meant_is_told(named: str, says: str, fix: str):
    with pytest.raises(SourceError, match=says) as caught:
        split_factory(named)
    assert fix in caught.value.fix


def test_only_the_file_form_has_a_file(tmp_path: Path):
    assert factory_file("sub/policy.py:make", tmp_path) == tmp_path / "sub/policy.py"
    assert factory_file("package.module:make", tmp_path) is None


def test_a_file_gives_its_function_and_takes_arguments(tmp_path: Path):
    write(tmp_path, "def make(layers=1, *, width=2):\n    return layers * width\n")
    assert call_factory("policy.py:make", tmp_path, {}) == 2
    assert call_factory("policy.py:make", tmp_path, {"layers": 3, "width": 5}) == 15


def test_a_module_gives_its_function(tmp_path: Path):
    assert import_factory("vlatool.stats.intervals:wilson", tmp_path) is wilson
    assert call_factory("vlatool.stats.intervals:wilson", tmp_path, {"successes": 3, "trials": 4}) == wilson(3, 4)


def test_a_file_may_import_its_neighbours_when_imported_and_when_called(tmp_path: Path):
    write(tmp_path, "VALUE = 7\n", "neighbour_one_of_test.py")
    write(tmp_path, "VALUE = 8\n", "neighbour_two_of_test.py")
    write(
        tmp_path,
        "from neighbour_one_of_test import VALUE\n"
        "def make():\n    import neighbour_two_of_test as two\n    return VALUE, two.VALUE\n",
    )
    before = list(sys.path)
    assert call_factory("policy.py:make", tmp_path, {}) == (7, 8)
    assert sys.path == before


def test_two_policies_with_files_of_the_same_name_are_two_modules(tmp_path: Path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        write(tmp_path / name, f"def make():\n    return {name!r}\n")
    assert [call_factory("policy.py:make", tmp_path / name, {}) for name in ("one", "two")] == ["one", "two"]


def test_a_file_that_changed_is_imported_again(tmp_path: Path):
    write(tmp_path, "def make():\n    return 'before the edit'\n")
    assert call_factory("policy.py:make", tmp_path, {}) == "before the edit"
    write(tmp_path, "def make():\n    return 'after'\n")
    assert call_factory("policy.py:make", tmp_path, {}) == "after"


def test_a_missing_file(tmp_path: Path):
    with pytest.raises(SourceError, match=r"No such file: .*policy.py \(from 'policy.py:make'\)"):
        import_factory("policy.py:make", tmp_path)


def test_a_missing_function_gets_the_nearest_one(tmp_path: Path):
    write(tmp_path, "def make(): ...\ndef _hidden(): ...\n")
    with pytest.raises(SourceError, match=r"no function 'mak'; did you mean 'make'\? known: make\."):
        import_factory("policy.py:mak", tmp_path)


def test_a_value_is_no_function(tmp_path: Path):
    write(tmp_path, "make = 3\n")
    with pytest.raises(SourceError, match="no function 'make'"):
        import_factory("policy.py:make", tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("raise RuntimeError('no weights here')", "failed: RuntimeError: no weights here"),
        ("def make(:", "failed: SyntaxError"),
        ("from json import no_such_name", "failed: ImportError"),
    ],
)
def test_an_import_that_fails(tmp_path: Path, text, message):
    write(tmp_path, text + "\n")
    with pytest.raises(SourceError, match=f"Importing 'policy.py' {message}"):
        import_factory("policy.py:make", tmp_path)


def test_an_import_that_failed_is_tried_again(tmp_path: Path):
    write(tmp_path, "raise RuntimeError\n")
    with pytest.raises(SourceError):
        import_factory("policy.py:make", tmp_path)
    write(tmp_path, "def make(): return 5\n")
    assert call_factory("policy.py:make", tmp_path, {}) == 5


@pytest.mark.parametrize(
    ("package", "fix"),
    [("no_such_package", "pip install no_such_package"), ("gymnasium", "pip install 'vlatool[sim]'")],
)
def test_a_missing_package_says_how_to_install_it(tmp_path: Path, monkeypatch, package, fix):
    monkeypatch.setitem(sys.modules, package, None)
    write(tmp_path, f"import {package}\ndef make(): ...\n")
    with pytest.raises(MissingExtra, match=f"needs the package '{package}', which is not installed") as caught:
        import_factory("policy.py:make", tmp_path)
    assert caught.value.fix == fix


def test_a_package_that_is_missed_only_when_called(tmp_path: Path):
    write(tmp_path, "def make():\n    import no_such_package.part\n")
    with pytest.raises(MissingExtra, match=r"'policy.py:make' needs the package 'no_such_package'") as caught:
        call_factory("policy.py:make", tmp_path, {})
    assert caught.value.fix == "pip install no_such_package"


def test_a_module_that_is_not_installed(tmp_path: Path):
    with pytest.raises(MissingExtra, match="'no_such_package'"):
        import_factory("no_such_package.policy:make", tmp_path)


def test_a_factory_that_raises(tmp_path: Path):
    write(tmp_path, "def make():\n    raise ValueError('the weights are for another robot')\n")
    with pytest.raises(SourceError, match=r"'policy.py:make' failed: ValueError: the weights are for another robot"):
        call_factory("policy.py:make", tmp_path, {})


def test_arguments_that_the_factory_does_not_take(tmp_path: Path):
    write(tmp_path, "def make(layers): ...\n")
    with pytest.raises(SourceError, match=r"failed: TypeError: .*width"):
        call_factory("policy.py:make", tmp_path, {"width": 3})


@pytest.mark.parametrize("where", ["import", "call"])
def test_our_own_errors_pass_through(tmp_path: Path, where):
    raising = "from vlatool.errors import DataError\n" + ("def make():\n    " if where == "call" else "")
    write(tmp_path, raising + "raise DataError('no episodes')\n")
    from vlatool.errors import DataError

    with pytest.raises(DataError, match="no episodes"):
        call_factory("policy.py:make", tmp_path, {})


@pytest.mark.parametrize(
    "factory", ["subprocess:check_output", "os:system", "builtins:eval", "importlib.util:find_spec"]
)
def test_a_function_of_the_standard_library_is_no_factory(tmp_path: Path, factory: str):
    with pytest.raises(SourceError, match="names a function of Python's standard library"):
        call_factory(factory, tmp_path, {})


def test_a_function_that_a_package_only_imports_is_not_its_factory(tmp_path: Path):
    with pytest.raises(SourceError, match=r"is defined in 'concurrent\.futures\.thread', not in the package 'vlatool'"):
        import_factory("vlatool.user_code.children:ThreadPoolExecutor", tmp_path)


@pytest.mark.parametrize(
    ("act", "says"),
    [
        ("import sys; sys.exit(0)", r"called sys.exit\(0\)"),
        ("class Stop(BaseException): ...\n    raise Stop('it')", "raised Stop: it"),
    ],
)
def test_what_is_no_exception_becomes_an_error(tmp_path: Path, act: str, says: str):
    write(tmp_path, f"def make():\n    {act}\n")
    with pytest.raises(SourceError, match=r"The factory 'policy.py:make' " + says):
        call_factory("policy.py:make", tmp_path, {})


def test_what_a_function_yields_is_gone_through_with_its_neighbours_at_hand(tmp_path: Path):
    write(tmp_path, "STEP = 2\n", "neighbour.py")
    write(tmp_path, "def count(end):\n    from neighbour import STEP\n    yield from range(0, end, STEP)\n")
    before = list(sys.path)
    values = iterate_function("policy.py:count", tmp_path, {"end": 5})
    assert next(values) == 0
    assert sys.path == before, "between two values nothing is different"
    assert list(values) == [2, 4]
    write(tmp_path, "def listed():\n    return [3, 4]\n")
    assert list(iterate_function("policy.py:listed", tmp_path, {})) == [3, 4]


@pytest.mark.parametrize(("body", "says"), [
    ("return 3", "'policy.py:count' gives a value of type int; it must yield"),
    ("return None", "'policy.py:count' gives a value of type NoneType"),
    ("raise ValueError('no data')\n    yield", "'policy.py:count' failed: ValueError: no data"),
    ("yield 1\n    raise ValueError('worn out')", "'policy.py:count' failed: ValueError: worn out"),
    ("yield 1\n    import sys; sys.exit(0)", r"'policy.py:count' called sys.exit\(0\)"),
])  # fmt: skip
def test_a_function_that_does_not_yield_is_told(tmp_path: Path, body: str, says: str):
    write(tmp_path, f"def count():\n    {body}\n")
    with pytest.raises(SourceError, match=says):
        list(iterate_function("policy.py:count", tmp_path, {}))


def test_a_value_that_is_not_asked_for_ends_nothing(tmp_path: Path):
    write(tmp_path, "def count():\n    while True:\n        yield 1\n")
    values = iterate_function("policy.py:count", tmp_path, {})
    assert [next(values), next(values)] == [1, 1]
    values.close()


def test_a_package_that_is_missed_when_a_value_is_made(tmp_path: Path):
    write(tmp_path, "def count():\n    import no_such_package\n    yield 1\n")
    with pytest.raises(MissingExtra, match=r"'policy\.py:count' needs the package 'no_such_package'"):
        list(iterate_function("policy.py:count", tmp_path, {}))
