"""Collections and recordings in object stores: an S3 server of this machine, which at times answers badly."""

from __future__ import annotations

import http.client
import os
import random
import shutil
import threading
import urllib.request
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any

import duckdb
import pytest
from oracle_worlds import random_trace, random_world, store_all
from recordings import Recorder, car
from thorough import LONG

from sgstore.apps.cli import run as run_verb
from sgstore.collection import (
    Collection,
    PartialAnswerError,
    commit,
    gc,
    land,
    pack,
    unpack,
    verify,
)
from sgstore.collection import _storage as places
from sgstore.errors import StoreError, TraceError, place_named
from sgstore.ingest import ingest, recordings
from sgstore.query import Store
from sgstore.store import StoreFile
from sgstore.store._locking import without_faults

pytest.importorskip("obstore", reason="the extra cluster is not installed")
server = pytest.importorskip("moto.server", reason="moto, an S3 server, is not installed")

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

NEAR = "MATCH (a:Car)-[:near]->(b) RETURN a.x, b.name, frame.seq"
KEYS = {
    "AWS_ACCESS_KEY_ID": "key",
    "AWS_SECRET_ACCESS_KEY": "secret",
    "AWS_REGION": "us-east-1",
    "AWS_EC2_METADATA_DISABLED": "true",
}


