"""Deployment to another machine: the store there changes, and nothing else is left there."""

import shutil
import sys
from pathlib import Path

import pytest
from _slots import bundle_of
from _ssh_server import Server, exports, serving, target, until

from vlatool.deployment.deploy import Conditions
from vlatool.deployment.pointer import read_pointer
from vlatool.deployment.signature import new_key, public_key, sign
from vlatool.errors import DeploymentError, SignatureError, TargetError
from vlatool.remote.deployment import change_on

pytestmark = pytest.mark.skipif(shutil.which("ssh") is None, reason="there is no ssh")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("server")) as found:
        yield found


@pytest.fixture
def home(server: Server, tmp_path: Path) -> Path:
    """The home of the user there."""
    home = tmp_path / "home"
    home.mkdir()
    server.session(exports(HOME=home, XDG_CACHE_HOME=home / "cache", XDG_DATA_HOME=home / "data", VLATOOL_STORE=""))
    return home


def change(server: Server, action: str, store: str = "", **options) -> dict:
    return change_on(target(), action, store, lambda _what, _share: None, python=sys.executable,
                     ssh_options=server.options(), **options)  # fmt: skip


def test_a_signed_bundle_goes_into_the_store_of_the_target(server, home, tmp_path):
    bundle = bundle_of(tmp_path / "one", 1)
    sign(bundle, new_key(tmp_path / "key").with_suffix(""), 3)
    conditions = Conditions(key=public_key(tmp_path / "key.pub"), runs=32)
    found = change(server, "deploy", bundle=bundle.path, conditions=conditions)
    assert found["store"] == str(home / "data/vlatool/store")
    assert read_pointer(home / "data/vlatool/store").current.release == 3
    assert found["slots"]["a"]["bundle"] == bundle.hash
    assert found["shadow"]["runs"] == 32
    assert change(server, "status")["slots"] == found["slots"]
    other = bundle_of(tmp_path / "two", 2)
    with pytest.raises(SignatureError, match="has no signature"):
        change(server, "deploy", bundle=other.path)
    until(lambda: not (home / "cache/vlatool").exists(), "the removal of what was sent")


def test_what_the_target_refuses_has_the_same_class(server, home, tmp_path):
    with pytest.raises(DeploymentError, match="holds no bundle"):
        change(server, "status", "~/elsewhere")
    with pytest.raises(TargetError, match="does not resolve"):
        change_on("nobody@nowhere.invalid", "status", "", lambda _what, _share: None, ssh_options=server.options())
