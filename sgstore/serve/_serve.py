"""The server as a program: an address with a token, and an end by Ctrl-C."""

from __future__ import annotations

import secrets
import socket
import threading
import webbrowser
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Final

from sgstore.errors import ConfigError, MissingExtraError, SgstoreError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

HOST: Final = "127.0.0.1"


def serve(
    store: Path,
    *,
    host: str = HOST,
    port: int = 0,
    other: Path | None = None,
    write_to: Path | None = None,
    browse: bool = False,
    on_start: Callable[[str], None] = print,
) -> None:
    """Serve the explorer of a store until this process is interrupted.

    Parameters
    ----------
    store : Path
    host : str
        Address to listen on. Others than this machine's see whatever the token lets them see.
    port : int
        0: any that is free.
    other : Path, optional
        A second store to compare with.
    write_to : Path, optional
        Folder for locks and clips; without it the page writes no files but tags.
    browse : bool
        Whether the address is opened in a browser.
    on_start : function
        Told the address, with its token.

    Raises
    ------
    StoreError
        There is no such store.
    ConfigError
        The address cannot be listened on.
    MissingExtraError
        The packages of the extra ``ui`` are not installed.
    """
    try:
        import uvicorn

        from sgstore.serve._app import Explorer, application
    except ImportError as error:
        raise MissingExtraError("the explorer", "ui") from error
    with ExitStack() as unless_begun:
        explorer = Explorer(store, other=other, write_to=write_to)
        unless_begun.callback(explorer.close)
        listening = unless_begun.enter_context(_listening(host, port))
        number = listening.getsockname()[1]
        token = secrets.token_urlsafe(24)
        names = dict.fromkeys((f"[{host}]" if ":" in host else host, HOST, "localhost"))
        hosts = tuple(f"{name}:{number}" for name in names)
        config = uvicorn.Config(
            application(explorer, token, hosts, f"sgstore-{number}"),
            log_level="warning",
            access_log=False,
            server_header=False,
            lifespan="on",  # at its end the explorer is closed
            timeout_graceful_shutdown=1,  # a question under way does not keep the server
        )
        threading.Thread(target=_warm, args=(explorer,), daemon=True).start()
        address = f"http://{hosts[0]}/?token={token}"
        on_start(address)
        if browse:
            webbrowser.open(address)
        unless_begun.pop_all()
    with suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[listening])


def _warm(explorer: object) -> None:
    """Read maps before somebody asks for them."""
    for reads in explorer.reads.values():  # type: ignore[attr-defined]
        with suppress(SgstoreError):
            reads.warm()


def _listening(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    found = socket.socket(family, socket.SOCK_STREAM)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind((host, port))
        found.listen()  # who has the address waits in line until the server has begun
    except OSError as error:
        found.close()
        raise ConfigError(f"{host}:{port} cannot be listened on: {error.strerror}") from error
    return found
