"""The server as a program: an address with a token, and an end by Ctrl-C."""

from __future__ import annotations

import secrets
import socket
import threading
import webbrowser
from contextlib import closing, contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Final

from sgstore.errors import ConfigError, MissingExtraError

try:
    import uvicorn

    from sgstore.serve._app import Explorer, application
    from sgstore.serve._guard import host_of
    from sgstore.serve._live import live_application
except ImportError as error:
    raise MissingExtraError("the explorer", "ui") from error

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable
    from pathlib import Path

    from sgstore.serve._guard import Guard
    from sgstore.serve._live import LiveRun

HOST: Final = "127.0.0.1"
EVERYWHERE: Final = {"0.0.0.0", "::", ""}  # noqa: S104 - only where somebody asks for it
"""Addresses that stand for all of this machine's; then it is called by its names, too."""


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
        Address to listen on. Others than this machine's see whatever the token lets them see. ``0.0.0.0`` are
        all of this machine's: it answers to each of them, and to the name of the machine.
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
    """
    with closing(Explorer(store, other=other, write_to=write_to)) as explorer:
        explorer.warm()
        make = partial(application, explorer)
        with (
            _begun(make, host, port, (on_start, webbrowser.open)[: 1 + browse]) as (
                server,
                listening,
            ),
            suppress(KeyboardInterrupt),
        ):
            server.run(sockets=[listening])


@contextmanager
def serve_live(
    run: LiveRun, *, port: int = 0, browse: bool = False, on_start: Callable[[str], None] = print
) -> Generator[None]:
    """Serve the page of a monitor beside it, on this machine alone; at the end of the block it is gone.

    Parameters
    ----------
    run : LiveRun
    port, browse, on_start
        As :func:`serve` takes them.

    Raises
    ------
    ConfigError
        The address cannot be listened on.
    """
    make = partial(live_application, run)
    with _begun(make, HOST, port, (on_start, webbrowser.open)[: 1 + browse]) as (server, listening):
        thread = threading.Thread(target=server.run, args=([listening],), daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.should_exit = True
            thread.join(5)


@contextmanager
def _begun(
    make: Callable[[str, tuple[str, ...], str], Guard],
    host: str,
    port: int,
    told: Iterable[Callable[[str], object]],
) -> Generator[tuple[uvicorn.Server, socket.socket]]:
    """A server of an application, and the socket that it is to listen on; its address is told."""
    with _listening(host, port) as listening:
        number = listening.getsockname()[1]
        token = secrets.token_urlsafe(24)
        mine = (socket.gethostname(), socket.getfqdn()) if host in EVERYWHERE else (host,)
        hosts = tuple(host_of(name, number) for name in (*mine, HOST, "localhost"))
        config = uvicorn.Config(
            make(token, hosts, f"sgstore-{number}"),
            log_level="warning",
            access_log=False,
            server_header=False,
            lifespan="on",  # at its end the explorer is closed
            timeout_graceful_shutdown=1,  # a question under way does not keep the server
        )
        address = f"http://{hosts[0]}/?token={token}"
        for tell in told:
            tell(address)
        yield uvicorn.Server(config), listening


def _listening(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With its protocol, or asyncio leaves out TCP_NODELAY, and each answer waits 40 ms for the one before it.
    found = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind((host, port))
        found.listen()  # who has the address waits in line until the server has begun
    except OSError as error:
        found.close()
        raise ConfigError(f"{host}:{port} cannot be listened on: {error.strerror}") from error
    return found
