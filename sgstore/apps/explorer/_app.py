"""Web application of the explorer: all endpoints of its page."""

from __future__ import annotations

import asyncio
import mimetypes
import os
import threading
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from dataclasses import astuple
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final, TypeVar

from starlette.applications import Starlette
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from sgstore.apps.explorer._guard import Guard
from sgstore.apps.explorer._requests import MOST_BODY, RequestError, fields_of, one_of, taken
from sgstore.apps.explorer._store_reader import READS, Reads
from sgstore.apps.explorer._wire import PAGE, as_json
from sgstore.apps.sandbox import Errand, SandboxPool
from sgstore.base.output_files import write_bytes
from sgstore.base.quoting import is_statement
from sgstore.errors import QueryError, SgstoreError, SqlError, StoreError
from sgstore.model.user_notes import Note, NotesFile, write_table
from sgstore.query import Store

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable, Mapping

    from starlette.requests import Request
    from starlette.types import Receive, Scope, Send

    Endpoint = Callable[[Request], Awaitable[Response]]
    Replies = AsyncGenerator[dict[str, Any]]

T = TypeVar("T")

MOST_QUESTIONS: Final = 8
"""Largest number of long queries at the same time. Further queries are rejected with status 503."""

SMALL: Final = "parts", "values", "why"
"""Names of short queries about one match. They have an additional slot and sandbox process."""

TIMEOUT_S: Final = 60.0
"""Time limit of a query of a user; s."""

LONGEST_S: Final = 86_400.0
"""Time limit for writing a lock, an export, or a comparison of stores; s."""

MOST_MATCHES: Final = 50_000
"""Largest number of matches and rows of a query. The page shows if there are more."""

MOST_TAGGED: Final = 10_000
"""Largest number of frames that can have the same tag."""

WORKER: Final = "sgstore.apps.explorer._worker"
FIRST: Final = {"ask": "rows", "text": "MATCH (e:Ego) RETURN e.id LIMIT 1", "parameters": {}}
"""First query of each sandbox. It loads the language, the catalogue and the database."""

_NONCE: Final = "{{nonce}}"
_SCRIPT: Final = "js/main.js"


async def _lines(replies: Replies) -> AsyncGenerator[bytes]:
    async for reply in replies:
        yield as_json(reply) + b"\n"


async def _last(replies: Replies) -> AsyncGenerator[bytes]:
    """Read all replies of a query, and yield the last one as JSON. It contains the complete result."""
    *_, last = [reply async for reply in replies]
    yield as_json(last)


class _Answer(StreamingResponse):
    """Streamed HTTP response with the results of a query. If the response ends early, the query is cancelled.

    Parameters
    ----------
    pool : function
        Function that returns the sandboxes or an errand; it may be slow.
    question : mapping
    key : str
        Key for cancelling.
    told : function
        Function that converts the replies to bytes.
    media_type : str
    """

    def __init__(
        self,
        pool: Callable[[], SandboxPool | Errand],
        question: Mapping[str, Any],
        key: str,
        told: Callable[[Replies], AsyncGenerator[bytes]] = _lines,
        media_type: str = "application/x-ndjson",
    ) -> None:
        super().__init__(told(self._replies()), media_type=media_type)
        self._pool, self._question, self._key = pool, question, key
        self.is_small = question["ask"] in SMALL
        self._asked: SandboxPool | Errand | None = None
        self._gone = threading.Event()
        self._loop = asyncio.get_running_loop()
        self._found: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self.end()

    def ask(self) -> None:
        """Run the query of the HTTP response in a thread. An error is sent as a reply."""
        tell = partial(self._loop.call_soon_threadsafe, self._found.put_nowait)
        try:
            self._asked = self._pool()
            if self._gone.is_set():
                return
            for reply in self._asked.ask(self._question, self._key):
                tell(reply)
        except SgstoreError as error:
            tell({"error": error.as_dict()})
        except BaseException as error:
            tell({"error": {"error": "SgstoreError", "reason": f"the question failed: {error!r}"}})
            raise
        finally:
            tell(None)

    async def _replies(self) -> Replies:
        while (reply := await self._found.get()) is not None:
            yield reply

    def end(self) -> None:
        """Cancel the query of the HTTP response if it still runs."""
        self._gone.set()  # it may not have begun
        if self._asked is not None:
            self._asked.cancel(self._key)


