"""Worker processes: replies, deaths, and no processes or descriptors left behind."""

from __future__ import annotations

from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import pytest

from sgstore.base import processes
from sgstore.base.processes import WorkerPool, WorkerProcess

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(autouse=True)
def nothing_left(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    found = [*processes.folders(), str(Path(__file__).parents[1] / "worlds")]
    monkeypatch.setattr(processes, "folders", lambda: found)
    before = opened(), children()
    yield
    assert opened() <= before[0]
    assert children() <= before[1]


def opened() -> int:
    """Number of open descriptors, as far as Linux tells."""
    return sum(1 for _ in Path("/proc/self/fd").glob("*"))


def children() -> set[str]:
    """Processes that this one began and has not reaped."""
    return {
        pid for one in Path("/proc/self/task").glob("*/children") for pid in one.read_text().split()
    }


def answers(pool: WorkerPool, todo: list[str], **more: Any) -> dict[int, list[Any]]:
    found: dict[int, list[Any]] = {key: [] for key in range(len(todo))}
    for key, do in enumerate(todo):
        pool.put(key, {"do": do, **more})
    left = len(todo)
    while left:
        key, reply = pool.get()
        found[key].append(reply)
        left -= isinstance(reply, int) or "more" not in reply
    return found


@pytest.mark.parametrize("ahead", [1, 3])
def test_each_request_gets_its_replies(ahead: int) -> None:
    with WorkerPool(2, "answering", ahead=ahead) as pool:
        found = answers(pool, list("abcde"), parts=2)

    parts = [{"more": True, "part": 0}, {"more": True, "part": 1}]
    assert found == {key: [*parts, {"echo": do}] for key, do in enumerate("abcde")}


@pytest.mark.parametrize("ahead", [1, 3])
def test_a_killed_worker_costs_one_request(ahead: int) -> None:
    with WorkerPool(2, "answering", ahead=ahead) as pool:
        found = answers(pool, ["a", "die", "b", "die", "c", "d"])

    assert found[1] == found[3] == [-9]
    assert [found[key] for key in (0, 2, 4, 5)] == [[{"echo": do}] for do in "abcd"]


def test_an_exception_of_a_worker_is_an_exit_code(capfd: pytest.CaptureFixture[str]) -> None:
    with WorkerPool(1, "answering") as pool:
        assert answers(pool, ["fail", "a"]) == {0: [1], 1: [{"echo": "a"}]}

    assert "a fault of the worker" in capfd.readouterr().err


def test_an_interrupted_pool_ends_its_workers() -> None:
    def interrupted() -> None:
        with WorkerPool(2, "answering") as pool:
            pool.put(0, {"do": "a", "parts": 10**9})
            pool.get()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()


def test_a_long_line_ends_the_reading() -> None:
    lines: SimpleQueue[bytes] = SimpleQueue()
    worker = WorkerProcess("answering", on_line=lines.put, longest=40, quiet=True)
    worker.send({"do": "short"})
    assert lines.get(timeout=60) == b'{"echo": "short"}\n'
    worker.send({"do": "long" * 10})
    assert len(lines.get(timeout=60)) == 40
    worker.end()
    worker.send({"do": "unread"})
    assert not worker.is_alive
