"""Write one large file record by record; a killed run is resumed by the next one.

The offset of every record is known in advance. Processes compute and write records ahead; in order, each is then read
back and hashed, and a journal stores it with the SHA-256 of the data up to its end. The next run of the same plan
checks the finished records and continues after them; the bytes are the same.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlatool.errors import OutputError
from vlatool.quantize.streamed._journal import DATA, Journal, hash_part
from vlatool.quantize.streamed._prefetch import Prefetcher
from vlatool.quantize.streamed.records import Record
from vlatool.user_code.children import OnProgress
from vlatool.weights.shards import Reader

COMMIT_BYTES = 1 << 28
"""Bytes after which data and journal are flushed to the disk."""
DISK_FULL_ERRORS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "a file would be larger than the limit on file sizes",
}


@dataclass(frozen=True)
class RecordFile:
    """The finished file.

    Args:
        notes: Figures that each record's ``fill`` returned.
        resumed: Number of records that an earlier run had finished.
    """

    path: Path
    sha256: str
    bytes: int
    notes: list[dict[str, Any]]
    resumed: int


def write_records(records: list[Record], plan: str, directory: Path, processes: int, tell: OnProgress) -> RecordFile:
    """Write all records to ``directory/data``, resuming an earlier run of the same plan.

    Args:
        plan: Identifier of everything that the bytes depend on; work of another plan is discarded.
        directory: A locked work directory.
        processes: Number of worker processes; with 0 everything is computed here, in order.
        tell: Receiver of each record's name and the share of the parameters that is done.

    Raises:
        OutputError: when the disk is full; finished records are kept.
        VlatoolError: what a record's ``fill`` raises.
    """
    data, journal = directory / DATA, Journal(directory, plan)
    digest, notes = journal.resume(records)
    resumed = len(notes)
    offset = sum(record.size for record in records[:resumed])
    total = sum(record.weights for record in records) or 1
    done, unflushed = sum(record.weights for record in records[:resumed]), 0
    try:
        with Reader() as reader, Prefetcher(records, resumed, data, processes) as prefetcher:
            for record, note in prefetcher:
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
        if error.errno not in DISK_FULL_ERRORS:
            raise
        kept = f"{len(notes)} of {len(records)} parts are finished and kept"
        fix = "free some space (or set VLATOOL_CACHE to a larger disk) and run the same command again"
        raise OutputError(f"Cannot write {directory}: {DISK_FULL_ERRORS[error.errno]}; {kept}.", fix) from error
    finally:
        journal.close()
    return RecordFile(data, digest.hexdigest(), offset, notes, resumed)
