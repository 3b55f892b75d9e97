"""Test process of ``mutants.py``: it collects the tests once, and tries each mutant in a forked process.

A mutant changes the code of functions. The forked process gives the new code to the functions that are already
imported, so a mutant costs the time of its tests. Processes that the tests start import the changed file.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import sys
from pathlib import Path
from types import CodeType, FunctionType
from typing import TYPE_CHECKING, Any, BinaryIO

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_WALL: int = 6
"""Longest time of a trial, in multiples of its processor time."""


class Trials:
    """Plugin that replaces the loop over the tests by a loop over mutants.

    Parameters
    ----------
    orders, replies : BinaryIO
        Pipes from and to ``mutants.py``: one JSON object per line.
    """

    def __init__(self, orders: BinaryIO, replies: BinaryIO) -> None:
        self._orders, self._replies = orders, replies
        self._failed = ""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note the first test that fails."""
        if report.failed and not self._failed:
            self._failed = report.nodeid

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Try one mutant after another until the pipe closes."""
        known = {item.nodeid: item for item in session.items}
        self._reply({"ready": len(known)})  # what the tests import is imported without a mutant
        for line in self._orders:
            order = json.loads(line)
            reader, writer = os.pipe()
            child = os.fork()
            if not child:
                os.close(reader)
                self._try(session, known, order, writer)
            os.close(writer)
            self._reply({"child": child})
            with os.fdopen(reader, "rb") as pipe:
                failed = pipe.readline().decode()
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            self._reply({"code": code, "failed": failed})
        return True

    def _reply(self, values: dict[str, Any]) -> None:
        self._replies.write(json.dumps(values).encode() + b"\n")
        self._replies.flush()

    def _try(
        self,
        session: pytest.Session,
        known: dict[str, pytest.Item],
        order: dict[str, Any],
        writer: int,
    ) -> None:
        """Run some tests with the mutant in this forked process, and end the process."""
        code = 70
        try:
            os.setsid()
            seconds = int(order["seconds"])
            resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
            factory = session.config._tmp_path_factory  # type: ignore[attr-defined]
            factory._basetemp, factory._given_basetemp = None, Path(order["folder"]) / "t"
            if order["old"] != order["new"]:
                exchange(order["path"], order["old"], order["new"])
            self._failed = next((test for test in order["tests"] if test not in known), "")
            items = [] if self._failed else [known[test] for test in order["tests"]]
            for item, after in zip(items, [*items[1:], None], strict=True):
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
                if self._failed:
                    break
            os.write(writer, self._failed.encode())
            code = 1 if self._failed else 0
        except BaseException as error:  # noqa: BLE001  a mutant may raise anything
            os.write(writer, repr(error).encode()[:500].replace(b"\n", b" ") if code == 70 else b"")
        finally:
            os._exit(code)


def exchange(path: str, old: str, new: str) -> int:
    """Give the functions of an imported file the code of a changed source; return their number.

    Parameters
    ----------
    path : str
        File, as it was imported.
    old, new : str
        Source text of the imported file, and the changed text.
    """
    befores, afters = (_functions(compile(text, path, "exec")) for text in (old, new))
    codes = {
        (code.co_qualname, code.co_firstlineno): after
        for code, after in zip(befores, afters, strict=True)
    }
    gc.unfreeze()  # a frozen object is not listed
    count = 0
    for thing in gc.get_objects():
        if type(thing) is FunctionType and thing.__code__.co_filename == path:
            code = codes.get((thing.__code__.co_qualname, thing.__code__.co_firstlineno))
            if code is not None:
                thing.__code__ = code
                count += 1
    return count


def _functions(code: CodeType) -> list[CodeType]:
    """Return the code of all functions and methods of a module, without those inside functions."""
    return list(_below(code))


def _below(code: CodeType) -> Iterator[CodeType]:
    for part in code.co_consts:
        if not isinstance(part, CodeType) or part.co_name.startswith("<"):
            continue
        if part.co_flags & 2:  # CO_NEWLOCALS: a function, not the body of a class
            yield part
        else:
            yield from _below(part)


def serve(files: Sequence[str], orders: int, replies: int) -> int:
    """Collect test files, and try mutants until the pipe closes; return the exit code of pytest."""
    options = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
    with os.fdopen(orders, "rb") as first, os.fdopen(replies, "wb") as second:
        return int(pytest.main([*options, *files], plugins=[Trials(first, second)]))


if __name__ == "__main__":
    sys.exit(serve(sys.argv[3:], int(sys.argv[1]), int(sys.argv[2])))
