"""Domains of Cyclone DDS: one for each number and process, shared by the buses on it, and what it warns of."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import re
import threading
from collections.abc import Callable, Iterator
from typing import Any

from vlatool.buses._names import domain_id
from vlatool.errors import BusError, UsageError, require

CONFIG = "CYCLONEDDS_URI"
"""Environment variable with the user's settings of Cyclone DDS; what the address says comes after them."""
REFUSAL = re.compile(r"deserialization (\S+)/([^\s/]+) failed")
"""Warning of Cyclone DDS about a malformed message: topic and type."""
_LOCK = threading.Lock()
_DOMAINS: dict[int, SharedDomain] = {}


def parse_address(address: str) -> tuple[int, str]:
    """Return domain and interface of an address such as ``0``, ``0@127.0.0.1`` or ``@eth0``; empty where left out.

    Raises:
        UsageError: for an impossible domain or interface.
    """
    number, _, interface = address.partition("@")
    if not re.fullmatch(r"[\w.:-]*", interface) or address.endswith("@"):
        raise UsageError(
            f"'{address}' is not an address of DDS: a domain, and an interface behind '@' if DDS shall use that alone.",
            "write dds:0, or dds:0@127.0.0.1 for this machine alone",
        )
    return domain_id(number), interface


def settings(interface: str, log: str) -> str:
    """Return settings in XML for an interface, by name or by IP address, and a file for warnings."""
    parts = [f"<Tracing><Verbosity>warning</Verbosity><OutputFile>{log}</OutputFile></Tracing>"]
    if interface:
        local = interface in ("lo", "localhost") or _is_loopback(interface)
        named = "name" if _ip(interface) is None else "address"
        value = "127.0.0.1" if interface == "localhost" else interface
        named = "address" if interface == "localhost" else named
        multicast = ' multicast="false"' if local else ""
        parts.append(f'<General><Interfaces><NetworkInterface {named}="{value}"{multicast}/></Interfaces></General>')
    if interface and local:
        parts.append(
            "<General><AllowMulticast>false</AllowMulticast><MaxMessageSize>32000B</MaxMessageSize>"
            "<FragmentSize>31000B</FragmentSize></General>"
        )
        parts.append(
            "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>63</MaxAutoParticipantIndex>"
            '<Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
        )
    return ",".join(filter(None, [os.environ.get(CONFIG, ""), *parts]))


class SharedDomain:
    """A domain in this process, and a thread that reads its warnings.

    Args:
        number: Its number.
        interface: Interface that it uses alone; empty for those that Cyclone DDS chooses.
    """

    def __init__(self, number: int, interface: str) -> None:
        self.interface = interface
        self.users: list[Callable[[str, str], None]] = []
        self._listening = False
        core, domains = require("cyclonedds.core", "dds"), require("cyclonedds.domain", "dds")
        reading, writing = os.pipe()
        try:
            self._domain: Any = domains.Domain(number, settings(interface, f"/proc/self/fd/{writing}"))
            self._listening = True
        except core.DDSException as error:
            if error.code != core.DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:  # else other code opened the domain
                os.close(reading)
                raise _refused(number, interface, error) from error
        finally:
            os.close(writing)
        if not self._listening:
            os.close(reading)
            return
        threading.Thread(target=self._read, args=(reading,), name="vlatool dds warnings", daemon=True).start()

    def close(self) -> None:
        """Delete the domain, which ends the thread."""
        if self._listening:
            self._domain.__del__()

    def _read(self, reading: int) -> None:
        with open(reading, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                if found := REFUSAL.search(line):
                    for user in tuple(self.users):
                        user(*found.groups())


@contextlib.contextmanager
def _locked() -> Iterator[dict[int, SharedDomain]]:
    with _LOCK:
        yield _DOMAINS


def join_domain(number: int, interface: str, refused: Callable[[str, str], None]) -> Callable[[], None]:
    """Open a domain in this process, or share the one that is open, and return what leaves it.

    Args:
        number: Its number.
        interface: Interface to use alone; empty for those that Cyclone DDS chooses.
        refused: Called with topic and type, as on the wire, of each malformed message.

    Raises:
        MissingExtra: when cyclonedds is absent.
        BusError: when the interface cannot be used, or the domain is open on another one.
    """
    with _locked() as domains:
        shared = domains.get(number) or SharedDomain(number, interface)
        if shared.interface != interface:
            raise BusError(
                f"Domain {number} is open in this process on '{shared.interface or 'all interfaces'}', not on "
                f"'{interface or 'all interfaces'}'.",
                "open all buses of a process with one address, or choose another domain",
            )
        domains[number] = shared
        shared.users.append(refused)

    def leave() -> None:
        with _locked() as open_domains:
            shared.users.remove(refused)
            if not shared.users:
                del open_domains[number]
                shared.close()

    return leave


def _ip(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(text)
    return None


def _is_loopback(text: str) -> bool:
    address = _ip(text)
    return address is not None and address.is_loopback


def _refused(number: int, interface: str, error: Exception) -> BusError:
    where = f" on '{interface}'" if interface else ""
    return BusError(
        f"DDS cannot open domain {number}{where}: {error}",
        f"check that the interface is up (ip address), and the settings in {CONFIG}",
    )
