"""Who may reach a server: loopback addresses alone, or who has the key."""

from __future__ import annotations

import hmac
import ipaddress
import socket
from dataclasses import dataclass, field

from vlatool.errors import UsageError

SCHEME = "Api-Key "
"""What stands before the key in a header, as openpi's client sends it."""
MIN_KEY_CHARACTERS = 16


@dataclass(frozen=True)
class Access:
    """An address to serve at, and the key that a client has to know.

    Args:
        host: Name or address; one of this machine.
        key: Empty where every program of this machine may use the policy.

    Raises:
        UsageError: when other machines can reach the address and there is no key, the key is short or not printable
            ASCII, or the name is unknown.
    """

    host: str = "127.0.0.1"
    key: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        if self.key and (len(self.key) < MIN_KEY_CHARACTERS or not self.key.isascii() or not self.key.isprintable()):
            raise UsageError(
                f"The key has {len(self.key)} characters; allowed: {MIN_KEY_CHARACTERS} or more, printable ASCII.",
                "make one: python3 -c 'import secrets; print(secrets.token_urlsafe(32))'",
            )
        if not self.key and not is_loopback(self.host):
            raise UsageError(
                f"Other machines can reach {self.host}, and there is no key: anybody could use the policy, and keep it "
                "busy while a robot waits.",
                "give a file with a key (--key FILE), or serve at 127.0.0.1 and reach it through ssh -L",
            )

    def admits(self, key: object) -> bool:
        """Return whether a client that sends a key may go on; takes equally long for every wrong key."""
        if not self.key:
            return True
        return isinstance(key, str) and hmac.compare_digest(key.encode("utf-8", "replace"), self.key.encode())

    def admits_header(self, header: str | None) -> bool:
        """Return whether a client with this ``Authorization`` header may go on."""
        known = header is not None and header.startswith(SCHEME)
        return self.admits(header[len(SCHEME) :] if known and header else "")


def is_loopback(host: str) -> bool:
    """Return whether programs of this machine alone reach an address, all of those that a name stands for.

    Raises:
        UsageError: for a name that nobody knows.

    Example:
        >>> is_loopback("127.0.0.1"), is_loopback("0.0.0.0")
        (True, False)
    """
    try:
        found = {str(entry[4][0]) for entry in socket.getaddrinfo(host or "0.0.0.0", None)}
    except (OSError, UnicodeError):
        raise UsageError(f"'{host[:80]}' is not an address of this machine.", "give one: --host 127.0.0.1") from None
    return all(ipaddress.ip_address(address.partition("%")[0]).is_loopback for address in found)