class Explorer:
    """Objects that all endpoints of the web page share: stores, sandboxes, tags and running queries.

    Parameters
    ----------
    path : Path
        Path of the store.
    other : Path, optional
        A second store for comparison.
    write_to : Path, optional
        Folder for locks and clips; without it only tags and the last selection are written.

    Attributes
    ----------
    busy : set
        Responses with running queries.

    Raises
    ------
    StoreError
        The store is missing.
    """

    def __init__(
        self, path: Path, *, other: Path | None = None, write_to: Path | None = None
    ) -> None:
        self.stores = {"a": Store(path)}
        if other is not None:
            self.stores["b"] = Store(other)
        self.write_to = write_to
        self.notes = NotesFile(Path(path))
        self.selection = Path(path).with_name(f"{Path(path).name}.selection.txt")
        self.reads = {side: Reads(store) for side, store in self.stores.items()}
        self._stamp = self.notes.stamp()
        self._folder = TemporaryDirectory(prefix="sgstore-notes-")
        self._pools = {side: self._pool(side) for side in self.stores}
        self._threads = ThreadPoolExecutor(MOST_QUESTIONS + len(SMALL) + 4, "sgstore question")
        self._ended = threading.Event()
        self.busy = set[_Answer]()

    def warm(self) -> None:
        """Start a thread that reads the road maps of the stores before the first request."""
        for reads in self.reads.values():
            self._threads.submit(reads.warm, self._ended)

    def stop(self) -> None:
        """Cancel all running queries. The HTTP responses of these queries end with an error."""
        for answer in tuple(self.busy):
            answer.end()

    def close(self) -> None:
        """Stop the sandboxes, wait until running reads have ended, and close the stores."""
        self._ended.set()
        self.stop()
        for pool in self._pools.values():
            pool.close()
        # The process must not end while a thread is in the database.
        self._threads.shutdown(cancel_futures=True)
        self._folder.cleanup()
        for store in self.stores.values():
            store.close()

    def _pool(self, side: str) -> SandboxPool:
        return SandboxPool(
            self.stores[side].file.path,
            timeout_s=TIMEOUT_S,
            max_rows=MOST_MATCHES,
            tables=self._tables() if side == "a" else {},
            worker=WORKER,
            small=SMALL,
            first=FIRST,
        )

    def _tables(self) -> dict[str, Path]:
        """Return the table file with the tags of users, by table name, for queries; empty without tags."""
        found = self.notes.read()
        if not found:
            return {}
        table = Path(self._folder.name) / "notes.csv"
        write_table(found, table)
        return {"notes": table}

    def pool(self, side: str, text: str) -> SandboxPool:
        """Return the sandbox processes for a query on a store. If tags have changed, start new processes."""
        if side == "a" and "notes" in text.lower() and self._stamp != self.notes.stamp():
            self._stamp = self.notes.stamp()
            old, self._pools["a"] = self._pools["a"], self._pool("a")
            self._threads.submit(old.close)
        return self._pools[side]

    def _side(self, fields: Mapping[str, Any]) -> str:
        return one_of(*self.stores)(fields.get("side"), "side")

    def _answer(
        self, pool: Callable[[], SandboxPool | Errand], question: Mapping[str, Any], *how: Any
    ) -> _Answer:
        """Start a query in a thread, and return the HTTP response that streams its results.

        Raises
        ------
        RequestError
            Too many queries are running.
        """
        is_small = question["ask"] in SMALL
        count = len(self.busy) if is_small else sum(not one.is_small for one in self.busy)
        most = MOST_QUESTIONS + is_small * len(SMALL)
        if count >= most:
            raise RequestError(f"{most} questions are under way; try again later", 503)
        answer = _Answer(pool, question, *how)
        self.busy.add(answer)
        asking = self._threads.submit(answer.ask)
        asking.add_done_callback(lambda _: self.busy.discard(answer))
        return answer

    async def find(self, request: Request) -> Response:
        """Endpoint that streams the matches of a pattern or the rows of an SQL statement, as JSON lines."""
        fields = await fields_of(request)
        question = taken(fields, "ask", "text", "parameters")
        if is_statement(question["text"]):
            question["ask"] = "sql"
        key, side = taken(fields, "id")["id"] or uuid.uuid4().hex, self._side(fields)
        return self._answer(partial(self.pool, side, question["text"]), question, key)

    async def cancel(self, request: Request) -> Response:
        """Endpoint that stops a running query."""
        key = str(request.path_params["key"])
        done = any(pool.cancel(key) for pool in self._pools.values())
        return JSONResponse({"cancelled": done})

    async def one(self, request: Request, ask: str) -> Response:
        """Endpoint for a query whose complete result is sent at once, such as the verdicts of checks."""
        fields = await fields_of(request)
        side = self._side(fields)
        question = {"ask": ask, **taken(fields, *_QUESTIONS[ask])}
        if "seq" in question:
            where = question["trace"], question["seq"]
            question["frame"] = await self.threaded(self.reads[side].frame_id, *where)
        pool = partial(self.pool, side, str(question.get("text", "")))
        return self._answer(pool, question, uuid.uuid4().hex, _last, "application/json")

    async def threaded(self, ask: Callable[..., T], *arguments: Any) -> T:
        """Run a slow function in a thread, and return its result.

        Raises
        ------
        RequestError
            The server ends.
        """
        loop = asyncio.get_running_loop()
        try:
            return await loop.run_in_executor(self._threads, ask, *arguments)
        except asyncio.CancelledError:
            raise RequestError("the server ends", 503) from None

    async def read(self, request: Request, name: str) -> Response:
        """Endpoint that reads data of a store: binary columns, a picture, or JSON values."""
        fields = await fields_of(request)
        reads = self.reads[self._side(fields)]
        ask = partial(getattr(reads, name), **taken(fields, *READS[name]))
        return answered(await self.threaded(ask))

    async def about(self, _: Request) -> Response:
        """Endpoint that returns the traces of each store, and whether the page may write files."""
        sides = {side: await self.threaded(reads.about) for side, reads in self.reads.items()}
        writing = self.write_to is not None
        return JSONResponse({**sides["a"], "other": sides.get("b"), "writing": writing})

    async def stamps(self, _: Request) -> Response:
        """Endpoint that returns a short text for each store. The text changes whenever the store changes."""
        return JSONResponse({side: one.file.stamp for side, one in self.stores.items()})

    async def tags(self, request: Request) -> Response:
        """Endpoint that returns all tags of users; POST adds or removes a tag."""
        fields = await fields_of(request)
        if request.method == "POST":
            told = taken(fields, "trace", "seq", "tag", "note", "do")
            gone = told.pop("do") == "remove"
            first = told["seq"]
            last = taken({"last": fields.get("last", first)}, "last")["last"]
            if not first <= last < first + MOST_TAGGED:
                raise RequestError(f"last: expected at most {MOST_TAGGED} frames from seq")
            for seq in {first, last}:
                await self.threaded(self.reads["a"].frame_id, told["trace"], seq)
            await self.threaded(partial(self.notes.add, Note(**told), last, gone=gone))
        found = await self.threaded(self.notes.read)
        notes = [astuple(note) for note in found]
        return JSONResponse({"notes": notes, "file": self.notes.path.name})

    async def last_selection(self, request: Request) -> Response:
        """Endpoint that returns the last selection of matches in the store as text; POST replaces it."""
        if request.method == "POST":
            ticks = taken(await fields_of(request), "ticks")["ticks"]
            await self.threaded(write_bytes, self.selection, ticks.encode())
            return JSONResponse({"file": self.selection.name})
        return JSONResponse({"ticks": await self.threaded(self._ticks)})

    def _ticks(self) -> str:
        with suppress(FileNotFoundError), self.selection.open("rb") as file:
            ticks = file.read(MOST_BODY).decode(errors="replace")
            return str(taken({"ticks": ticks}, "ticks")["ticks"])
        return ""

    async def work(self, request: Request, name: str) -> Response:
        """Endpoint that runs a long task, such as an export, and streams its progress and result as JSON."""
        fields = await fields_of(request)
        question = {"ask": name, **taken(fields, *_WORK[name])}
        if "name" in question:
            question["to"] = str(self.target(question.pop("name")))
        elif name == "diff":
            if "b" not in self.stores:
                told = "the server has no second store; start 'sgstore serve STORE' with --compare OTHER"
                raise RequestError(told, 404)
            question["other"] = str(self.stores["b"].file.path.absolute())
        path = self.stores["a"].file.path
        errand = Errand(path, timeout_s=LONGEST_S, memory=1 << 30, worker=WORKER)
        return self._answer(lambda: errand, question, "")

    def target(self, name: str) -> Path:
        """Return the path for a new file in the folder that the page may write to.

        Raises
        ------
        RequestError
            Writing is disabled, or the name is not a file name.
        """
        if self.write_to is None:
            raise RequestError("start 'sgstore serve' with --write-to DIR to write files", 403)
        fits = name and name == Path(name).name and not name.startswith(".") and name.isprintable()
        if not fits or len(name) > 100 or os.sep in name:
            raise RequestError("name: expected the name of a file, without a folder")
        return self.write_to / name


