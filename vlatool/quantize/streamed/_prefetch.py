"""Compute records ahead in several processes, and yield them in order."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any, cast

from vlatool import errors
from vlatool.machine.processes import SINGLE, python_command
from vlatool.quantize.streamed.records import Record, Tools, compute_record
from vlatool.quantize.streamed.tensor_jobs import Job


class Prefetcher:
    """Iterator over (record, figures) in order, each after it was written to the file.

    Args:
        records: All records of the file.
        start: Index of the first record to compute.
        processes: Number of worker processes; with 0 each record is computed here on demand.
    """

    def __init__(self, records: list[Record], start: int, file: Path, processes: int) -> None:
        self._offset = sum(record.size for record in records[:start])
        self._records, self._file, self._tools = records[start:], file, Tools()
        self._idle: queue.SimpleQueue[Worker] = queue.SimpleQueue()
        self._workers = [Worker() for _ in range(processes)]
        for worker in self._workers:
            self._idle.put(worker)
        self._threads = ThreadPoolExecutor(max(processes, 1), "record")

    def __enter__(self) -> Prefetcher:
        return self

    def __exit__(self, *_exception: object) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)
        for worker in self._workers:
            worker.stop()
        self._threads.shutdown(wait=True)
        self._tools.reader.close()

    def __iter__(self) -> Iterator[tuple[Record, dict[str, Any]]]:
        pending: deque[tuple[Record, int, Future[dict[str, Any]] | None]] = deque()
        records, offset, capacity = iter(self._records), self._offset, 2 * len(self._workers) + 1
        while True:
            for record in records:
                pending.append((record, offset, self._submit(record, offset)))
                offset += record.size
                if len(pending) >= capacity:
                    break
            if not pending:
                return
            record, record_offset, future = pending.popleft()
            here = (record.fill, record.size, self._file, record_offset, self._tools)
            yield record, future.result() if future else compute_record(*here)

    def _submit(self, record: Record, offset: int) -> Future[dict[str, Any]] | None:
        if not (self._workers and record.portable):
            return None
        return self._threads.submit(self._send, record, offset)

    def _send(self, record: Record, offset: int) -> dict[str, Any]:
        worker = self._idle.get()
        try:
            return worker.compute(record, self._file, offset)
        finally:
            self._idle.put(worker)


class Worker:
    """A process that computes one record at a time."""

    def __init__(self) -> None:
        command, pipe = python_command("vlatool.quantize.streamed._worker"), subprocess.PIPE
        self._process = subprocess.Popen(command, env={**os.environ, **SINGLE}, stdin=pipe, stdout=pipe, text=True)
        self._requests, self._replies = cast(IO[str], self._process.stdin), cast(IO[str], self._process.stdout)

    def compute(self, record: Record, file: Path, offset: int) -> dict[str, Any]:
        """Compute and write a record in the process; return its figures.

        Raises:
            OSError: when the disk is full.
            VlatoolError: what the record raises, or GraphError when the process died.
        """
        request = {"job": cast(Job, record.fill).to_json(), "size": record.size, "file": str(file), "offset": offset}
        line = ""
        with contextlib.suppress(BrokenPipeError, ValueError):
            self._requests.write(json.dumps(request) + "\n")
            self._requests.flush()
            line = self._replies.readline()
        if not line:
            raise errors.GraphError(
                f"The process that quantized '{record.name}' died (exit {self._process.poll()}).",
                "it may have run out of memory; run the same command again, finished tensors are kept",
            )
        reply: dict[str, Any] = json.loads(line)
        if "note" in reply:
            figures: dict[str, Any] = reply["note"]
            return figures
        if "errno" in reply:
            raise OSError(reply["errno"], reply["message"], str(file))
        if reply["error"] == "MemoryError":
            raise MemoryError(reply["message"])
        raise getattr(errors, reply["error"])(reply["message"], reply["fix"])

    def stop(self) -> None:
        """Kill the process and discard its work."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._requests, self._replies):
            with contextlib.suppress(OSError):
                pipe.close()