class Between(ThreadingHTTPServer):
    """Hands requests on to an S3 server, but for those that are to go wrong."""

    daemon_threads = True

    def __init__(self, behind: str) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.behind = behind
        self.seen: Counter[str] = Counter()
        self.wrong: Callable[[str, str, int], str] = lambda method, path, number: ""

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def _any(self) -> None:
        server: Any = self.server
        length = int(self.headers.get("Content-Length") or 0)
        body = self.rfile.read(length) if length else None
        key = f"{self.command} {self.path}"
        server.seen[key] += 1
        wrong = server.wrong(self.command, self.path, server.seen[key])
        if wrong.isdecimal():
            self._answer(int(wrong), {"Content-Length": "0"}, b"")
            return
        told = {k: v for k, v in self.headers.items() if k.lower() not in {"host", "connection"}}
        behind = http.client.HTTPConnection(server.behind)
        behind.request(self.command, self.path, body, told)
        answer = behind.getresponse()
        status, headers, data = answer.status, dict(answer.getheaders()), answer.read()
        behind.close()
        headers = {k: v for k, v in headers.items() if k.lower() != "transfer-encoding"}
        if self.command != "HEAD":
            headers["Content-Length"] = str(len(data))
        if wrong == "cut":
            data, self.close_connection = data[: len(data) // 2], True
        self._answer(status, headers, data)

    do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = _any  # noqa: N815

    def _answer(self, status: int, headers: dict[str, str], data: bytes) -> None:
        self.send_response_only(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_: Any) -> None:
        """Say nothing."""


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """The address of an S3 server."""
    moto = server.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    moto.start()
    host, port = moto.get_host_and_port()
    yield f"http://{host}:{port}"
    moto.stop()


@pytest.fixture
def between(s3: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Between]:
    """What stands between us and that server; the bucket ``fleet`` is there and empty."""
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("SGSTORE_CACHE", str(tmp_path / "cache"))
    urllib.request.urlopen(urllib.request.Request(f"{s3}/moto-api/reset", method="POST")).close()
    urllib.request.urlopen(urllib.request.Request(f"{s3}/fleet", method="PUT")).close()
    made = Between(s3.removeprefix("http://"))
    monkeypatch.setenv("AWS_ENDPOINT_URL", made.url)
    thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    yield made
    made.shutdown()
    thread.join()
    made.server_close()


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("one") / "one.sgstore"
    StoreFile.create(path)
    random_world(5, traces=4, frames=30, path=path).connection.close()
    return path


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two stores with other traces."""
    found: list[Path] = []
    for first in (11, 21):
        found.append(tmp_path_factory.mktemp("other") / "more.sgstore")
        StoreFile.create(found[-1])
        rng = random.Random(first)
        made = [random_trace(rng, first + i, 5, static=True) for i in range(2)]
        with duckdb.connect(str(found[-1])) as connection:
            without_faults(connection)
            store_all(connection, made, rng)
    return found


@pytest.fixture
def place(between: Between, path: Path) -> str:
    assert len(pack(path, "s3://fleet/all", bundle_traces=2).bundles) == 2
    between.seen.clear()
    return "s3://fleet/all"


def test_answers_are_those_of_one_store(place: str, path: Path, between: Between) -> None:
    wanted = [tuple(row) for row in Store(path).find(NEAR)]

    for _ in range(2):
        assert [tuple(row) for row in Collection(place).find(NEAR)] == wanted != []
    fetched = [key for key in between.seen if "/bundles/" in key and key.startswith("GET")]
    assert [between.seen[key] for key in fetched] == [1, 1]  # the second time they are here


def test_all_that_is_done_in_a_folder_is_done_in_a_bucket(
    place: str, path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert [fault for fault in verify(place).faults if fault[1] == "file"] == []
    unpack(place, tmp_path / "again.sgstore")
    wanted = [tuple(row) for row in Store(path).find(NEAR)]
    assert [tuple(row) for row in Store(tmp_path / "again.sgstore").find(NEAR)] == wanted
    (tmp_path / "stray").write_bytes(b"left behind")
    places.place_at(place).upload(tmp_path / "stray", f"bundles/{'0' * 64}.sgstore")
    assert gc(place, older_s=-60).names == [f"bundles/{'0' * 64}.sgstore"]
    assert run_verb(["find", place, "MATCH (a:Car)", "--count"]) == 0
    assert int(capsys.readouterr().out) == Store(path).find("MATCH (a:Car)").count()
    assert run_verb(["info", place]) == 0
    told = capsys.readouterr().out
    assert all(f" {one[:12]} " in told for one in Collection(place).bundles())
    assert run_verb(["collection", "gc", place]) == 0
    assert "sgstore: s3://fleet/all: 0 files, 0 bytes removed;" in capsys.readouterr().err


@pytest.mark.parametrize("answer", ["503", "500"])
def test_a_server_that_is_overloaded_twice_is_asked_again(
    place: str, path: Path, between: Between, answer: str
) -> None:
    between.wrong = lambda method, path, number: answer if number <= 2 else ""

    found = [tuple(row) for row in Collection(place).find(NEAR)]

    assert found == [tuple(row) for row in Store(path).find(NEAR)]
    assert min(between.seen.values()) == 3


def test_what_breaks_off_is_fetched_again(place: str, path: Path, between: Between) -> None:
    between.wrong = lambda method, path, number: (
        "cut" if "/bundles/" in path and number <= 2 else ""
    )

    assert len(list(Collection(place).find(NEAR))) == len(list(Store(path).find(NEAR)))


def test_what_always_breaks_off_is_refused(place: str, between: Between) -> None:
    between.wrong = lambda method, path, number: "cut" if "/bundles/" in path else ""

    with pytest.raises(PartialAnswerError, match=r"bundles/.*sgstore"):
        list(Collection(place).find(NEAR))


def test_a_changed_byte_is_refused_by_the_hash(place: str, tmp_path: Path) -> None:
    whole = Collection(place)
    sha = whole.bundles()[0]
    held = places.place_at(place)
    data = bytearray(held.read(f"bundles/{sha}.sgstore"))
    data[len(data) // 2] ^= 1
    (tmp_path / "hurt").write_bytes(data)
    held.upload(tmp_path / "hurt", f"bundles/{sha}.sgstore")

    with pytest.raises(PartialAnswerError, match="not as it was committed") as refused:
        list(whole.find(NEAR))
    assert [*refused.value.bundles] == [sha]
    assert run_verb(["find", place, NEAR]) == 1


@pytest.mark.parametrize("answer", ["403", "401"])
def test_wrong_credentials_are_one_clear_line(
    place: str, between: Between, answer: str, capsys: pytest.CaptureFixture[str]
) -> None:
    between.wrong = lambda method, path, number: answer

    assert run_verb(["find", place, NEAR]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "s3://fleet/all" in line
    assert "credentials" in line


def test_a_missing_bucket_is_one_clear_line(
    between: Between, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_verb(["find", "s3://nowhere/all", NEAR]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "s3://nowhere/all" in line


def test_of_two_commits_at_once_none_is_lost(
    place: str, path: Path, others: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    together, write = threading.Barrier(2), places._Remote.write_new
    waited: set[int] = set()

    def at_once(self: Any, name: str, data: bytes) -> bool:
        """Both have looked before one of them writes."""
        if name.startswith("catalogue/") and threading.get_ident() not in waited:
            waited.add(threading.get_ident())
            together.wait(300)
        return write(self, name, data)

    monkeypatch.setattr(places._Remote, "write_new", at_once)
    with ThreadPoolExecutor(2) as pool:
        done = list(pool.map(lambda one: pack(one, place), others))

    assert {one.number for one in done} == {2, 3}
    names = {row["name"] for row in Collection(place).traces()}
    assert len(names) == 4 + 2 + 2
    assert names >= {name for one in done for name in one.added}


def test_credentials_are_not_written_anywhere(place: str, between: Between) -> None:
    whole = places.place_at(place)
    for name, _, _ in whole.names(""):
        assert b"secret" not in whole.read(name)
    with pytest.raises(StoreError) as refused:
        whole.read("nothing")
    assert os.environ["AWS_SECRET_ACCESS_KEY"] not in str(refused.value)


# Recordings --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of some megabytes, most of which are pictures."""
    path = tmp_path_factory.mktemp("drive") / "day1.mcap"
    noise = random.Random(1)
    with Recorder(path) as recorder:
        for i in range(20):
            recorder.ground_truth(i / 10, [car(7, i, v=(10, 0)), car(3, 40.0 - i, 3.5)], host=7)
            picture = recorder.channel("camera", "pictures.Image", b"{}")
            recorder.write(picture, i / 10, noise.randbytes(400_000))
    return path


def put(between: Between, path: Path, name: str) -> str:
    """Put a file where recordings are; its URL."""
    places.place_at("s3://fleet").upload(path, name)
    between.seen.clear()
    return f"s3://fleet/{name}"


def rows_of(path: Path) -> list[Any]:
    text = "FROM frames ORDER BY frame_id", "FROM nodes ORDER BY ALL", "FROM edges ORDER BY ALL"
    return [list(Store(path).sql(one)) for one in text]


def got(between: Between) -> int:
    """How often the content of an object was asked for."""
    return sum(
        n for key, n in between.seen.items() if key.startswith("GET") and "list-type" not in key
    )


@pytest.fixture
def url(between: Between, drive: Path) -> str:
    return put(between, drive, "drives/day1.mcap")


def test_a_recording_in_a_bucket_is_read_as_a_file_is(
    url: str, drive: Path, between: Between, tmp_path: Path
) -> None:
    (here,) = ingest(tmp_path / "here.sgstore", [drive])
    (there,) = ingest(tmp_path / "there.sgstore", recordings([url]))

    assert (there.status, there.frames, there.losses) == (here.status, here.frames, here.losses)
    assert there.as_dict()["path"] == url
    assert got(between) == 1  # all of it fits into one piece
    assert rows_of(tmp_path / "there.sgstore") == rows_of(tmp_path / "here.sgstore")
    with Store(tmp_path / "here.sgstore") as one, Store(tmp_path / "there.sgstore") as other:
        assert other.info()[0].as_dict()["path"] == url
        between.seen.clear()
        assert other.payload("day1#7", "camera") == one.payload("day1#7", "camera")
        assert got(between) < 6  # the chunk, and not all of them
    for to in ("here", "there"):
        query = "MATCH (e:Ego) WHERE frame.seq < 3"
        asked = ["export", str(tmp_path / f"{to}.sgstore"), query, "--to", str(tmp_path / to)]
        assert run_verb(asked) == 0
    (clip,), (same,) = (list((tmp_path / to).glob("*.mcap")) for to in ("here", "there"))
    assert clip.read_bytes() == same.read_bytes()
    assert run_verb(["ingest", str(tmp_path / "there.sgstore"), url]) == 0


@pytest.mark.parametrize("answer", ["503", "cut"])
def test_a_recording_that_does_not_come_at_once_is_asked_for_again(
    url: str, between: Between, tmp_path: Path, answer: str
) -> None:
    between.wrong = lambda method, path, number: answer if method == "GET" and number <= 2 else ""

    (found,) = ingest(tmp_path / "s.sgstore", [url])

    assert (found.status, found.frames) == ("added", 20)


@pytest.mark.parametrize(
    ("answer", "name", "reason"),
    [
        ("403", "drives/day1.mcap", "credentials"),
        *([("cut", "drives/day1.mcap", "not read in 4 tries")] if LONG else []),
        ("", "drives/day2.mcap", "object or bucket not found"),
    ],
)
def test_a_recording_that_cannot_be_read_is_one_clear_line(
    url: str,
    between: Between,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    answer: str,
    name: str,
    reason: str,
) -> None:
    between.wrong = lambda method, path, number: (
        answer if method == "GET" or answer == "403" else ""
    )

    assert run_verb(["ingest", str(tmp_path / "s.sgstore"), f"s3://fleet/{name}"]) == 1
    line = capsys.readouterr().err.strip().splitlines()[0]
    assert f"s3://fleet/{name}: " in line
    assert reason in line


def test_a_recording_that_was_replaced_gives_no_payload(
    url: str, drive: Path, between: Between, tmp_path: Path
) -> None:
    ingest(tmp_path / "s.sgstore", [url])
    (tmp_path / "other").write_bytes(drive.read_bytes()[:-9] + b"?" * 9)
    put(between, tmp_path / "other", "drives/day1.mcap")

    with pytest.raises(TraceError, match=r"s3://fleet/drives/day1.mcap: not the file that was"):
        Store(tmp_path / "s.sgstore").payload("day1#7", "camera")


def test_folders_patterns_and_bags_in_a_bucket_are_found(
    url: str, drive: Path, between: Between, tmp_path: Path
) -> None:
    (tmp_path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  storage_identifier: mcap\n  relative_file_paths:\n    - a.mcap\n"
    )
    put(between, tmp_path / "metadata.yaml", "drives/bag/metadata.yaml")
    put(between, drive, "drives/bag/a.mcap")
    put(between, drive, "drives/more/day22.mcap")

    def meant(text: str) -> list[str]:
        return [place_named(path) for path in recordings([text])]

    bag, more = "s3://fleet/drives/bag", "s3://fleet/drives/more/day22.mcap"
    assert meant("s3://fleet/drives/") == [bag, url, more]
    assert meant("s3://fleet/drives/*.mcap") == [url]
    assert meant("s3://fleet/**/day?.mcap") == [url]
    assert meant("s3://fleet/drives/m*/day[12]?.mcap") == [more]
    assert meant(bag) == meant(f"{bag}/metadata.yaml") == [bag]
    with pytest.raises(StoreError, match=r"s3://fleet/nothing: no recording"):
        recordings(["s3://fleet/nothing"])
    (found,) = ingest(tmp_path / "s.sgstore", recordings([bag]))
    assert (found.frames, found.name) == (20, "bag")
    assert len(Store(tmp_path / "s.sgstore").payload("bag#7", "camera")) == 400_000


def test_recordings_in_a_bucket_land_once(url: str, between: Between, tmp_path: Path) -> None:
    place = tmp_path / "fleet"
    shards = [land(place, [url], shard=(number, 2)) for number in (1, 2)]
    assert [one.status for found in shards for one in found] == ["landed"]
    between.seen.clear()
    shards = [land(place, [url], shard=(number, 2)) for number in (1, 2)]
    assert [one.status for found in shards for one in found] == ["present"]
    assert got(between) == 0
    assert commit(place).added == ["day1"]
    assert [row["uri"] for row in Collection(place).traces()] == [url]


def test_a_recording_of_a_web_server_is_read(between: Between, url: str, tmp_path: Path) -> None:
    found = ingest(tmp_path / "s.sgstore", [f"{between.url}/fleet/drives/day1.mcap"])

    assert [(one.status, one.frames) for one in found] == [("added", 20)]


def test_a_web_server_that_knows_no_ranges_gives_the_whole_file(
    drive: Path, tmp_path: Path
) -> None:
    shutil.copy(drive, tmp_path / "day1.mcap")
    handler = partial(_Silent, directory=str(tmp_path))
    served = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=served.serve_forever, kwargs={"poll_interval": 0.05}).start()
    try:
        url = f"http://127.0.0.1:{served.server_port}/day1.mcap"
        (found,) = ingest(tmp_path / "s.sgstore", [url])
        assert len(Store(tmp_path / "s.sgstore").payload("day1#7", "camera")) == 400_000
    finally:
        served.shutdown()
        served.server_close()
    assert (found.status, found.frames) == ("added", 20)


class _Silent(SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        """Say nothing."""