async def page_of(request: Request, script: str = "main.js") -> Response:
    """Return the HTML page. Insert its first script, and the nonce of the content security policy."""
    text = (PAGE / "index.html").read_text(encoding="utf-8").replace(_SCRIPT, f"js/{script}")
    nonce = request.scope["state"]["nonce"]
    return Response(text.replace(_NONCE, nonce), media_type="text/html")


_QUESTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(SMALL, ("text", "parameters", "trace", "seq", "binding")),
    **dict.fromkeys(("check", "nearest"), ("text", "parameters")),
    "coverage": ("what", "abstraction"),
    "select": ("clips", "abstraction"),
}
_WORK: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(("lock", "export"), ("clips", "name", "format")),
    "download": ("clips",),
    "diff": ("abstraction",),
}
"""Names of queries and longer tasks → fields of their requests."""


_METHODS: Final = {name: "POST" if "frames" in told else "GET" for name, told in READS.items()}


def answered(found: Any) -> Response:
    """Return an HTTP response for binary columns, for a picture with its media type, or for JSON values."""
    if isinstance(found, bytes):
        return Response(found, media_type="application/octet-stream")
    if isinstance(found, tuple):
        headers = {"cache-control": "private, max-age=3600"}
        return Response(found[0], media_type=found[1], headers=headers)
    return JSONResponse(found)


