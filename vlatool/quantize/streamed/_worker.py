"""``python -m vlatool.quantize.streamed._worker``: computes records for a parent process, one JSON line for each.

Processes and not threads: the arithmetic is many short operations, between which threads would wait for the GIL.
"""

from __future__ import annotations

import contextlib
import json
import sys
from pathlib import Path
from typing import IO, Any

from vlatool import errors
from vlatool.quantize.streamed.records import Tools, compute_record
from vlatool.quantize.streamed.tensor_jobs import Job


def serve(requests: IO[str], replies: IO[str]) -> None:
    """Answer until the requests end, which they also do when the parent is killed."""
    tools = Tools()
    with contextlib.suppress(BrokenPipeError):  # nobody waits for the answer any more
        for line in requests:
            replies.write(json.dumps(_answer(json.loads(line), tools)) + "\n")
            replies.flush()


def _answer(request: dict[str, Any], tools: Tools) -> dict[str, Any]:
    """Return the figures, or a description of the error."""
    try:
        job = Job.from_json(request["job"])
        return {"note": compute_record(job, request["size"], Path(request["file"]), request["offset"], tools)}
    except errors.VlatoolError as error:
        return {"error": type(error).__name__, "message": error.message, "fix": error.fix}
    except OSError as error:
        return {"errno": error.errno, "message": error.strerror}
    except MemoryError:
        return {"error": "MemoryError", "message": "a worker is out of memory", "fix": ""}


if __name__ == "__main__":
    serve(sys.stdin, sys.stdout)
