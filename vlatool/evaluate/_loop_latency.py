"""The latency of a bundle's actions in the control loop: that of an inference, here or on a board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import median

from vlatool.bundle.bundle import Bundle
from vlatool.episodes.play import EpisodesJob
from vlatool.errors import DataError
from vlatool.files.resumable_work import Store
from vlatool.hardware.profile import load_profile
from vlatool.latency_model.predict import predictions
from vlatool.measurement import agent
from vlatool.measurement.jobs import LatencyJob
from vlatool.measures.latency import LATENCY_IN_THE_LOOP
from vlatool.report import Measurement
from vlatool.stage.base import Context

CALLS, SECONDS = 50, 2.0
"""Least calls, and seconds, of the measurement of each bundle."""


def loop_latency(bundle: Bundle, board: str, engine: str, context: Context, store: Store | None = None) -> Measurement:
    """Return how long an inference takes.

    Args:
        board: Profile that it is predicted for; measured on this machine with one thread when empty.
        engine: Engine of the runtime; the bundle's own when empty.
        store: Latencies of an interrupted run, and of this one; none are stored when None.

    Raises:
        ProfileError: when there is no such board.
        DataError: when it cannot be predicted.
    """
    if board:
        latency = predictions(load_profile(board), bundle, engine)[0]
        if not latency.known:
            raise DataError(f"The latency on {board} cannot be predicted: {latency.note}.", "name another board")
        return LATENCY_IN_THE_LOOP.relabel(latency)
    calls = _calls(bundle, engine, context, store)
    return LATENCY_IN_THE_LOOP.measurement(median(calls), samples=len(calls), note="median, one thread")


def _calls(bundle: Bundle, engine: str, context: Context, store: Store | None) -> Sequence[float]:
    """Measure the latencies of calls in ms; a run that was interrupted goes on with those that it had measured."""
    key = f"latency of {bundle.hash} in {engine or 'its engine'}"
    known = store.get(key) if store else None
    if isinstance(known, list) and known and all(isinstance(call, float) and call > 0 for call in known):
        return known
    job = LatencyJob((str(bundle.path.absolute()),), engine, 1, CALLS, SECONDS, check=False)
    calls = agent.measure(job, context.progress).policies[0].samples
    if store:
        store.put(key, list(calls))
    return calls


def with_latency(jobs: list[EpisodesJob], latency: Measurement | None) -> list[EpisodesJob]:
    """Return the jobs with a latency of their actions; as they are when None."""
    return jobs if latency is None else [replace(job, latency_ms=latency.value) for job in jobs]
