"""Write one large file record by record; a run that was killed is continued by the next one.

The place of every record is known before the first is computed. Processes compute and write records ahead; in order,
each is then read back and hashed, and a journal notes it with the SHA-256 of the data up to its end. The next run of
the same plan checks the finished records and goes on after them, and gives the same bytes.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vlatool.errors import OutputError
from vlatool.machine.host import cache_directory
from vlatool.quantize.streamed._journal import DATA, Journal, hash_part
from vlatool.quantize.streamed._prefetch import Ahead
from vlatool.quantize.streamed.records import Record
from vlatool.weights.shards import reading

if TYPE_CHECKING:
    from vlatool.stage.base import Tell

COMMIT_BYTES = 1 << 28
"""Bytes after which data and journal are flushed to the disk."""
FULL = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "a file would be larger than the limit on file sizes",
}


@dataclass(frozen=True)
class Written:
    """The finished file.

    Args:
        path: Where it is, in the work directory.
        sha256: Of the file, as hex.
        bytes: Its size.
        notes: What each record's ``fill`` returned.
        resumed: Records that an earlier run had finished.
    """

    path: Path
    sha256: str
    bytes: int
    notes: list[dict[str, Any]]
    resumed: int


def work_root() -> Path:
    """Return where unfinished work is kept: ``streams`` in vlatool's cache directory."""
    return cache_directory() / "streams"


def write_records(records: list[Record], plan: str, place: Path, processes: int, tell: Tell) -> Written:
    """Write all records to ``place/data``, continuing what an earlier run of the same plan left.

    Args:
        records: What to write, in order.
        plan: Identifies everything that the bytes depend on; work of another plan is thrown away.
        place: A locked work directory.
        processes: Processes that compute; with 0 everything happens here, in order.
        tell: Told each record and the share of the parameters that is done.

    Raises:
        OutputError: when the disk is full; finished records are kept.
        VlatoolError: what a record's ``fill`` raises.
    """
    data, journal = place / DATA, Journal(place, plan)
    digest, notes = journal.resume(records)
    resumed = len(notes)
    offset = sum(record.size for record in records[:resumed])
    total = sum(record.weights for record in records) or 1
    done, unflushed = sum(record.weights for record in records[:resumed]), 0
    try:
        with reading() as reader, Ahead(records, resumed, data, processes) as ahead:
            for record, note in ahead:
                hash_part(reader, data, offset, record.size, digest)
                journal.add(note, digest.hexdigest())
                notes.append(note)
                offset += record.size
                unflushed += record.size
                done += record.weights
                tell(f"{record.verb} {record.name}", done / total)
                if unflushed >= COMMIT_BYTES:
                    journal.flush()
                    unflushed = 0
        journal.flush()
    except OSError as error:
        if error.errno not in FULL:
            raise
        kept = f"{len(notes)} of {len(records)} parts are finished and kept"
        fix = "free some space (or set VLATOOL_CACHE to a larger disk) and run the same command again"
        raise OutputError(f"Cannot write {place}: {FULL[error.errno]}; {kept}.", fix) from error
    finally:
        journal.close()
    return Written(data, digest.hexdigest(), offset, notes, resumed)
