"""Start of the local web server. It prints an address with a token, and ends at Ctrl-C."""

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

    from sgstore.apps.explorer._app import Explorer, application
    from sgstore.apps.explorer._guard import host_of
    from sgstore.apps.explorer._live import live_application
except ImportError as error:
    raise MissingExtraError("the explorer", "ui") from error

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable
    from pathlib import Path

    from sgstore.apps.explorer._guard import Guard
    from sgstore.apps.explorer._live import LiveRun

HOST: Final = "127.0.0.1"
EVERYWHERE: Final = {"0.0.0.0", "::", ""}  # noqa: S104 - only where somebody asks for it
"""Addresses that mean all network interfaces. With them, the host names of this machine are allowed, too."""


class _Server(uvicorn.Server):
    """Web server that ends its running responses before it closes the connections.

    Parameters
    ----------
    config : uvicorn.Config
    stop : function
        Function that ends the running responses.
    """

    def __init__(self, config: uvicorn.Config, stop: Callable[[], None]) -> None:
        super().__init__(config)
        self._stop = stop

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the running responses, then close the connections."""
        self._stop()
        await super().shutdown(sockets)


def serve(  # noqa: PLR0913  one argument per option
    store: Path,
    *,
    host: str = HOST,
    port: int = 0,
    other: Path | None = None,
    write_to: Path | None = None,
    browse: bool = False,
    link: str = "",
    on_start: Callable[[str], None] = print,
) -> None:
    """Serve the explorer page of a store until the user interrupts the process.

    Parameters
    ----------
    store : Path
    host : str
        Address to listen on. Other machines can connect if it is not local; the token protects the
        page. ``0.0.0.0`` means all addresses of this machine, and its names.
    port : int
        0 means any free port.
    other : Path, optional
        A second store for comparison.
    write_to : Path, optional
        Folder for locks and clips; without it the page writes only tags and the last selection.
    browse : bool
        True to open the address in a browser.
    link : str
        A link copied from the page of another server, or its part after ``#``: the first view.
    on_start : function
        Called with the address and its token.

    Raises
    ------
    StoreError
        The store is missing.
    ConfigError
        The server cannot listen on the address.
    """
    with closing(Explorer(store, other=other, write_to=write_to)) as explorer:
        explorer.warm()
        make = partial(application, explorer)
        with (
            _begun(
                make, explorer.stop, host, port, (on_start, webbrowser.open)[: 1 + browse], link
            ) as (
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
    """Serve the page of a monitor on this machine until the end of the ``with`` block.

    Parameters
    ----------
    run : LiveRun
    port, browse, on_start
        As in :func:`serve`.

    Raises
    ------
    ConfigError
        The server cannot listen on the address.
    """
    make = partial(live_application, run)
    told = (on_start, webbrowser.open)[: 1 + browse]
    with _begun(make, run.stop, HOST, port, told) as (server, listening):
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
    stop: Callable[[], None],
    host: str,
    port: int,
    told: Iterable[Callable[[str], object]],
    link: str = "",
) -> Generator[tuple[uvicorn.Server, socket.socket]]:
    """Yield a web server before its start, and its socket. Report its address to the user."""
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
            lifespan="on",  # the explorer is closed at the end
            timeout_graceful_shutdown=1,  # a running query does not block the shutdown
        )
        view = link.partition("#")[2] if "#" in link else link
        address = f"http://{hosts[0]}/?token={token}" + f"#{view}" * bool(view)
        for tell in told:
            tell(address)
        yield _Server(config, stop), listening


def _listening(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With its protocol; otherwise asyncio omits TCP_NODELAY, and each response waits 40 ms for the
    # previous one.
    found = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind((host, port))
        found.listen()  # early connections wait until the server has started
    except OSError as error:
        found.close()
        raise ConfigError(f"{host}:{port} cannot be listened on: {error.strerror}") from error
    return found
