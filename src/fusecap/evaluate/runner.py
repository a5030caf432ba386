"""A grid of independent cells, computed on all cores or on a Ray cluster, and resumed after a kill.

    cells ──key──▶ already in the folder? ──no──▶ workers ──▶ result written at once
                          └──────────yes──────────────────▶ result read

A cell is a frozen dataclass of plain values and `work(cell)` a module-level function that returns
plain values. The key is a hash of the cell, of the function's name and of the versions that the
result depends on (`code_version`), so a result is used again exactly when it would come out the
same. A cell that fails is reported and not written: the next run tries it again. The rest of the
grid is kept.
"""

from __future__ import annotations

import hashlib
import json
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from fusecap.errors import InputError, from_extra
from fusecap.evaluate.code_version import versions_of
from fusecap.files import written_whole
from fusecap.inputs import CELL, read_json

Work = Callable[[Any], dict[str, Any]]
OnOutcome = Callable[["Outcome", int, int], None]
"""Called as each cell ends, with (what became of it, cells done, cells in all)."""

_ONE_THREAD: dict[str, str] = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}
_FORMAT = "fusecap cell 1"
Ended = tuple[str, dict[str, Any] | None, str, float]
"""Key, result or None, error, seconds."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of one cell: a result or an error."""

    cell: Any
    key: str
    result: dict[str, Any] | None = None
    error: str = ""
    """Type and message; empty when there is a result."""
    elapsed_s: float = 0.0
    """Of the work alone, when it was done."""
    resumed: bool = False
    """Read from an earlier run."""


def run_cells(
    cells: Sequence[Any],
    work: Work,
    *,
    folder: Path,
    versions: Mapping[str, str] | None = None,
    workers: int | None = None,
    ray: str | None = None,
    progress: OnOutcome | None = None,
) -> list[Outcome]:
    """Compute `cells`, each once, and return their outcomes in order.

    `workers` processes (all cores unless told), each with one thread for its arrays; or the Ray
    cluster at address `ray`, "local" for one on this machine. `folder` keeps one JSON file per
    finished cell. `versions` are added to those of the code and its libraries in each key.
    """
    versions = {**versions_of(work), **(versions or {})}
    keys = [cell_key(cell, work, versions) for cell in cells]
    outcomes: dict[str, Outcome] = {}
    waiting: dict[str, Any] = {}
    for key, cell in zip(keys, cells, strict=True):
        if key in outcomes or key in waiting:
            continue
        known = _read(folder / f"{key}.json")
        if known is None:
            waiting[key] = cell
        else:
            outcomes[key] = Outcome(cell=cell, key=key, resumed=True, **known)
    total = len(outcomes) + len(waiting)
    if progress:
        for done, outcome in enumerate(outcomes.values(), start=1):
            progress(outcome, done, total)
    for key, result, error, elapsed_s in compute(waiting, work, workers=workers, ray=ray):
        outcome = Outcome(
            cell=waiting[key], key=key, result=result, error=error, elapsed_s=elapsed_s
        )
        if result is not None:
            _write(folder / f"{key}.json", outcome, versions)
        outcomes[key] = outcome
        if progress:
            progress(outcome, len(outcomes), total)
    return [outcomes[key] for key in keys]


