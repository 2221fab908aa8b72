"""``deploy``, ``status``, ``rollback``, ``sign`` and ``verify-signature`` as typed: one whole way, and its refusals."""

import json
import shutil
import stat

import pytest
from _slots import OBSERVATION, bundle_of, install
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from vlatool.bundle.bundle import Bundle
from vlatool.cli import main
from vlatool.deployment.slot_policy import SlotPolicy
from vlatool.deployment.store import Store


@pytest.fixture
def run(capsys):
    def command(*words: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as left:
            main([str(word) for word in words])
        said = capsys.readouterr()
        return int(left.value.code or 0), said.out, said.err

    return command


def test_from_a_key_to_a_rollback(run, tmp_path):
    one, two = bundle_of(tmp_path / "one", 1, "1.0.0"), bundle_of(tmp_path / "two", 2, "1.1.0")
    key, store = tmp_path / "key", tmp_path / "store"
    assert run("sign", "--new-key", key)[0] == 0
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    for release, bundle in enumerate((one, two), 1):
        assert run("sign", bundle.path, "--key", key, "--release", release)[0] == 0
    code, out, _ = run("verify-signature", two.path, "--key", f"{key}.pub", "--json")
    assert (code, json.loads(out)["release"]) == (0, 2)
    code, out, err = run("deploy", one.path, "--store", store, "--key", f"{key}.pub", "--runs", 32)
    assert code == 0, err
    assert "slot a is active\n" in out
    assert "shadow run     32 inferences" in out
    trial = ("--trial-ticks", 2, "--trial-seconds", 0)
    code, out, err = run("deploy", two.path, "--store", store, "--runs", 32, *trial, "--json")
    assert code == 0, err
    assert json.loads(out)["slots"]["b"]["release"] == 2
    with SlotPolicy(store) as policy:
        assert [policy.infer(OBSERVATION).chunk[0, 0] for _ in range(3)] == [2.0] * 3
    assert "slot b is active\n" in run("status", "--store", store)[1]
    code, out, _ = run("rollback", "--store", store)
    assert (code, "slot a is active" in out, "last rollback  an operator" in out) == (0, True, True)
    code, _, err = run("deploy", two.path, "--store", store, "--latency-ms", 1e-6)
    assert (code, "fails its shadow run" in err) == (1, True)
    assert "slot a is active\n" in run("status", "--store", store)[1]


def test_signing_twice_needs_force(run, tmp_path):
    bundle = bundle_of(tmp_path / "one", 1)
    run("sign", "--new-key", tmp_path / "key")
    assert run("sign", bundle.path, "--key", tmp_path / "key")[0] == 0
    assert run("sign", bundle.path, "--key", tmp_path / "key")[0] == 3
    assert run("sign", bundle.path, "--key", tmp_path / "key", "--force")[0] == 0


def test_a_signature_for_other_tools_is_a_file_beside_the_bundle(run, tmp_path):
    bundle, key = bundle_of(tmp_path / "one", 1), tmp_path / "key"
    text = serialization
    private = ec.generate_private_key(ec.SECP256R1())
    key.write_bytes(private.private_bytes(text.Encoding.PEM, text.PrivateFormat.PKCS8, text.NoEncryption()))
    key.chmod(0o600)
    command = ("sign", bundle.path, "--key", key, "--openssf", tmp_path / "one.sig")
    code, out, _ = run(*command, "--json")
    assert (code, json.loads(out)["path"]) == (0, str(tmp_path / "one.sig"))
    assert json.loads((tmp_path / "one.sig").read_text())["dsseEnvelope"]
    code, _, err = run(*command)
    assert (code, "exists already" in err) == (3, True)
    assert run(*command, "--force")[0] == 0
    assert run(*command, "--release", 1)[0] == 2
    assert run("sign", "--new-key", tmp_path / "own", "--openssf", tmp_path / "x")[0] == 2


@pytest.mark.parametrize(("words", "code", "said"), [
    (["sign"], 2, "Got no arguments; allowed: BUNDLE and --key"), (["sign", "BUNDLE"], 2, "Got BUNDLE; allowed"),
    (["sign", "BUNDLE", "--key", "k", "--new-key", "n"], 2, "Got BUNDLE and --key and --new-key; allowed"),
    (["sign", "--key", "k"], 2, "Got --key; allowed"),
    (["sign", "BUNDLE", "--key", "none"], 3, "cannot be read"), (["sign", "none", "--key", "none"], 3, "No bundle at"),
    (["verify-signature", "BUNDLE", "--key", "none"], 3, "cannot be read"),
    (["deploy", "none", "--store", "STORE"], 3, "No bundle at"), (["status", "--store", "STORE"], 3, "holds no bundle"),
    (["rollback", "--store", "STORE"], 3, "There is no store"),
    (["status", "--store", "STORE", "--remote-python", "p"], 2, "Python of a robot"),
    (["deploy", "BUNDLE", "--store", "STORE", "--recording", "none"], 3, "No recording at"),
    (["status", "-oProxyCommand=x"], 2, ""),
])  # fmt: skip
def test_what_cannot_be_done(run, tmp_path, monkeypatch, words, code, said):
    monkeypatch.chdir(tmp_path)
    bundle_of(tmp_path / "BUNDLE", 1)
    left, _, err = run(*words)
    assert left == code, err
    assert said in err
    assert "Traceback" not in err


def test_a_damaged_active_bundle_is_shown_and_told_by_the_exit_code(run, tmp_path):
    store = Store(tmp_path / "store")
    install(store, bundle_of(tmp_path / "one", 1))
    (store.folder("a") / "graphs/main.onnx").write_bytes(b"x")
    code, out, err = run("status", "--store", store.path)
    assert code == 3
    assert "DAMAGED" in out
    assert "The active bundle is damaged" in err


def test_a_signature_of_changed_files_is_refused(run, tmp_path):
    bundle = bundle_of(tmp_path / "one", 1)
    run("sign", "--new-key", tmp_path / "key")
    run("sign", bundle.path, "--key", tmp_path / "key")
    other = bundle_of(tmp_path / "other", 2)
    shutil.copy(bundle.path / "SIGNATURE", other.path)
    code, _, err = run("verify-signature", other.path, "--key", tmp_path / "key.pub")
    assert (code, "of another bundle" in err) == (3, True)
    assert Bundle.open(other.path).hash != bundle.hash
