"""Engines: each runs the tasks of a query in parallel, by local processes, Ray or Spark.

``local:N`` uses N processes of this machine, ``local`` or ``local:1`` the current process. ``ray``
and ``ray://HOST:PORT`` use Ray, ``spark``, ``spark:MASTER`` and ``spark://HOST:PORT`` use Spark.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections import Counter, deque
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.processes import WorkerPool, requests, send_reply
from sgstore.errors import (
    AbstractionError,
    ConfigError,
    MissingExtraError,
    QueryError,
    SgstoreError,
    SqlError,
    StoreError,
    error_of,
    plain_error,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

RETRIES: Final = 3
"""Number of retries of a task whose process or machine is lost."""

TOGETHER: Final = 256
"""Number of tasks in one Spark job. The results of a job arrive together."""

Task = dict[str, Any]
Outcome = dict[str, Any]


def engine_named(name: str) -> Engine:
    """Return the engine for a name such as ``local:4``, ``ray://HOST:PORT`` or ``spark:MASTER``.

    Raises
    ------
    StoreError
        The name is unknown.
    MissingExtraError
        Its package is not installed.
    """
    word, _, rest = name.partition(":")
    if word == "local":
        number = int(rest) if rest.isdecimal() else 1 if not rest else -1
        if number < 0:
            raise StoreError(f"engine {name!r}: expected local:N, such as local:4 (0: all cores)")
        count = number or os.cpu_count() or 1
        return _Here() if count == 1 else _Processes(count)
    if word == "ray":
        return _Ray(name if rest else None)
    if word == "spark":
        return _Spark(name if rest.startswith("//") else rest)
    raise StoreError(
        f"no engine {name!r}; there are: local, local:N, ray, ray://HOST:PORT, spark, spark:MASTER, spark://HOST:PORT"
    )


_OF_QUESTIONS: Final = (QueryError, SqlError, AbstractionError, ConfigError)
"""Error classes that a query causes, and not a bundle."""


def refusal(task: Task, error: SgstoreError) -> Outcome:
    """Return the result of a failed task. It marks an error that a retry would repeat."""
    outcome = {"bundle": task["bundle"], "error": str(error)}
    return outcome | ({"wrong": plain_error(error)} if isinstance(error, _OF_QUESTIONS) else {})


def fault_of_question(outcome: Outcome) -> SgstoreError | None:
    """If a task failed because of the query, return the error.

    ``None`` means success, or an error of the bundle.
    """
    return error_of(outcome["wrong"]) if "wrong" in outcome else None


class _Here:
    """Engine that runs tasks one by one in this process.

    Attributes
    ----------
    shares_files : bool
        True if this process can read local files that a task writes.
    """

    shares_files = True

    def map(self, function: Callable[[Task], Outcome], tasks: Sequence[Task]) -> Iterator[Outcome]:
        """Run a function on all tasks in parallel, and yield each result on arrival.

        A failed task gives ``{"bundle": …, "error": …}``. :func:`refusal` adds details for
        :func:`fault_of_question`.
        """
        for task in tasks:
            try:
                yield function(task)
            except SgstoreError as error:
                yield refusal(task, error)


class _Processes:
    """Engine of local worker processes. An idle process gets the next task, and a dead one is replaced."""

    shares_files = True

    def __init__(self, count: int) -> None:
        self._count = count

    def map(self, function: Callable[[Task], Outcome], tasks: Sequence[Task]) -> Iterator[Outcome]:
        name = f"{function.__module__}:{function.__qualname__}"
        waiting, tries, left = deque(range(len(tasks))), Counter[int](), len(tasks)
        with WorkerPool(self._count, "sgstore.collection._engines", name) as pool:
            while left:
                while waiting and pool.has_room:
                    index = waiting.popleft()
                    pool.put(index, tasks[index])
                index, outcome = pool.get()
                if isinstance(outcome, int):
                    tries[index] += 1
                    if tries[index] <= RETRIES:
                        waiting.appendleft(index)
                        continue
                    how = f"signal {-outcome}" if outcome < 0 else f"code {outcome}"
                    reason = f"the process of this bundle ended with {how}, {tries[index]} times"
                    outcome = {"bundle": tasks[index]["bundle"], "error": reason}
                left -= 1
                yield outcome


class _Ray:
    """Engine that runs tasks by Ray, which repeats lost tasks itself.

    If Ray itself has died, it is started again, once for each call of :meth:`map`.
    """

    shares_files = False

    def __init__(self, address: str | None) -> None:
        try:
            self._ray: Any = import_module("ray")
        except ImportError as error:
            raise MissingExtraError("the engine ray", "ray") from error
        self._address = address
        errors = self._ray.exceptions
        self._dead: tuple[type[Exception], ...] = (
            *(errors.RaySystemError, errors.LocalRayletDiedError, ConnectionError),
        )
        self._start()

    def _start(self) -> None:
        if not self._ray.is_initialized():
            self._ray.init(address=self._address, log_to_driver=False, logging_level="ERROR")
        # Once: a new remote function would be sent to each worker again.
        self._run: Any = self._ray.remote(max_retries=RETRIES)(_done)

    def map(self, function: Callable[[Task], Outcome], tasks: Sequence[Task]) -> Iterator[Outcome]:
        name = f"{function.__module__}:{function.__qualname__}"
        left = [*tasks]
        try:
            yield from self._outcomes(name, left)
        except self._dead:
            self._ray.shutdown()
            try:
                self._start()
                yield from self._outcomes(name, left)
            except self._dead as error:
                reason = f"Ray died, and again after a restart: {_cause(error)}"
                yield from ({"bundle": task["bundle"], "error": reason} for task in left)

    def _outcomes(self, name: str, tasks: list[Task]) -> Iterator[Outcome]:
        """Run tasks, and yield each result. Remove each finished task from the list."""
        pending = {self._run.remote(name, task): task for task in tasks}
        while pending:
            some, left = self._ray.wait([*pending], num_returns=1)
            others, _ = self._ray.wait(left, num_returns=len(left), timeout=0) if left else ([], [])
            for one in (*some, *others):
                task = pending.pop(one)
                try:
                    outcome = self._ray.get(one)
                except self._dead:
                    raise
                except self._ray.exceptions.RayError as error:
                    outcome = {"bundle": task["bundle"], "error": _cause(error)}
                tasks.remove(task)
                yield outcome


class _Spark:
    """Engine that runs tasks on Spark. Each task is a Spark partition. Spark repeats lost tasks itself.

    If a complete job fails, the faulty task is unknown: its tasks then run one by one.
    """

    shares_files = False

    def __init__(self, master: str) -> None:
        try:
            sql: Any = import_module("pyspark.sql")
        except ImportError as error:
            raise MissingExtraError("the engine spark", "spark") from error
        os.environ.setdefault("PYSPARK_PYTHON", sys.executable)
        session = None if master else sql.SparkSession.getActiveSession()
        try:
            self._spark: Any = session or _session(sql, master)
        except Exception as error:
            raise StoreError(f"Spark does not start: {_cause(error)}") from error

    def map(self, function: Callable[[Task], Outcome], tasks: Sequence[Task]) -> Iterator[Outcome]:
        name = f"{function.__module__}:{function.__qualname__}"
        for first in range(0, len(tasks), TOGETHER):
            some = tasks[first : first + TOGETHER]
            try:
                found = self._done(name, some)
            except Exception:  # noqa: BLE001  errors of Java have no common type
                found = [outcome for task in some for outcome in self._alone(name, task)]
            yield from found

    def _alone(self, name: str, task: Task) -> list[Outcome]:
        try:
            return self._done(name, [task])
        except Exception as error:  # noqa: BLE001  as above
            return [{"bundle": task["bundle"], "error": _cause(error)}]

    def _done(self, name: str, tasks: Sequence[Task]) -> list[Outcome]:
        # Not a data frame (mapInArrow): its planning, and Java rows in between, take four times as
        # long.
        lines = self._spark.sparkContext.parallelize([*map(json.dumps, tasks)], len(tasks))
        done = lines.mapPartitions(partial(_lines_done, name)).collect()
        return [*map(json.loads, done)]


Engine = _Here | _Processes | _Ray | _Spark
"""Engine that runs tasks in parallel: local processes, Ray or Spark."""


def _session(sql: Any, master: str) -> Any:
    """Return a Spark session on a master, or on all local cores. The session repeats lost tasks."""
    build = sql.SparkSession.builder.appName("sgstore").master(master or f"local[*,{RETRIES + 1}]")
    build = build.config("spark.task.maxFailures", RETRIES + 1).config("spark.ui.enabled", "false")
    build = build.config("spark.ui.showConsoleProgress", "false")
    session = build.getOrCreate()
    session.sparkContext.setLogLevel("OFF")
    return session


def _lines_done(name: str, lines: Iterable[str]) -> Iterator[str]:
    for line in lines:
        yield json.dumps(_done(name, json.loads(line)))


_RAISED: Final = re.compile(r'^[ \t]+File ".*\n(?:[ \t].*\n)*(\S.*)', re.MULTILINE)
"""Regular expression: stack frames of Python in an error text, and the final error."""


def _cause(error: BaseException) -> str:
    """Return the cause of a Ray or Spark error in one line."""
    text = re.sub(r"\x1b\[[\d;]*m", "", str(error)).strip()  # Ray writes in colours
    lines = _RAISED.findall(text)[-1:] or text.splitlines() or [type(error).__name__]
    return lines[0].strip()[:300]


def _function(name: str) -> Callable[[Task], Outcome]:
    module, _, function = name.partition(":")
    return getattr(import_module(module), function)


def _done(name: str, task: Task) -> Outcome:
    try:
        return _function(name)(task)
    except SgstoreError as error:
        return refusal(task, error)


def main() -> None:
    """Run tasks in a worker process."""
    for request in requests():
        send_reply(_done(sys.argv[1], request))