def application(explorer: Explorer, token: str, hosts: tuple[str, ...], cookie: str) -> Guard:
    """Return the ASGI application of the explorer. Each request must have a token.

    Parameters
    ----------
    explorer : Explorer
    token : str
    hosts : tuple of str
        Permitted hosts, with ports.
    cookie : str
        Name of the cookie with the token.
    """
    table: list[tuple[str, Endpoint]] = [
        ("GET /", page_of),
        ("GET /api/store", explorer.about),
        ("GET /api/stamp", explorer.stamps),
        ("POST /api/find", explorer.find),
        ("DELETE /api/find/{key}", explorer.cancel),
        ("GET /api/notes", explorer.tags),
        ("POST /api/notes", explorer.tags),
        ("GET /api/selection", explorer.last_selection),
        ("POST /api/selection", explorer.last_selection),
        *((f"{_METHODS[name]} /api/{name}", partial(explorer.read, name=name)) for name in READS),
        *((f"POST /api/{name}", partial(explorer.one, ask=name)) for name in _QUESTIONS),
        *((f"POST /api/{name}", partial(explorer.work, name=name)) for name in _WORK),
    ]

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        yield
        await asyncio.get_running_loop().run_in_executor(None, explorer.close)

    return Guard(application_of(table, lifespan), token, hosts, cookie)


class _PageFiles(StaticFiles):
    """Static files of the page. Browsers must check for a new version of a file before each use."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["cache-control"] = "no-cache"
        return response


def application_of(
    table: Iterable[tuple[str, Endpoint]], lifespan: Callable[[Any], Any] | None = None
) -> Starlette:
    """Return an ASGI application with the given endpoints and the static files of the page."""
    mimetypes.add_type("text/javascript", ".js")  # some systems map it to another type
    pairs = ((*where.split(), endpoint) for where, endpoint in table)
    routes = [Route(path, endpoint, methods=[method]) for method, path, endpoint in pairs]
    files = Mount("/static", _PageFiles(directory=PAGE, follow_symlink=True))
    handlers = {SgstoreError: _refusal}
    return Starlette(routes=[*routes, files], exception_handlers=handlers, lifespan=lifespan)


async def _refusal(_: Request, error: Any) -> Response:
    is_query = isinstance(error, QueryError | SqlError)
    usual = 404 if isinstance(error, StoreError) and not is_query else 422
    return JSONResponse(error.as_dict(), getattr(error, "status", usual))
