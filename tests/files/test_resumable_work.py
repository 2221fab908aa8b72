"""Unfinished work is one run's at a time, whoever removes it meanwhile."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from vlatool.files.resumable_work import LOCK, remove_work, work_directory


def test_a_run_that_waited_for_work_that_was_removed_still_keeps_others_out(tmp_path: Path) -> None:
    place, inside, go = tmp_path / "streams" / "a", list[str](), threading.Event()

    def run(name: str) -> None:
        with work_directory(place):
            inside.append(name)
            go.wait(10)
            inside.append(f"{name} is done")

    with work_directory(place):
        second = threading.Thread(target=run, args=("second",))
        second.start()
        time.sleep(0.1)  # it waits
        assert inside == []
        remove_work(place)
    while not inside:
        time.sleep(0.01)
    assert (place / LOCK).is_file(), "what it works in is there"
    third = threading.Thread(target=run, args=("third",))
    third.start()
    third.join(0.2)
    assert inside == ["second"]
    go.set()
    second.join()
    third.join()
    assert inside == ["second", "second is done", "third", "third is done"]
