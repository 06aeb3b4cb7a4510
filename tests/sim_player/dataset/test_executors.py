"""Worker processes of this machine and an interrupt of the process that waits for them."""

from __future__ import annotations

import math
import os
import signal
import threading
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any

import pytest

from sim_player.dataset.executors import map_jobs

JOBS = 40


@pytest.mark.parametrize("moment", ["submit", "shutdown"])
def test_an_interrupt_inside_of_the_pool_waits_until_it_is_left(monkeypatch: pytest.MonkeyPatch, moment: str) -> None:
    """It comes with the third job, or while the pool closes: the step is completed, then it is raised.

    Raised within, it would leave locks held that the pool needs to close.
    """
    steps: list[str] = []
    submit, shutdown = ProcessPoolExecutor.submit, ProcessPoolExecutor.shutdown

    def noted_submit(pool: ProcessPoolExecutor, *job: Any) -> Future[Any]:
        if len(steps) == 2 and moment == "submit":
            os.kill(os.getpid(), signal.SIGINT)
        steps.append("submit")
        return submit(pool, *job)

    def noted_shutdown(pool: ProcessPoolExecutor, **options: Any) -> None:
        if moment == "shutdown":
            os.kill(os.getpid(), signal.SIGINT)
        shutdown(pool, **options)
        steps.append("shutdown")

    # a thread that takes signals when the main thread does not
    is_over = threading.Event()
    threading.Thread(target=is_over.wait).start()
    monkeypatch.setattr(ProcessPoolExecutor, "submit", noted_submit)
    monkeypatch.setattr(ProcessPoolExecutor, "shutdown", noted_shutdown)
    # a process of the background ignores it
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            list(map_jobs(math.sqrt, range(JOBS), workers=2))
    finally:
        is_over.set()
        signal.signal(signal.SIGINT, before)
    assert steps[:JOBS] == ["submit"] * JOBS
    assert steps[JOBS:] == ["shutdown"]
