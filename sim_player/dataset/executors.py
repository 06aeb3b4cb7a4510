"""Executors of jobs: processes of this machine, a Ray cluster, a Slurm cluster, behind one function.

Workers of a cluster need the project and the jobs' folder at the same place (a shared file system).
"""

from __future__ import annotations

import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Literal, TypeVar, get_args

Job = TypeVar("Job")
Result = TypeVar("Result")
Executor = Literal["local", "ray", "slurm"]
EXECUTORS: tuple[Executor, ...] = get_args(Executor)
#: Slurm ends a job after this long; a shard takes minutes.
SLURM_MINUTES = 60
#: Signals of keyboard and terminal; an interrupt inside of a pool would leave its locks held.
HELD_BACK = (signal.SIGINT, signal.SIGHUP)


def map_jobs(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    executor: Executor = "local",
    workers: int = 1,
    scratch: Path | None = None,
    slurm: dict[str, Any] | None = None,
) -> Iterator[Result]:
    """Yield the results of `function`, defined at module level, over all jobs as they are done.

    workers: processes (of Slurm: tasks) at a time. scratch: a shared folder for Slurm's own files, deleted at the end.
    slurm: parameters of submitit by name; `cluster` = "local" or "debug" runs without Slurm. Raises the error of a job
    and cancels the rest; ValueError for no executor, worker or cluster; ImportError without its package.
    """
    if executor not in EXECUTORS:
        raise ValueError(f"executor must be one of {', '.join(EXECUTORS)}, got {executor!r}")
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers!r}")
    if executor == "ray":
        return _ray(function, jobs, workers)
    if executor == "slurm":
        return _slurm(function, jobs, workers, Path("slurm") if scratch is None else scratch, slurm or {})
    return map(function, jobs) if workers == 1 else _local(function, jobs, workers)


def _local(function: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Run the jobs in processes of this machine."""
    # fresh processes: a fork would copy the locks of threads it does not copy
    context = get_context("spawn")
    listener, lifeline = context.Pipe(duplex=False)
    done: SimpleQueue[Future[Result]] = SimpleQueue()
    # an interrupt inside of the pool would leave its locks held. Workers inherit the mask: the parent alone handles
    # keyboard and terminal signals, from their first moment on
    with _undisturbed():
        pool = ProcessPoolExecutor(workers, context, initializer=_follow, initargs=(listener,))
    try:
        # anew: the first lock of a process starts a tracker, which lets SIGINT through again
        with _undisturbed():
            futures = [pool.submit(function, job) for job in jobs]
            for future in futures:
                future.add_done_callback(done.put)
        for _ in futures:
            yield done.get().result()
    except BrokenExecutor:
        raise RuntimeError(
            "a worker process died (out of memory?); the same command goes on where it stopped"
        ) from None
    except BaseException:
        # an error or an interrupt does not wait for running jobs
        lifeline.close()
        raise
    finally:
        with _undisturbed():
            pool.shutdown(cancel_futures=True)
            lifeline.close()
            listener.close()


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Hold back the signals of keyboard and terminal, from this thread and from what is started meanwhile."""
    held: list[int] = []
    before = signal.pthread_sigmask(signal.SIG_BLOCK, HELD_BACK)
    # another thread may take the signal in place of this one: the interpreter then still calls the handler here
    is_main = threading.current_thread() is threading.main_thread()
    handlers = {number: signal.getsignal(number) for number in HELD_BACK} if is_main else {}
    for number in handlers:
        signal.signal(number, lambda number, _: held.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for came in held:
            signal.raise_signal(came)


def _follow(listener: Connection) -> None:
    """End this worker with its parent, however that ends."""

    def wait() -> None:
        try:
            listener.recv_bytes()
        except (EOFError, OSError):
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _ray(function: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Run the jobs on the Ray cluster of RAY_ADDRESS, else on a temporary one on this machine."""
    # Ray would report its use over the network
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError:
        raise ImportError('ray, which --executor ray needs: pip install "mirrorwave[cluster]"') from None
    is_started_here = not ray.is_initialized()
    if is_started_here:
        # join the existing cluster, or start one
        own = {} if "RAY_ADDRESS" in os.environ else {"num_cpus": workers, "include_dashboard": False}
        ray.init(configure_logging=False, log_to_driver=False, **own)
    try:
        remote = ray.remote(num_cpus=1, max_retries=3)(function)
        pending = [remote.remote(job) for job in jobs]
        while pending:
            ready, pending = ray.wait(pending)
            yield ray.get(ready[0])
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    finally:
        if is_started_here:
            ray.shutdown()


def _slurm(
    function: Callable[[Job], Result], jobs: Sequence[Job], workers: int, scratch: Path, slurm: dict[str, Any]
) -> Iterator[Result]:
    """Run the jobs as a job array of Slurm, one task a job."""
    try:
        import submitit
    except ImportError:
        raise ImportError('submitit, which --executor slurm needs: pip install "mirrorwave[cluster]"') from None
    options = {"timeout_min": SLURM_MINUTES, "cpus_per_task": 1, **slurm}
    cluster = options.pop("cluster", "slurm")
    if cluster == "slurm" and shutil.which("srun") is None:
        raise ValueError("executor slurm needs Slurm's commands on this machine, srun is not found")
    pool = submitit.AutoExecutor(folder=scratch, cluster=cluster)
    plain = ("timeout_min", "cpus_per_task")
    parameters = {key if key in plain else f"slurm_{key}": value for key, value in options.items()}
    pool.update_parameters(slurm_array_parallelism=workers, **parameters)
    tasks = pool.map_array(partial(_caught, function), jobs)
    try:
        for task in submitit.helpers.as_completed(tasks, poll_frequency=10.0 if cluster == "slurm" else 0.2):
            if task.exception() is not None:
                raise RuntimeError(f"job {task.job_id} died, its log is {task.paths.stderr}")
            result = task.result()
            if isinstance(result, (OSError, ValueError)):
                raise result
            yield result
    except BaseException:
        for task in tasks:
            task.cancel()
        raise
    shutil.rmtree(scratch, ignore_errors=True)


def _caught(function: Callable[[Job], Result], job: Job) -> Result | OSError | ValueError:
    """Return a result, or the error itself: a task that fails would send its traceback as text."""
    try:
        return function(job)
    except (OSError, ValueError) as error:
        return error
