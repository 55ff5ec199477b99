"""Where trials run: in this process, in spawned processes, or on a Dask cluster. What they return is the same.

An outcome is a value: a trial that raised, or whose process died, is an outcome with an error, not an exception here.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, Literal

from threadpoolctl import threadpool_limits

from graphslam.core.cluster import connect_cluster
from graphslam.core.errors import ConfigError, GraphSlamError
from graphslam.core.extras import import_extra

Executor = Literal["serial", "processes", "dask"]
Call = Callable[[int], Iterable[Any]]


@dataclass(frozen=True, slots=True)
class Job:
    """One trial to run.

    Parameters
    ----------
    name : str
        What it is called in messages.
    trial : callable int → iterable
        Picklable by name for every executor but ``serial``.
    """

    name: str
    trial: Call
    seed: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a job.

    Parameters
    ----------
    values : tuple
        What the trial gave; empty if it failed.
    error : str or None
        ``type: message`` of the exception, or how its process died.
    details : str or None
        Traceback, where there is one.
    """

    job: Job
    values: tuple[Any, ...] = ()
    error: str | None = None
    details: str | None = None


_Result = tuple[tuple[Any, ...], str | None, str | None]


def attempt(trial: Call, seed: int, prepare: Callable[[], object] | None = None) -> _Result:
    """Run one trial to its end; ``(values, error, traceback)``. Runs wherever the executor wants it to."""
    try:
        if prepare is not None:
            prepare()
        return tuple(trial(seed)), None, None
    except Exception as error:
        return (), f"{type(error).__name__}: {error}", traceback.format_exc()


def execute(
    jobs: Sequence[Job],
    *,
    executor: Executor = "serial",
    workers: int | None = None,
    address: str | None = None,
    prepare: Callable[[], object] | None = None,
) -> Generator[Outcome, None, None]:
    """Run jobs; yield each outcome as soon as it is there, in whatever order that is.

    Closing the generator early ends the workers, and with them the trials they are at.

    Parameters
    ----------
    executor : {"serial", "processes", "dask"}
        ``processes`` are spawned, never forked: a forked child of a threaded library hangs or dies.
    workers : int, optional
        Number of processes; default the number of processors.
    address : str, optional
        Of the scheduler, for ``dask``.
    prepare : callable, optional
        Called before each trial in the process that runs it (e.g. to hold libraries to one thread).
    """
    if executor not in ("serial", "processes", "dask"):
        raise ConfigError(f"unknown executor {executor!r}; known: serial, processes, dask")
    if workers is not None and workers < 1:
        raise ConfigError(f"{workers} workers; wanted at least 1")
    if executor == "serial":
        return (Outcome(job, *attempt(job.trial, job.seed, prepare)) for job in jobs)
    for job in jobs:
        _check_picklable(job)
    if executor == "processes":
        return _processes(jobs, min(workers or multiprocessing.cpu_count(), max(len(jobs), 1)), prepare)
    if address is None:
        raise ConfigError("a Dask cluster needs its scheduler's address")
    return _dask(jobs, address, prepare)


def _check_picklable(job: Job) -> None:
    try:
        pickle.dumps(job.trial)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ConfigError(
            f"{job.name}: its function cannot be sent to another process ({error}); "
            "wanted a function of a module, or a partial of one"
        ) from None


# --- processes ---------------------------------------------------------------------------------------------------
# One pipe a worker, and one job a worker at a time: a worker that dies (memory, a crash in compiled code) names its
# job, and a worker whose parent was killed reads the end of its pipe and ends too.


def _serve(pipe: Connection) -> None:
    """Work of a spawned process: jobs in, results out, until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides what ends
    pipe.send("ready")
    while True:
        try:
            trial, seed, prepare = pipe.recv()
        except EOFError:
            return
        except Exception as error:  # the trial's module cannot be imported here
            result: _Result = ((), f"{type(error).__name__}: {error}", traceback.format_exc())
        else:
            result = attempt(trial, seed, prepare)
        try:
            pipe.send(result)
        except OSError:  # the parent is gone
            return
        except Exception as error:
            pipe.send(((), f"the trial's figures cannot be sent back ({error})", None))


@contextmanager
def _no_interrupt() -> Iterator[None]:
    """Ctrl-C waits, and is not heard at all by a process that is started meanwhile."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Worker:
    """A spawned process and our end of its pipe."""

    def __init__(self, context: Any) -> None:
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with _no_interrupt():
            self.process.start()
        theirs.close()  # else the end of the pipe would never be read
        self.ready = False
        self.job: Job | None = None

    def give(self, job: Job, prepare: Callable[[], object] | None) -> None:
        self.job = job
        self.pipe.send((job.trial, job.seed, prepare))

    def death(self) -> str:
        self.process.join()
        code = self.process.exitcode
        return f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"

    def end(self) -> None:
        self.pipe.close()
        self.process.terminate()
        self.process.join()


def _processes(jobs: Sequence[Job], count: int, prepare: Callable[[], object] | None) -> Generator[Outcome, None, None]:
    context = multiprocessing.get_context("spawn")
    waiting = deque(jobs)
    workers: list[_Worker] = []
    try:
        workers += [_Worker(context) for _ in range(count if jobs else 0)]
        while workers:
            # wait() is typed for any waitable; ours are pipes
            for pipe in wait([w.pipe for w in workers]):
                worker = next(w for w in workers if w.pipe is pipe)
                try:
                    message = worker.pipe.recv()
                except (EOFError, OSError):
                    workers.remove(worker)
                    death = worker.death()
                    if not worker.ready:
                        raise GraphSlamError(
                            f"a worker process ended before it could work ({death}); "
                            "a script that starts workers needs its work under if __name__ == '__main__'"
                        ) from None
                    if waiting:
                        workers.append(_Worker(context))
                    if worker.job is not None:
                        yield Outcome(worker.job, error=f"its worker process died ({death})")
                    continue
                done, worker.job, worker.ready = worker.job, None, True
                if waiting:
                    worker.give(waiting.popleft(), prepare)
                else:
                    workers.remove(worker)
                    worker.pipe.close()
                if done is not None:
                    yield Outcome(done, *message)
    finally:
        for worker in workers:
            worker.end()


# --- Dask --------------------------------------------------------------------------------------------------------


def _dask(jobs: Sequence[Job], address: str, prepare: Callable[[], object] | None) -> Generator[Outcome, None, None]:
    distributed = import_extra("distributed", "a Dask cluster")
    client = connect_cluster(address)
    try:
        futures = {client.submit(attempt, j.trial, j.seed, prepare, pure=False): j for j in jobs}
        try:
            for future in distributed.as_completed(futures, loop=client.loop):
                job = futures[future]
                try:
                    outcome = Outcome(job, *future.result())
                except (distributed.CancelledError, OSError, TimeoutError) as error:
                    raise GraphSlamError(f"the Dask cluster at {address} went away: {error}") from error
                except Exception as error:  # a worker died too often over it, or cannot import it
                    outcome = Outcome(job, error=f"{type(error).__name__}: {error}")
                yield outcome
        finally:
            client.cancel(list(futures))
    finally:
        client.close()


def hold_one_thread() -> None:
    """Hold BLAS, OpenMP and numba of this process to one thread, for good: for a worker among workers.

    Libraries that are loaded already get the limit; later ones read the environment.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    if (numba := sys.modules.get("numba")) is not None:
        numba.set_num_threads(1)  # its variable may not change any more once its threads run
    else:
        os.environ["NUMBA_NUM_THREADS"] = "1"
    threadpool_limits(limits=1)
