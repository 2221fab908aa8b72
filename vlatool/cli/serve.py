"""``vlatool serve``."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vlatool.cli._document import answer
from vlatool.cli._options import AsJson, BundleEngine, BundlePath, Threads
from vlatool.cli._signals import stopped_by_signals
from vlatool.errors import DataError, UsageError
from vlatool.files.printable import one_line, printable

if TYPE_CHECKING:
    from vlatool.runtime import Policy
    from vlatool.serving import Access, Endpoint, RequestLog, Service

MAX_KEY_BYTES = 4096
UNKNOWN_RATE_MS = 60_000.0
ClientNames = Annotated[
    list[str] | None,
    typer.Option(
        "--map", metavar="INPUT=NAME", help="name that clients use for an input, where it differs; also a part or "
        "several parts: state=qpos[0:7]+gripper",
    ),
]  # fmt: skip


def serve(
    bundle: BundlePath,
    protocol: Annotated[str, typer.Option(help="openpi, gr00t or lerobot, or several with commas between")] = "openpi",
    host: Annotated[str, typer.Option(help="address; another one than this machine's own needs --key")] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="port, 0 for a free one; the usual one of the protocol when not given"),
    ] = None,
    key: Annotated[
        Path | None, typer.Option(help="file with the key that clients have to send", show_default=False)
    ] = None,
    map: ClientNames = None,
    robot: Annotated[str, typer.Option(help="robot whose limits no chunk leaves; none when not given")] = "",
    deadline_ms: Annotated[
        float | None,
        typer.Option(
            "--deadline-ms",
            help="ms in which a request is answered, or refused; the time in which the "
            "actions of a chunk are played when not given",
        ),
    ] = None,
    execute: Annotated[
        int, typer.Option(min=0, help="actions of a chunk that clients play before they ask again; 0: as in the spec")
    ] = 0,
    clients: Annotated[int, typer.Option(min=1, max=1000, help="clients at a time")] = 8,
    records: Annotated[
        Path | None, typer.Option(help="file to which a JSON line is added for each request", show_default=False)
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0, help="end after so many seconds; at a signal when not given")
    ] = None,
    engine: BundleEngine = "",
    threads: Threads = None,
    seed: Annotated[int | None, typer.Option(min=0, help="seed of the noise; a new one when not given")] = None,
    as_json: AsJson = False,
) -> None:
    """Serve a bundle to programs that speak openpi's, GR00T's or LeRobot's protocol, until Ctrl-C or SIGTERM.

    Each client has an episode of its own. An answer that would come after the deadline is refused instead.
    """
    from vlatool.data import mapped_names
    from vlatool.runtime import load
    from vlatool.serving import Access, RequestLog, Service

    names, access = mapped_names(map or []), Access(host, "" if key is None else key_of(key))
    chosen = _protocols(protocol, port)
    policy = load(bundle, engine=engine, threads=threads, seed=seed)
    log = RequestLog(records)
    limit_ms = play_ms(policy, execute) if deadline_ms is None else deadline_ms
    service = Service(policy, deadline_ms=limit_ms, names=names, execute=execute, robot=robot, clients=clients,
                      telemetry=log)  # fmt: skip
    began = time.monotonic()
    try:
        addresses = _serve(service, access, chosen, seconds, as_json)
    finally:
        service.close()
        log.close()
    found = {
        "bundle": str(bundle),
        "addresses": addresses,
        "seconds": time.monotonic() - began,
        **_counts(service, log),
    }
    answer(as_json, found, _lines(found))


def _counts(service: Service, log: RequestLog) -> dict[str, Any]:
    """Return what became of the requests."""
    return {
        "requests": service.requests, "missed": service.missed, "failed": service.failed, "times": log.times_ms(),
        "lost_records": log.lost_count + service.failed_records,
    }  # fmt: skip


def _protocols(text: str, port: int | None) -> dict[str, int]:
    """Return the protocols that were named, each with its port; raises UsageError for an unknown one."""
    from vlatool import registry

    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names or len(set(names)) < len(names) or (len(names) > 1 and port):
        raise UsageError(f"The protocols are '{text}'{f' at one port, {port}' if port else ''}.",
                         "name each once, and a port for one alone: --protocol openpi --port 8000")  # fmt: skip
    kinds: dict[str, Any] = {name: registry.load("serving", name) for name in names}
    return {name: kind.default_port if port is None else port for name, kind in kinds.items()}


def key_of(path: Path) -> str:
    """Return the first line of a file; raises DataError when it cannot be read, or is empty."""
    try:
        with path.open(encoding="ascii") as stream:
            key = stream.read(MAX_KEY_BYTES).strip().partition("\n")[0].strip()
        reason = "" if key else "it is empty"
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not ASCII"
    if reason:
        raise DataError(f"The key in {path} cannot be read: {reason}.", "name a file with the key in one line")
    return key


def play_ms(policy: Policy, execute: int) -> float:
    """Return the time in which the actions of a chunk are played, in milliseconds; a minute at an unknown rate."""
    spec = policy.spec
    steps = execute or spec.execute or spec.chunk
    return 1000 * steps / spec.control_hz if spec.control_hz else UNKNOWN_RATE_MS


def _serve(
    service: Service, access: Access, chosen: dict[str, int], seconds: float | None, as_json: bool
) -> dict[str, str]:
    """Serve until a signal, a client or the time ends it; returns protocol -> address."""
    from vlatool import registry
    from vlatool.runtime.stack import prepare_process

    stop = threading.Event()
    started: list[Endpoint] = []
    addresses: dict[str, str] = {}
    with stopped_by_signals(stop.set):
        try:
            for name, port in chosen.items():
                kind: Any = registry.load("serving", name)
                endpoint: Endpoint = kind(service, access, port, stop.set)
                addresses[name] = endpoint.start()
                started.append(endpoint)
            prepare_process()
            for name, address in addresses.items():
                typer.echo(f"{name}: {address}", err=as_json)
            stop.wait(seconds)
        finally:
            for endpoint in started:
                endpoint.close()
    return addresses


def _lines(found: dict[str, Any]) -> Sequence[str]:
    times = "".join(f", {name} {value:.2f} ms" for name, value in found["times"].items())
    what = f"{found['requests']} requests, {found['missed']} without an action in time, {found['failed']} refused"
    lost = f"; {found['lost_records']} records were not written" if found["lost_records"] else ""
    return [printable(one_line(f"{what}{times}{lost}"))]
