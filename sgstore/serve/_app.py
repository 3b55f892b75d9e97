"""The application: what the page can ask, and who answers it."""

from __future__ import annotations

import asyncio
import json
import os
import threading
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final, TypeVar

from starlette.applications import Starlette
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from sgstore.errors import QueryError, SgstoreError, SqlError, StoreError
from sgstore.query import Store
from sgstore.sandbox import SandboxPool
from sgstore.serve._guard import Guard
from sgstore.serve._measures import differing, exported, locked_clips, measured, measured_clips
from sgstore.serve._notes import Note, NotesFile, write_table
from sgstore.serve._reads import Reads
from sgstore.serve._requests import Fields, RequestError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Mapping

    from starlette.requests import Request

    Endpoint = Callable[[Request], Awaitable[Response]]

T = TypeVar("T")

PAGE: Final = Path(__file__).parent / "page"

MOST_QUESTIONS: Final = 8
"""Questions under way; one more is refused with 503."""

TIMEOUT_S: Final = 60.0
"""Longest time for a question that somebody typed; s."""

MOST_MATCHES: Final = 50_000
"""Matches and rows of a question; the page says if there are more."""

_TYPES: Final = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
    ".txt": "text/plain",
}
_NONCE: Final = "{{nonce}}"


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
        self._threads = ThreadPoolExecutor(MOST_QUESTIONS + 2, "sgstore question")
        self._under_way = 0

    def close(self) -> None:
        """End the sandboxes, and give the stores back."""
        for pool in self._pools.values():
            pool.close()
        self._threads.shutdown(wait=False, cancel_futures=True)
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
            worker="sgstore.serve._worker",
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

    async def replies(
        self, question: Mapping[str, Any], key: str = "", side: str = "a"
    ) -> AsyncIterator[dict[str, Any]]:
        """Replies of a sandbox, as they come; an error is one of them. Who stops reading cancels.

        Raises
        ------
        RequestError
            There are too many questions under way.
        """
        if self._under_way >= MOST_QUESTIONS:
            raise RequestError(f"{MOST_QUESTIONS} questions are under way; try again later", 503)
        self._under_way += 1
        key, loop = key or uuid.uuid4().hex, asyncio.get_running_loop()
        found: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
        tell = partial(loop.call_soon_threadsafe, found.put_nowait)
        pools: list[SandboxPool] = []
        gone = threading.Event()

        def ask() -> None:
            try:
                pools.append(self.pool(side, str(question.get("text", ""))))
                if gone.is_set():
                    return
                for reply in pools[0].ask(question, key):
                    tell(reply)
            except SgstoreError as error:
                tell({"error": error.as_dict()})
            except BaseException:
                tell({"error": {"error": "SgstoreError", "reason": "the question failed"}})
                raise
            finally:
                tell(None)

        try:
            self._threads.submit(ask)
            while (reply := await found.get()) is not None:
                yield reply
        finally:
            self._under_way -= 1
            gone.set()  # it may not have begun
            for pool in pools:
                pool.cancel(key)

    async def find(self, request: Request) -> Response:
        """Matches of a pattern, or rows of SQL: lines of JSON, as they come."""
        fields = await Fields.of(request)
        text = fields.text("text")
        kind = "sql" if _is_sql(text) else fields.one_of("ask", "matches", "rows")
        question = {"ask": kind, "text": text, "parameters": fields.parameters()}
        key, side = fields.text("id", ""), fields.one_of("side", *self._pools)
        started = time.perf_counter()
        found = self.replies(question, key, side)
        first = await anext(found, {})

        async def lines() -> AsyncIterator[bytes]:
            try:
                reply: dict[str, Any] | None = {"kind": kind, **first}
                while reply is not None:
                    yield json.dumps(reply).encode() + b"\n"
                    reply = await anext(found, None)
                ms = (time.perf_counter() - started) * 1e3
                yield json.dumps({"ms": round(ms, 1)}).encode() + b"\n"
            finally:
                await found.aclose()  # type: ignore[attr-defined]

        return StreamingResponse(lines(), media_type="application/x-ndjson")

    async def cancel(self, request: Request) -> Response:
        """Stop a question."""
        key = str(request.path_params["key"])
        done = any(pool.cancel(key) for pool in self._pools.values())
        return JSONResponse({"cancelled": done})

    async def one(self, request: Request, ask: str) -> Response:
        """The whole answer to a question: lanes of truth, why not, verdicts. An error is an answer, too."""
        fields = await Fields.of(request)
        question: dict[str, Any] = {"ask": ask, "text": fields.text("text")}
        question["parameters"] = fields.parameters()
        if ask != "check":
            trace, seq = fields.text("trace"), fields.whole("seq")
            side = fields.one_of("side", *self._pools)
            ref = await self.threaded(self.reads[side].frame_id, trace, seq)
            question |= {"frame": ref, "binding": fields.binding()}
        else:
            side = fields.one_of("side", *self._pools)
        found = [reply async for reply in self.replies(question, side=side)]
        if ask == "check":
            told = {"verdicts": [one["verdict"] for one in found if "verdict" in one], **found[-1]}
            told.pop("verdict", None)
            return JSONResponse(told)
        return JSONResponse(found[-1])

    # What the page reads by trace and frame --------------------------------------------------------

    async def threaded(self, ask: Callable[..., T], *arguments: Any) -> T:
        """Answer of a function that takes its time."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, partial(ask, *arguments))

    async def read(self, request: Request, name: str) -> Response:
        """Something that is read of a store: columns as bytes, a picture, or plain values."""
        fields = await Fields.of(request)
        reads = self.reads[fields.one_of("side", *self.reads)]
        ask = getattr(reads, name)(fields)
        found = await self.threaded(ask)
        if isinstance(found, bytes):
            return Response(found, media_type="application/octet-stream")
        if isinstance(found, tuple):
            data, kind = found
            headers = {"cache-control": "private, max-age=3600"}
            return Response(data, media_type=kind, headers=headers)
        return JSONResponse(found)

    async def about(self, _: Request) -> Response:
        """The stores: their traces, and what the page may do."""
        sides = {side: await self.threaded(reads.about) for side, reads in self.reads.items()}
        writing = self.write_to is not None
        return JSONResponse({**sides["a"], "other": sides.get("b"), "writing": writing})

    async def page(self, request: Request) -> Response:
        """The page itself; its nonce is that of the policy of this answer."""
        text = (PAGE / "index.html").read_text(encoding="utf-8")
        nonce = request.scope["state"]["nonce"]
        return Response(text.replace(_NONCE, nonce), media_type="text/html")

    async def file(self, request: Request) -> Response:
        """A module, a style or a licence of the page."""
        name = request.path_params["name"]
        path = FILES.get(name)
        if path is None:
            return JSONResponse({"reason": "no such file"}, 404)
        kind = _TYPES[path.suffix]
        return FileResponse(path, media_type=kind, headers={"cache-control": "no-cache"})

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
        return JSONResponse(
            {
                "notes": [[n.trace, n.seq, n.tag, n.note, n.who, n.at] for n in found],
                "file": self.notes.path.name,
            }
        )

    async def work(self, request: Request, name: str) -> Response:
        """A longer piece of work, as server-sent events: what is done of it, then its result or an error."""
        fields = await Fields.of(request)
        work = _WORK[name](self, fields)
        loop = asyncio.get_running_loop()
        events: asyncio.Queue[tuple[str, Any] | None] = asyncio.Queue()
        tell = partial(loop.call_soon_threadsafe, events.put_nowait)

        def progress(done: int, of: int) -> None:
            tell(("progress", [done, of]))

        def run() -> None:
            try:
                tell(("result", work(progress)))
            except SgstoreError as error:
                tell(("error", error.as_dict()))
            except BaseException:
                tell(("error", {"error": "SgstoreError", "reason": "it failed"}))
                raise
            finally:
                tell(None)

        async def lines() -> AsyncIterator[str]:
            self._threads.submit(run)
            while (event := await events.get()) is not None:
                yield f"event: {event[0]}\ndata: {json.dumps(event[1])}\n\n"

        return StreamingResponse(lines(), media_type="text/event-stream")

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


_WORK: Final[Mapping[str, Callable[[Explorer, Fields], Callable[..., Any]]]] = {
    "coverage": lambda of, fields: partial(
        measured,
        of.store,
        fields.one_of("what", "classes", "growth", "combos"),
        fields.text("abstraction", "RSV"),
    ),
    "select": lambda of, fields: partial(
        measured_clips, of.store, fields.clips(), fields.text("abstraction", "RSV")
    ),
    "lock": lambda of, fields: partial(
        locked_clips, of.store, fields.clips(), of.target(fields.text("name"))
    ),
    "export": lambda of, fields: partial(
        exported,
        of.store,
        fields.clips(),
        of.target(fields.text("name")),
        fields.text("format", "mcap"),
    ),
    "diff": lambda of, fields: partial(differing, of.store, of.other, fields.text("text", "")),
}


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

_READ: Final = ("thumbs", "states", "static", "map", "frame", "picture", "series")


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

    def told(endpoint: Endpoint) -> Endpoint:
        async def answered(request: Request) -> Response:
            try:
                return await endpoint(request)
            except SgstoreError as error:
                return JSONResponse(error.as_dict(), _status(error))

        return answered

    def bound(method: Callable[..., Awaitable[Response]], name: str) -> Endpoint:
        return told(lambda request: method(request, name))

    get, post = ["GET"], ["POST"]
    routes = [
        Route("/", told(explorer.page), methods=get),
        Route("/static/{name:path}", told(explorer.file), methods=get),
        Route("/api/store", told(explorer.about), methods=get),
        Route("/api/words", bound(explorer.read, "words"), methods=get),
        Route("/api/library", bound(explorer.read, "library"), methods=get),
        Route("/api/find", told(explorer.find), methods=post),
        Route("/api/find/{key}", told(explorer.cancel), methods=["DELETE"]),
        *(
            Route(f"/api/{n}", bound(explorer.one, n), methods=post)
            for n in ("parts", "why", "check")
        ),
        *(
            Route(f"/api/{n}", bound(explorer.read, n), methods=post if n == "thumbs" else get)
            for n in _READ
        ),
        Route("/api/notes", told(explorer.tags), methods=[*get, *post]),
        *(Route(f"/api/{n}", bound(explorer.work, n), methods=post) for n in _WORK),
    ]

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        yield
        await asyncio.get_running_loop().run_in_executor(None, explorer.close)

    return Guard(Starlette(routes=routes, lifespan=lifespan), token, hosts, cookie)


def _status(error: SgstoreError) -> int:
    """The status of an answer that tells of an error."""
    if isinstance(error, RequestError):
        return error.status
    if isinstance(error, QueryError | SqlError):
        return 422
    return 404 if isinstance(error, StoreError) else 422