def cell_key(cell: Any, work: Work, versions: Mapping[str, str]) -> str:
    """Name of a cell's file: changes with anything that its result depends on."""
    content = {
        "cell": [type(cell).__qualname__, asdict(cell)],
        "work": f"{work.__module__}.{work.__qualname__}",
        "versions": dict(versions),
    }
    text = json.dumps(content, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _read(path: Path) -> dict[str, Any] | None:
    """Result and time of a finished cell; None where there is none, or not a whole one."""
    try:
        stored = read_json(path, CELL)
        if stored["format"] != _FORMAT or not isinstance(stored["result"], dict):
            return None
        return {"result": stored["result"], "elapsed_s": float(stored["elapsed_s"])}
    except (InputError, ValueError, KeyError, TypeError):
        return None


def _write(path: Path, outcome: Outcome, versions: Mapping[str, str]) -> None:
    stored = {
        "format": _FORMAT,
        "cell": asdict(outcome.cell),
        "versions": dict(versions),
        "elapsed_s": outcome.elapsed_s,
        "result": outcome.result,
    }
    with written_whole(path) as file:
        file.write(json.dumps(stored, indent=1).encode())


def _timed(work: Work, cell: Any) -> tuple[dict[str, Any] | None, str, float]:
    """Result or error, and the time it took; what fails in a cell stays in the cell."""
    started = time.perf_counter()
    try:
        result, error = work(cell), ""
        json.dumps(result, allow_nan=False)
    except SystemExit:
        # A pool would send it back as an answer, and wait for the next cell.
        os._exit(1)
    except Exception as failure:
        result, error = None, f"{type(failure).__name__}: {failure}"
    return result, error, time.perf_counter() - started


def compute(
    waiting: Mapping[str, Any], work: Work, *, workers: int | None = None, ray: str | None = None
) -> Iterator[Ended]:
    """Each of `waiting` by its key, as it ends, on all cores or on Ray; nothing is kept."""
    if not waiting:
        return iter(())
    if ray is not None:
        return _on_ray(waiting, work, ray, workers)
    return _on_cores(waiting, work, min(workers or _cores(), len(waiting)))


def _on_cores(waiting: Mapping[str, Any], work: Work, workers: int) -> Iterator[Ended]:
    """One process per core; a cell that kills its process fails alone.

    When a process dies every cell in flight is lost and any of them may be the cause, so each of
    them is tried once more with a pool to itself.
    """
    queue: deque[str] = deque(waiting)
    suspects: deque[str] = deque()
    while queue or suspects:
        alone = bool(suspects)
        source, count = (suspects, 1) if alone else (queue, workers)
        flying: dict[Future[Any], str] = {}
        with _pool(count) as pool:
            try:
                while source or flying:
                    while source and len(flying) < count:
                        flying[pool.submit(_timed, work, waiting[source[0]])] = source[0]
                        source.popleft()
                    for future in wait(flying, return_when=FIRST_COMPLETED).done:
                        ended = future.result()
                        yield flying.pop(future), *ended
            except BrokenProcessPool:
                if alone and flying:
                    yield next(iter(flying.values())), None, "its process was killed", 0.0
                elif not alone:
                    suspects.extend(flying.values())


@contextmanager
def _pool(count: int) -> Iterator[ProcessPoolExecutor]:
    """Fresh processes that use one thread for their arrays and do not outlive this one."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)
    pool = ProcessPoolExecutor(
        count, mp_context=multiprocessing.get_context("spawn"), initializer=_quit_with_parent
    )
    try:
        yield pool
    except BaseException:
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _quit_with_parent() -> None:
    """A worker waits for work for ever, also when the process that had any was killed.

    One that is told to end leaves no unfinished file. Ctrl-C and a closed terminal are for the
    parent, which then tells it to.
    """
    for name in ("SIGINT", "SIGHUP"):  # Windows knows no SIGHUP
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _end)
    parent = multiprocessing.parent_process()

    def quit() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=quit, daemon=True).start()


def _end(*_: object) -> None:
    """Once; between two cells the pool may take the exit for an answer, hence the timer."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    timer = threading.Timer(1.0, os._exit, (1,))
    timer.daemon = True
    timer.start()
    sys.exit(1)


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _on_ray(
    waiting: Mapping[str, Any], work: Work, address: str, workers: int | None
) -> Iterator[Ended]:
    """One Ray task on one core per cell; nodes need this version of fusecap installed."""
    # Else Ray builds every worker an environment of its own where we run under uv.
    os.environ.setdefault("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    try:
        import ray
        from ray.exceptions import RayError
    except ImportError:
        raise InputError(f"--ray needs Ray; {from_extra('cluster')}") from None
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    local = {"num_cpus": workers, "include_dashboard": False} if address == "local" else {}
    try:
        ray.init(
            address=address,
            log_to_driver=False,
            logging_level=logging.ERROR,
            runtime_env={"env_vars": _ONE_THREAD},
            **local,
        )
    except Exception as error:
        # Ray raises ConnectionError, ValueError, or Exception itself.
        raise InputError(f"Ray did not start at '{address}': {error}") from error
    try:
        # A task whose worker dies is not repeated: its cell fails, as on our own cores.
        task = ray.remote(num_cpus=1, max_retries=0)(_same_code)
        versions = versions_of(work)
        flying = {task.remote(work, cell, versions): key for key, cell in waiting.items()}
        while flying:
            for reference in ray.wait(list(flying))[0]:
                try:
                    result, error, elapsed_s = ray.get(reference)
                except RayError as lost:
                    result, elapsed_s = None, 0.0
                    error = f"{type(lost).__name__}: {str(lost).splitlines()[0]}"
                yield flying.pop(reference), result, error, elapsed_s
    finally:
        ray.shutdown()


def _same_code(
    work: Work, cell: Any, versions: Mapping[str, str]
) -> tuple[dict[str, Any] | None, str, float]:
    """`_timed` on a node that runs the code and the libraries which the key names."""
    here = versions_of(work)
    differ = [
        f"{name} {here[name]}, not {versions[name]}"
        for name in here
        if here[name] != versions[name]
    ]
    if differ:
        return None, f"this node has {'; '.join(differ)}", 0.0
    return _timed(work, cell)
