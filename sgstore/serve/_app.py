"""The application: what the page can ask, and who answers it."""

from __future__ import annotations

import asyncio
import os
import threading
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from dataclasses import astuple
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final, TypeVar
from weakref import WeakSet

from starlette.applications import Starlette
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from sgstore.errors import QueryError, SgstoreError, SqlError, StoreError
from sgstore.notes import Note, NotesFile, write_table
from sgstore.query import Store
from sgstore.sandbox import Errand, SandboxPool
from sgstore.serve._guard import Guard
from sgstore.serve._reads import READS, Reads
from sgstore.serve._requests import Fields, RequestError
from sgstore.serve._wire import PAGE, as_json

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable, Mapping

    from starlette.requests import Request
    from starlette.types import Receive, Scope, Send

    Endpoint = Callable[[Request], Awaitable[Response]]

T = TypeVar("T")

MOST_QUESTIONS: Final = 8
"""Questions under way; one more is refused with 503."""

TIMEOUT_S: Final = 60.0
"""Longest time for a question that somebody typed; s."""

LONGEST_S: Final = 86_400.0
"""Longest time for a lock, an export, or a comparison of stores; s."""

MOST_MATCHES: Final = 50_000
"""Matches and rows of a question; the page says if there are more."""

_TYPES: Final = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
    ".txt": "text/plain",
}
WORKER: Final = "sgstore.serve._worker"
FIRST: Final = {"ask": "rows", "text": "MATCH (e:Ego) RETURN e.id LIMIT 1", "parameters": {}}
"""What each sandbox is asked first: the language, the catalogue and the database are loaded for it."""

_NONCE: Final = "{{nonce}}"
_SCRIPT: Final = "js/main.js"


class _Answer(StreamingResponse):
    """Answer that comes in parts; whatever ends it, the browser that has left, too, ends what makes it."""

    def __init__(
        self, parts: AsyncGenerator[bytes], ended: Callable[[], None], media_type: str
    ) -> None:
        super().__init__(parts, media_type=media_type)
        self._parts, self._ended = parts, ended

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._ended()
            with suppress(RuntimeError):  # it runs: then it ends by itself
                await self._parts.aclose()


class _Question:
    """A question to a sandbox that is under way: its replies, as they come.

    Parameters
    ----------
    pool : function
        Gives what answers: the sandboxes, or an errand; it may take its time.
    question : mapping
    key : str
        What it is cancelled by.
    """

    def __init__(
        self, pool: Callable[[], SandboxPool | Errand], question: Mapping[str, Any], key: str
    ) -> None:
        self._pool, self._question, self._key = pool, question, key
        self._asked: SandboxPool | Errand | None = None
        self._gone = threading.Event()
        self._loop = asyncio.get_running_loop()
        self._found: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()

    def ask(self) -> None:
        """Ask, in a thread of its own; an error is a reply."""
        tell = partial(self._loop.call_soon_threadsafe, self._found.put_nowait)
        try:
            self._asked = self._pool()
            if self._gone.is_set():
                return
            for reply in self._asked.ask(self._question, self._key):
                tell(reply)
        except SgstoreError as error:
            tell({"error": error.as_dict()})
        except BaseException:
            tell({"error": {"error": "SgstoreError", "reason": "the question failed"}})
            raise
        finally:
            tell(None)

    async def replies(self) -> AsyncGenerator[dict[str, Any]]:
        """The replies, in order."""
        while (reply := await self._found.get()) is not None:
            yield reply

    def end(self) -> None:
        """Cancel it, if it is not answered yet."""
        self._gone.set()  # it may not have begun
        if self._asked is not None:
            self._asked.cancel(self._key)


