"""The identity of the policy that a row of a report is about."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from vlatool.bundle.bundle import Bundle
from vlatool.measures import tables
from vlatool.report import Row
from vlatool.runtime.identity import policy_identity


def with_identity(row: Row, bundle: Bundle) -> Row:
    """Return a row with the identity of its policy, and the hash of its bundle, among its details."""
    return rows_with_identity([row], bundle)[0]


def rows_with_identity(rows: Iterable[Row], bundle: Bundle) -> tuple[Row, ...]:
    """Return rows that are all about one policy, as ``with_identity`` does."""
    record = {"identity": policy_identity(bundle), "bundle": bundle.hash}
    return tuple(replace(row, details={**row.details, tables.IDENTITY: [record]}) for row in rows)
