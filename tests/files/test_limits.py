import pytest

from vlatool.errors import BundleError, UsageError
from vlatool.files.limits import LIMITS, check_limit, limit


def test_a_limit_is_its_default_until_the_environment_says_otherwise(monkeypatch):
    monkeypatch.delenv("VLATOOL_LIMITS", raising=False)
    assert limit("files") == LIMITS["files"].default
    monkeypatch.setenv("VLATOOL_LIMITS", "files=12, golden_bytes=1e9")
    assert (limit("files"), limit("golden_bytes"), limit("steps")) == (12, 10**9, LIMITS["steps"].default)


@pytest.mark.parametrize("told", ["file=3", "files", "files=", "files=many", "files=-1", "files=nan", "files=1e400"])
def test_a_malformed_variable_is_told(monkeypatch, told):
    monkeypatch.setenv("VLATOOL_LIMITS", told)
    with pytest.raises(UsageError, match=r"VLATOOL_LIMITS (names|sets)"):
        limit("files")


def test_more_than_allowed_names_the_limit_and_how_to_raise_it(monkeypatch):
    monkeypatch.setenv("VLATOOL_LIMITS", "files=2")
    check_limit("files", 2, "The bundle", BundleError)
    with pytest.raises(BundleError, match=r"The bundle has 3 files; the limit 'files' allows 2") as caught:
        check_limit("files", 3, "The bundle", BundleError)
    assert "VLATOOL_LIMITS=files=3" in caught.value.fix


def test_a_number_of_thousands_of_digits_is_told():
    with pytest.raises(BundleError, match=r"more than 2\^33"):
        check_limit("repeat", 10**10000, "The step", BundleError)
