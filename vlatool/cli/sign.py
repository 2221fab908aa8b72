"""``vlatool sign``."""

from __future__ import annotations

import os
import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from vlatool.bundle.bundle import Bundle
from vlatool.cli import _complete
from vlatool.cli._document import answer
from vlatool.cli._options import AsJson
from vlatool.errors import OutputError, UsageError


def sign(
    bundle: Annotated[
        Path | None, typer.Argument(help="a bundle", show_default=False, autocompletion=_complete.bundles)
    ] = None,
    key: Annotated[Path | None, typer.Option(help="private key (PEM, Ed25519)")] = None,
    release: Annotated[
        int | None,
        typer.Option(min=1, max=2**53 - 1, help="number that grows with each release; seconds since 1970 if unset"),
    ] = None,
    new_key: Annotated[
        Path | None,
        typer.Option("--new-key", help="make a key: this file, for you alone, and its public key in FILE.pub"),
    ] = None,
    openssf: Annotated[
        Path | None,
        typer.Option(help="write an OpenSSF model signature to this file instead; the key is ECDSA, P-256 to P-521"),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace a signature that exists")] = False,
    as_json: AsJson = False,
) -> None:
    """Sign a bundle with Ed25519: every file of it, and the number of its release."""
    from vlatool.deployment import signature

    if openssf is not None and (bundle is None or release is not None):
        raise UsageError("--openssf signs a BUNDLE, and that format has no release number.",
                         "write: vlatool sign BUNDLE --key KEY --openssf FILE")  # fmt: skip
    if (new_key is None) == (bundle is None) or (key is None) != (bundle is None):
        given = {"BUNDLE": bundle, "--key": key, "--new-key": new_key}
        names = [name for name, value in given.items() if value is not None]
        raise UsageError(f"Got {' and '.join(names) or 'no arguments'}; allowed: BUNDLE and --key, or --new-key alone.",
                         "write: vlatool sign BUNDLE --key KEY; or: vlatool sign --new-key KEY")  # fmt: skip
    if bundle is None or key is None:
        _answer_key(as_json, signature.new_key(Path(new_key or "")), signature)
        return
    opened = Bundle.open(bundle)
    if openssf is not None:
        _sign_openssf(as_json, opened, key, openssf, force)
        return
    if not force and (bundle / signature.SIGNATURE).exists():
        raise OutputError(f"{bundle} is signed already.", "pass --force to sign it again")
    made = signature.sign(opened, key, release or time.time_ns() // 10**9)
    line = f"{bundle}: release {made.release} signed with the key {made.key[:16]}"
    answer(as_json, {**asdict(made), "path": str(bundle / signature.SIGNATURE)}, [line])


def _sign_openssf(as_json: bool, bundle: Bundle, key: Path, output: Path, force: bool) -> None:
    from vlatool.deployment import openssf

    if not force and os.path.lexists(output):
        raise OutputError(f"{output} exists already.", "pass --force to replace it")
    public = openssf.sign(bundle, key, output)
    line = f"{output}: OpenSSF signature of {bundle.path} with the key {public[:16]}"
    answer(as_json, {"path": str(output), "bundle": bundle.hash, "key": public}, [line])


def _answer_key(as_json: bool, public: Path, module: Any) -> None:
    number = module.public_key(public)
    private = str(public).removesuffix(module.PUBLIC_SUFFIX)
    lines = [f"{private}: private key, for you alone", f"{public}: public key {number[:16]}"]
    answer(as_json, {"private": private, "public": str(public), "key": number}, lines)