class Explorer:
    """State that the endpoints of one store share.

    Parameters
    ----------
    path : Path
        Of the store.
    other : Path, optional
        A second store, to compare with.
    write_to : Path, optional
        Folder that locks and clips may be written below; without it nothing is written but tags.

    Attributes
    ----------
    busy : int
        Questions and longer pieces of work that are under way.
    errands : set
        Processes of those pieces of work.

    Raises
    ------
    StoreError
        There is no such store.
    """

    def __init__(
        self, path: Path, *, other: Path | None = None, write_to: Path | None = None
    ) -> None:
        self.store = Store(path)
        self.other = Store(other) if other is not None else None
        self.write_to = write_to
        self.notes = NotesFile(Path(path))
        self.reads = {"a": Reads(self.store)}
        if self.other is not None:
            self.reads["b"] = Reads(self.other)
        self._stamp = self.notes.stamp()
        self._folder = TemporaryDirectory(prefix="sgstore-notes-")
        self._pools = {"a": self._pool(path, tables=self._tables())}
        if other is not None:
            self._pools["b"] = self._pool(other)
        self._threads = ThreadPoolExecutor(MOST_QUESTIONS + 4, "sgstore question")
        self._counting = threading.Lock()
        self._ended = threading.Event()
        self.errands = WeakSet[Errand]()
        self.busy = 0

    def warm(self) -> None:
        """Read maps in a thread of its own, before somebody asks for them."""
        for reads in self.reads.values():
            self._threads.submit(reads.warm, self._ended)

    def close(self) -> None:
        """End the sandboxes, wait for what is read, and give the stores back."""
        self._ended.set()
        for errand in tuple(self.errands):
            errand.cancel()
        for pool in self._pools.values():
            pool.close()
        # The process must not end while a thread is within the database.
        self._threads.shutdown(cancel_futures=True)
        self._folder.cleanup()
        self.store.close()
        if self.other is not None:
            self.other.close()

    @staticmethod
    def _pool(path: Path, tables: Mapping[str, Path] | None = None) -> SandboxPool:
        return SandboxPool(
            path,
            timeout_s=TIMEOUT_S,
            max_rows=MOST_MATCHES,
            tables=tables,
            worker=WORKER,
            small=("parts", "why"),
            first=FIRST,
        )

    def _tables(self) -> dict[str, Path]:
        """The tags, as a table that queries can speak of."""
        found = self.notes.read()
        if not found:
            return {}
        table = Path(self._folder.name) / "notes.csv"
        write_table(found, table)
        return {"notes": table}

    def pool(self, side: str, text: str) -> SandboxPool:
        """The sandboxes of a store; those that are asked for tags know all that were written."""
        if side == "a" and "notes" in text.lower() and self._stamp != self.notes.stamp():
            self._stamp = self.notes.stamp()
            old, self._pools["a"] = (
                self._pools["a"],
                self._pool(self.store.file.path, tables=self._tables()),
            )
            self._threads.submit(old.close)
        return self._pools[side]

    # What somebody typed -------------------------------------------------------------------------

    def _ask(self, question: Mapping[str, Any], key: str = "", side: str = "a") -> _Question:
        """A question that is asked from now on.

        Raises
        ------
        RequestError
            There are too many questions under way.
        """
        pool = partial(self.pool, side, str(question.get("text", "")))
        asked = _Question(pool, question, key or uuid.uuid4().hex)
        self._begin(asked.ask)
        return asked

    def _begin(self, work: Callable[[], None]) -> None:
        """Have something done in a thread."""
        with self._counting:
            if self.busy >= MOST_QUESTIONS:
                raise RequestError(
                    f"{MOST_QUESTIONS} questions are under way; try again later", 503
                )
            self.busy += 1

        def run() -> None:
            try:
                work()
            finally:
                with self._counting:
                    self.busy -= 1

        self._threads.submit(run)

    async def find(self, request: Request) -> Response:
        """Matches of a pattern, or rows of SQL: lines of JSON, as they come."""
        fields = await Fields.of(request)
        text = fields.text("text")
        kind = "sql" if _is_sql(text) else fields.one_of("ask", "matches", "rows")
        question = {"ask": kind, "text": text, "parameters": fields.parameters()}
        key, side = fields.text("id", ""), fields.one_of("side", *self._pools)
        started = time.perf_counter()
        asked = self._ask(question, key, side)

        async def lines() -> AsyncGenerator[bytes]:
            about = {"kind": kind}
            async for reply in asked.replies():
                yield as_json(about | reply) + b"\n"
                about = {}
            ms = (time.perf_counter() - started) * 1e3
            yield as_json({"ms": round(ms, 1)}) + b"\n"

        return _Answer(lines(), asked.end, "application/x-ndjson")

    async def cancel(self, request: Request) -> Response:
        """Stop a question."""
        key = str(request.path_params["key"])
        done = any(pool.cancel(key) for pool in self._pools.values())
        return JSONResponse({"cancelled": done})

    async def one(self, request: Request, ask: str) -> Response:
        """The whole answer to a question: lanes of truth, why not, verdicts. An error is an answer, too."""
        fields = await Fields.of(request)
        side = fields.one_of("side", *self._pools)
        question = {"ask": ask, **fields.take(*_QUESTIONS[ask])}
        if "seq" in question:
            where = question["trace"], question["seq"]
            question["frame"] = await self.threaded(self.reads[side].frame_id, *where)
        asked = self._ask(question, side=side)

        async def answer() -> AsyncGenerator[bytes]:
            found = [reply async for reply in asked.replies()]
            if ask == "check":
                verdicts = [one.pop("verdict") for one in found if "verdict" in one]
                found[-1] |= {"verdicts": verdicts}
            yield as_json(found[-1])

        return _Answer(answer(), asked.end, "application/json")

    # What the page reads by trace and frame --------------------------------------------------------

    async def threaded(self, ask: Callable[..., T], *arguments: Any) -> T:
        """Answer of a function that takes its time."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, partial(ask, *arguments))

    async def read(self, request: Request, name: str) -> Response:
        """Something that is read of a store: columns as bytes, a picture, or plain values."""
        fields = await Fields.of(request)
        reads = self.reads[fields.one_of("side", *self.reads)]
        ask = partial(getattr(reads, name), **fields.take(*READS[name]))
        return answered(await self.threaded(ask))

    async def about(self, _: Request) -> Response:
        """The stores: their traces, and what the page may do."""
        sides = {side: await self.threaded(reads.about) for side, reads in self.reads.items()}
        writing = self.write_to is not None
        return JSONResponse({**sides["a"], "other": sides.get("b"), "writing": writing})

    # Tags, measures, files ---------------------------------------------------------------------------

    async def tags(self, request: Request) -> Response:
        """All tags; with POST one is written, or taken away."""
        fields = await Fields.of(request)
        if request.method == "POST":
            trace, seq = fields.text("trace"), fields.whole("seq")
            await self.threaded(self.reads["a"].frame_id, trace, seq)
            note = Note(trace, seq, fields.text("tag"), fields.text("note", ""))
            gone = fields.one_of("do", "add", "remove") == "remove"
            await self.threaded(partial(self.notes.add, note, gone=gone))
        found = await self.threaded(self.notes.read)
        told = {"notes": [astuple(note) for note in found], "file": self.notes.path.name}
        return JSONResponse(told)

    async def work(self, request: Request, name: str) -> Response:
        """A longer piece of work, as lines of JSON: what is done of it, then its result or an error."""
        fields = await Fields.of(request)
        question = {"ask": name, **fields.take(*_WORK[name])}
        if "name" in question:
            question["to"] = str(self.target(question.pop("name")))
        else:
            question["other"] = str(self.compared.file.path.absolute())
        errand = Errand(self.store.file.path, timeout_s=LONGEST_S, memory=1 << 30, worker=WORKER)
        self.errands.add(errand)
        asked = _Question(lambda: errand, question, "")
        self._begin(asked.ask)

        async def lines() -> AsyncGenerator[bytes]:
            async for reply in asked.replies():
                yield as_json(reply) + b"\n"

        return _Answer(lines(), asked.end, "application/x-ndjson")

    @property
    def compared(self) -> Store:
        """The second store.

        Raises
        ------
        RequestError
            There is none.
        """
        if self.other is None:
            told = "there is no second store; start 'sgstore serve STORE' with --compare OTHER"
            raise RequestError(told, 404)
        return self.other

    def target(self, name: str) -> Path:
        """A place below the folder that may be written to.

        Raises
        ------
        RequestError
            Nothing may be written, or the name is none of a file.
        """
        if self.write_to is None:
            raise RequestError("start 'sgstore serve' with --write-to DIR to write files", 403)
        fits = name and name == Path(name).name and not name.startswith(".") and name.isprintable()
        if not fits or len(name) > 100 or os.sep in name:
            raise RequestError("name: expected the name of a file, without a folder")
        return self.write_to / name


async def page_of(request: Request, script: str = "main.js") -> Response:
    """A page, by its first script; its nonce is that of the policy of this answer."""
    text = (PAGE / "index.html").read_text(encoding="utf-8").replace(_SCRIPT, f"js/{script}")
    nonce = request.scope["state"]["nonce"]
    return Response(text.replace(_NONCE, nonce), media_type="text/html")


async def given_file(request: Request) -> Response:
    """A module, a style or a licence of the page."""
    path = FILES.get(request.path_params["name"])
    if path is None:
        return JSONResponse({"reason": "no such file"}, 404)
    kind = _TYPES[path.suffix]
    return FileResponse(path, media_type=kind, headers={"cache-control": "no-cache"})


_QUESTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(("parts", "why"), ("text", "parameters", "trace", "seq", "binding")),
    "check": ("text", "parameters"),
    "coverage": ("what", "abstraction"),
    "select": ("clips", "abstraction"),
}
_WORK: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(("lock", "export"), ("clips", "name", "format")),
    "diff": ("abstraction",),
}
"""The fields of a question, and of a longer piece of work, by its name."""


def answered(found: Any) -> Response:
    """Answer of columns as bytes, of a picture with its type, or of plain values."""
    if isinstance(found, bytes):
        return Response(found, media_type="application/octet-stream")
    if isinstance(found, tuple):
        headers = {"cache-control": "private, max-age=3600"}
        return Response(found[0], media_type=found[1], headers=headers)
    return JSONResponse(found)


def _is_sql(text: str) -> bool:
    """Tell whether a text is a statement of SQL, by its first word."""
    words = [line for line in text.splitlines() if not line.strip().startswith("--")]
    first = (" ".join(words).split(maxsplit=1) or [""])[0].upper()
    return first in {"SELECT", "WITH", "FROM", "DESCRIBE", "SUMMARIZE", "SHOW"}


def _files() -> dict[str, Path]:
    """Files of the page by what the page calls them; nothing else is given."""
    return {
        path.relative_to(PAGE).as_posix(): path
        for path in sorted(PAGE.rglob("*"))
        if path.suffix in _TYPES and path.is_file()
    }


FILES: Final = _files()


def application(explorer: Explorer, token: str, hosts: tuple[str, ...], cookie: str) -> Guard:
    """The ASGI application of a store, behind a token.

    Parameters
    ----------
    explorer : Explorer
    token : str
    hosts : tuple of str
        Hosts, with ports, under which it may be asked for.
    cookie : str
        Name of the cookie that holds the token.
    """
    table: list[tuple[str, Endpoint]] = [
        ("GET /", page_of),
        ("GET /static/{name:path}", given_file),
        ("GET /api/store", explorer.about),
        ("POST /api/find", explorer.find),
        ("DELETE /api/find/{key}", explorer.cancel),
        ("GET /api/notes", explorer.tags),
        ("POST /api/notes", explorer.tags),
        *(
            (
                f"{'POST' if 'frames' in told else 'GET'} /api/{name}",
                partial(explorer.read, name=name),
            )
            for name, told in READS.items()
        ),
        *((f"POST /api/{name}", partial(explorer.one, ask=name)) for name in _QUESTIONS),
        *((f"POST /api/{name}", partial(explorer.work, name=name)) for name in _WORK),
    ]

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        yield
        await asyncio.get_running_loop().run_in_executor(None, explorer.close)

    return Guard(Starlette(routes=routed(table), lifespan=lifespan), token, hosts, cookie)


def routed(table: Iterable[tuple[str, Endpoint]]) -> list[Route]:
    """Routes of endpoints, each by its method and its path."""
    pairs = ((*where.split(), endpoint) for where, endpoint in table)
    return [Route(path, _told(endpoint), methods=[method]) for method, path, endpoint in pairs]


def _told(endpoint: Endpoint) -> Endpoint:
    """An endpoint whose errors are answers."""

    async def run(request: Request) -> Response:
        try:
            return await endpoint(request)
        except SgstoreError as error:
            return JSONResponse(error.as_dict(), _status(error))

    return run


def _status(error: SgstoreError) -> int:
    """The status of an answer that tells of an error."""
    if isinstance(error, RequestError):
        return error.status
    is_query = isinstance(error, QueryError | SqlError)
    return 404 if isinstance(error, StoreError) and not is_query else 422
