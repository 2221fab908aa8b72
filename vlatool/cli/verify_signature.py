"""``vlatool verify-signature``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from vlatool.bundle.bundle import Bundle
from vlatool.cli._document import answer
from vlatool.cli._options import AsJson, BundlePath


def verify_signature(
    bundle: BundlePath,
    key: Annotated[list[Path], typer.Option(help="public key (PEM) that is trusted; may be given several times")],
    as_json: AsJson = False,
) -> None:
    """Verify every file in the manifest of a bundle, and that one of the keys signed it; reports are not part of it."""
    from vlatool.deployment.signature import SIGNATURE, public_key, verify

    found = verify(Bundle.open(bundle), [public_key(path) for path in key])
    line = f"{bundle}: every file in its manifest is what was signed, release {found.release}, key {found.key[:16]}"
    answer(as_json, {**asdict(found), "path": str(bundle / SIGNATURE)}, [line])
