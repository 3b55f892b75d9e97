"""Faults of system calls: an error code at each call leaves nothing torn, lost or raised as another's error."""

from __future__ import annotations

import ast
import errno
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from recordings import Recorder as Recording
from recordings import car

import sgstore
from sgstore.base.output_files import write_bytes
from sgstore.base.temporary_folders import HeldFolder, sweep
from sgstore.collection import Collection, _storage, pack, unpack
from sgstore.errors import ExportError, StoreError, reason_of
from sgstore.exporters import _clips
from sgstore.exporters._recorder import Recorder
from sgstore.ingest import ingest
from sgstore.model.user_notes import Note, NotesFile
from sgstore.pipeline import rebuild
from sgstore.store import PartFile, StoreFile, _creation

if TYPE_CHECKING:
    from collections.abc import Callable

fcntl = pytest.importorskip("fcntl")

CODES = ("EIO", "EINTR", "ENOLCK", "EXDEV", "EBUSY", "ENOSPC")
SGSTORE = Path(sgstore.__file__).parent


@dataclass
class Injected:
    """Fault of a system call: the calls that it hit."""

    hits: int = 0


@pytest.fixture(params=CODES)
def code(request: pytest.FixtureRequest) -> int:
    return getattr(errno, request.param)


@pytest.fixture
def fail(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Injected]:
    def injected(
        module: Any, name: str, code: int, *, at: Callable[..., bool] = lambda *_: True
    ) -> Injected:
        found, before = Injected(), getattr(module, name)

        def call(*args: Any, **options: Any) -> Any:
            if not at(*args):
                return before(*args, **options)
            found.hits += 1
            raise OSError(code, os.strerror(code))

        monkeypatch.setattr(module, name, call)
        return found

    return injected


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "a.mcap"
    with Recording(path) as recorder:
        for row in range(3):
            recorder.ground_truth(row / 10, [car(1, row, 0)], host=1)
    return path


@pytest.fixture(scope="module")
def made(recording: Path) -> Path:
    path = recording.with_name("s.sgstore")
    (outcome,) = ingest(path, [recording])
    assert outcome.error is None
    return path


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(made, tmp_path))


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def has_remedy(error: BaseException | pytest.ExceptionInfo[Any], code: int) -> bool:
    """Return True if a message has the reason and the remedy of an error code."""
    found = error.value if isinstance(error, pytest.ExceptionInfo) else error
    said = reason_of(OSError(code, os.strerror(code)))
    return said in str(found) and (";" in said) and "\n" not in str(found)


# The calls ----------------------------------------------------------------------------------------

TESTED = {
    "base/output_files.py _copy": {"ftruncate"},
    "base/output_files.py _keep_owner_and_mode": {"chmod", "fsync"},
    "base/output_files.py _move": {"replace"},
    "base/output_files.py _reserve": {"ftruncate", "posix_fallocate"},
    "base/temporary_folders.py _locked": {"flock"},
    "base/temporary_folders.py _remove_dead": {"flock"},
    "collection/_pack.py unpack": {"rename"},
    "collection/_storage.py _fetch": {"replace"},
    "collection/_storage.py _remember": {"replace"},
    "collection/_storage.py upload": {"fsync", "replace"},
    "collection/_storage.py write_new": {"fsync", "link"},
    "collection/_questions.py __iter__": {"replace"},
    "exporters/_clips.py _move": {"replace"},
    "exporters/_clips.py _move_file": {"hardlink_to", "replace"},
    "exporters/_recorder.py close": {"replace"},
    "model/user_notes.py _append": {"flock", "ftruncate"},
    "pipeline/rebuild.py _alone": {"flock"},
    "store/_creation.py _name": {"link", "rename"},
    "store/_creation.py write_empty": {"fsync"},
    "store/_engine_errors.py move": {"replace"},
    "store/_gate.py _lock": {"flock"},
    "store/_gate.py remove": {"flock"},
    "store/_lease.py _wanted": {"flock"},
}
"""Calls whose faults this file tests, by file and function."""

CALLS = {
    *("flock", "lockf", "fsync", "fdatasync", "link", "hardlink_to", "symlink_to", "rename"),
    *("replace", "chmod", "fchmod", "ftruncate", "posix_fallocate"),
}


def test_each_system_call_has_a_test_of_its_faults() -> None:
    found: dict[str, set[str]] = {}
    for path in SGSTORE.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for function in ast.walk(tree):
            if not isinstance(function, ast.FunctionDef):
                continue
            for node in ast.walk(function):
                if name := _system_call(node):
                    key = f"{path.relative_to(SGSTORE).as_posix()} {function.name}"
                    found.setdefault(key, set()).add(name)

    assert found == TESTED


def _system_call(node: ast.AST) -> str | None:
    """Return the name of the file system call of a node; ``None`` for other nodes."""
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
        return None
    name = node.func.attr
    if name not in CALLS:
        return None
    if name == "replace":  # of a path: one argument, and no text of a dataclass
        if len(node.args) != 1 or node.keywords:
            return None
        of = node.func.value
        return None if isinstance(of, ast.Name) and of.id == "dataclasses" else name
    return name


# Locks --------------------------------------------------------------------------------------------


def test_a_write_without_the_lock_is_an_error_and_the_store_stays(
    store: Path, code: int, fail: Callable[..., Injected]
) -> None:
    injected = fail(fcntl, "flock", code)

    with pytest.raises(StoreError, match="cannot be locked for writing") as error:
        StoreFile(store).remove("a")

    assert injected.hits
    assert has_remedy(error, code)
    assert [trace.name for trace in StoreFile(store).traces()] == ["a"]


def test_a_reader_needs_no_lock(store: Path, code: int, fail: Callable[..., Injected]) -> None:
    store.with_name(f"{store.name}.gate").touch()
    injected = fail(fcntl, "flock", code)

    with sgstore.open(store) as opened:
        assert opened.find("MATCH (e:Ego)").count() == 3
        assert opened.find("MATCH (e:Ego)").count() == 3

    assert injected.hits


def test_a_lock_file_that_is_not_readable_is_an_error(
    store: Path, code: int, fail: Callable[..., Injected]
) -> None:
    gate = str(store.with_name(f"{store.name}.gate"))
    injected = fail(os, "stat", code, at=lambda path, *_: str(path) == gate)

    with pytest.raises(StoreError) as error:
        StoreFile(store).remove("a")

    assert injected.hits
    assert has_remedy(error, code)
    assert [trace.name for trace in StoreFile(store).traces()] == ["a"]


def test_a_folder_in_use_stays_if_its_lock_failed_for_a_moment(
    tmp_path: Path, code: int, monkeypatch: pytest.MonkeyPatch, fail: Callable[..., Injected]
) -> None:
    flock = fcntl.flock
    injected = fail(fcntl, "flock", code)
    held = HeldFolder(tmp_path, "held-")
    monkeypatch.setattr(fcntl, "flock", flock)
    assert injected.hits  # a folder that is collected meanwhile takes a lock, too
    (held.path / "content").write_text("x")

    sweep(tmp_path, "held-")  # by another process, which gets its lock

    assert (held.path / "content").read_text() == "x"
    held.remove()
    assert names(tmp_path) == []


def test_a_dead_folder_stays_if_its_lock_fails(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    (tmp_path / "held-1").mkdir()
    injected = fail(fcntl, "flock", code)

    sweep(tmp_path, "held-")

    assert injected.hits == 1
    assert names(tmp_path) == ["held-1"]


def test_folders_of_other_users_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "held-1").mkdir()
    undone: list[Path] = []
    with monkeypatch.context() as other_user:
        other_user.setattr(os, "geteuid", lambda: tmp_path.stat().st_uid + 1)
        sweep(tmp_path, "held-", undone.append)
        assert names(tmp_path) == ["held-1"]
        assert undone == []

    sweep(tmp_path, "held-", undone.append)

    assert names(tmp_path) == []
    assert undone == [tmp_path / "held-1"]


def test_two_rebuilds_at_once_are_prevented_or_refused(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    injected = fail(fcntl, "flock", code)

    with (
        pytest.raises(StoreError, match="cannot be locked") as error,
        rebuild._alone(tmp_path / "s"),
    ):
        pytest.fail("begun without its lock")

    assert injected.hits == 1
    assert has_remedy(error, code)


def test_a_tag_without_the_lock_is_not_written(
    store: Path, code: int, fail: Callable[..., Injected]
) -> None:
    notes = NotesFile(store)
    notes.add(Note("a", 0, "first"), 0)
    before = notes.path.read_bytes()
    injected = fail(fcntl, "flock", code)

    with pytest.raises(StoreError) as error:
        notes.add(Note("a", 0, "second"), 0)

    assert injected.hits == 1
    assert has_remedy(error, code)
    assert notes.path.read_bytes() == before


def test_a_tag_is_written_whole_or_not_at_all(
    store: Path, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes = NotesFile(store)
    notes.add(Note("a", 0, "first"), 0)
    before, write, written = notes.path.read_bytes(), os.write, []

    def some(file: int, data: Any) -> int:
        if written:
            raise OSError(code, os.strerror(code))
        written.append(write(file, bytes(data)[:5]))  # a disk that gets full takes a part
        return 5

    with monkeypatch.context() as full:
        full.setattr(os, "write", some)
        with pytest.raises(StoreError) as error:
            notes.add(Note("a", 1, "second"), 2)

    assert has_remedy(error, code)
    assert notes.path.read_bytes() == before

    with monkeypatch.context() as slow:
        slow.setattr(os, "write", lambda file, data: write(file, bytes(data)[:5]))
        notes.add(Note("a", 1, "second"), 2)
    assert [(note.seq, note.tag) for note in notes.read()] == [
        (0, "first"),
        (1, "second"),
        (2, "second"),
    ]


# New stores ---------------------------------------------------------------------------------------


def test_a_store_is_made_without_hard_links(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    injected = fail(os, "link", code)

    StoreFile.create(tmp_path / "s.sgstore").close()

    assert injected.hits == 1
    assert names(tmp_path) == ["s.sgstore"]
    assert StoreFile(tmp_path / "s.sgstore").traces() == ()


def test_a_store_without_links_and_renames_is_not_made(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    fail(os, "link", code)
    injected = fail(os, "rename", code)

    with pytest.raises(StoreError, match="cannot be made") as error:
        StoreFile.create(tmp_path / "s.sgstore")

    assert injected.hits == 1
    assert has_remedy(error, code)
    assert names(tmp_path) == []


def test_a_store_made_by_another_process_in_the_meantime_stays(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    fail(os, "link", code)
    fresh, path = tmp_path / "fresh", tmp_path / "s.sgstore"
    fresh.write_bytes(b"new")
    path.write_bytes(b"of another process")

    _creation._name(fresh, path)

    assert path.read_bytes() == b"of another process"


def test_a_store_that_is_not_on_the_disk_is_not_made(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    StoreFile.create(tmp_path / "first.sgstore").close()  # later ones are copies
    injected = fail(os, "fsync", code)

    with pytest.raises(StoreError, match="cannot be made") as error:
        StoreFile.create(tmp_path / "s.sgstore")

    assert injected.hits == 1
    assert has_remedy(error, code)
    assert names(tmp_path) == ["first.sgstore"]


def test_a_store_that_cannot_be_replaced_stays(
    store: Path, code: int, fail: Callable[..., Injected]
) -> None:
    before = store.read_bytes()
    injected = fail(os, "replace", code, at=lambda _from, to: Path(to) == store)

    with pytest.raises(StoreError, match=r"left as it is|not changed: the disk is full") as error:
        StoreFile(store).compact()

    assert injected.hits == 1
    assert code == errno.ENOSPC or has_remedy(error, code)
    assert [trace.name for trace in StoreFile(store).traces()] == ["a"]
    assert len(store.read_bytes()) == len(before)
    assert names(store.parent) == ["s.sgstore"]


# Output files -------------------------------------------------------------------------------------


@pytest.mark.parametrize("call", ["chmod", "fsync"])
def test_an_older_output_file_stays_if_the_new_one_fails(
    tmp_path: Path, code: int, call: str, fail: Callable[..., Injected]
) -> None:
    to = tmp_path / "a.txt"
    to.write_bytes(b"before")
    injected = fail(os, call, code)

    with pytest.raises(ExportError) as error:
        write_bytes(to, b"after")

    assert injected.hits == 1
    assert has_remedy(error, code)
    assert to.read_bytes() == b"before"
    assert names(tmp_path) == ["a.txt"]


def test_an_output_file_is_replaced_or_written_in_place_or_stays(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    to = tmp_path / "a.txt"
    to.write_bytes(b"before, and longer")
    injected = fail(os, "replace", code)

    if code in {errno.EBUSY, errno.EXDEV}:  # as of a file that is mounted
        write_bytes(to, b"after")
        assert to.read_bytes() == b"after"
    else:
        with pytest.raises(ExportError) as error:
            write_bytes(to, b"after")
        assert has_remedy(error, code)
        assert to.read_bytes() == b"before, and longer"

    with pytest.raises(ExportError) as error:
        write_bytes(tmp_path / "b.txt", b"new")
    assert injected.hits == 2
    assert has_remedy(error, code)
    assert names(tmp_path) == ["a.txt"]


def test_a_full_disk_does_not_damage_a_file_that_is_written_in_place(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    to = tmp_path / "a.txt"
    to.write_bytes(b"before")
    fail(os, "replace", errno.EBUSY)
    injected = fail(os, "posix_fallocate", code)

    with pytest.raises(ExportError) as error:
        write_bytes(to, b"after, and longer")

    assert injected.hits == 1
    assert has_remedy(error, code)
    assert to.read_bytes() == b"before"


@pytest.mark.parametrize("code", ["EOPNOTSUPP", "EINVAL"], indirect=True)
def test_a_file_is_written_in_place_where_space_cannot_be_reserved(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    to = tmp_path / "a.txt"
    to.write_bytes(b"before")
    fail(os, "replace", errno.EBUSY)
    injected = fail(os, "posix_fallocate", code)

    write_bytes(to, b"after, and longer")

    assert injected.hits == 1
    assert to.read_bytes() == b"after, and longer"


def test_a_new_output_file_is_on_the_disk_before_it_replaces_an_older_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = recorded(monkeypatch, "fsync", "replace")
    to = tmp_path / "a.txt"
    to.write_bytes(b"before")

    write_bytes(to, b"after")

    assert calls == ["fsync 5 bytes", "replace a.txt"]


def recorded(monkeypatch: pytest.MonkeyPatch, *of: str) -> list[str]:
    """Return a list that gets the calls of some functions of :mod:`os`, in their order."""
    calls: list[str] = []

    def with_name(name: str) -> Callable[..., Any]:
        before = getattr(os, name)

        def call(*args: Any, **options: Any) -> Any:
            if name == "fsync":
                calls.append(f"fsync {os.fstat(args[0]).st_size} bytes")
            else:
                calls.append(f"{name} {Path(args[1]).name}")
            return before(*args, **options)

        return call

    for name in of:
        monkeypatch.setattr(os, name, with_name(name))
    return calls


# Folders of exports -------------------------------------------------------------------------------


def test_an_export_without_hard_links_is_complete(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    (tmp_path / "from").mkdir()
    (tmp_path / "to").mkdir()
    (tmp_path / "from" / "a").write_bytes(b"a")
    injected = fail(os, "link", code)

    _clips._move([tmp_path / "from" / "a"], tmp_path / "to")

    assert injected.hits == 1
    assert (tmp_path / "to" / "a").read_bytes() == b"a"


@pytest.mark.parametrize("folder", [False, True])
def test_an_export_is_moved_whole_or_not_at_all(
    tmp_path: Path, code: int, *, folder: bool, fail: Callable[..., Injected]
) -> None:
    for name in ("from", "to"):
        (tmp_path / name).mkdir()
    things = [tmp_path / "from" / name for name in "ab"]
    things[0].write_bytes(b"a")
    if folder:
        things[1].mkdir()
        (things[1] / "c").write_bytes(b"c")
    else:
        things[1].write_bytes(b"b")
    fail(os, "link", errno.EPERM)
    injected = fail(os, "replace", code, at=lambda _from, to: Path(to).name == "b")

    with pytest.raises(OSError, match=os.strerror(code)):
        _clips._move(things, tmp_path / "to")

    assert injected.hits == 1
    assert names(tmp_path / "to") == []


def test_a_recorder_keeps_its_file_if_it_cannot_be_renamed(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    recorder = Recorder(tmp_path / "r.mcap")
    recorder._frames = 1  # so that the file is kept
    injected = fail(os, "replace", code)

    with pytest.raises(ExportError, match=r"r\.mcap\.part") as error:
        recorder.close()

    assert injected.hits == 1
    assert has_remedy(error, code)
    assert names(tmp_path) == ["r.mcap.part"]
    assert (tmp_path / "r.mcap.part").read_bytes().startswith(b"\x89MCAP")


# Collections --------------------------------------------------------------------------------------


@pytest.mark.parametrize("call", ["link", "fsync"])
def test_a_snapshot_is_written_whole_or_not_at_all(
    tmp_path: Path, code: int, call: str, fail: Callable[..., Injected]
) -> None:
    place = _storage._Folder(tmp_path)
    injected = fail(os, call, code)

    with pytest.raises(StoreError) as error:
        place.write_new("1.json", b"{}")

    assert injected.hits == 1
    assert has_remedy(error, code)
    assert names(tmp_path) == []


@pytest.mark.parametrize("code", [*CODES, "EEXIST"], indirect=True)
def test_a_snapshot_whose_link_reports_a_fault_afterwards_is_written(
    tmp_path: Path, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = os.link

    def lost_reply(*args: Any, **options: Any) -> None:  # as of a network drive
        link(*args, **options)
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "link", lost_reply)

    assert _storage._Folder(tmp_path).write_new("1.json", b"{}")
    assert names(tmp_path) == ["1.json"]


def test_a_snapshot_of_another_process_stays(tmp_path: Path) -> None:
    place = _storage._Folder(tmp_path)

    assert place.write_new("1.json", b"first")
    assert not place.write_new("1.json", b"second")

    assert place.read("1.json") == b"first"
    assert names(tmp_path) == ["1.json"]


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_bundle_is_uploaded_whole_or_not_at_all(
    tmp_path: Path, code: int, call: str, fail: Callable[..., Injected]
) -> None:
    (tmp_path / "bundle").write_bytes(b"new")
    place = _storage._Folder(tmp_path / "collection")
    injected = fail(os, call, code)

    with pytest.raises(StoreError) as error:
        place.upload(tmp_path / "bundle", "bundles/b")

    assert injected.hits == 1
    assert has_remedy(error, code)
    assert names(tmp_path / "collection" / "bundles") == []


def test_files_of_a_collection_are_on_the_disk_before_they_have_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bundle").write_bytes(b"new")
    place = _storage._Folder(tmp_path / "collection")
    calls = recorded(monkeypatch, "fsync", "replace", "link")

    place.upload(tmp_path / "bundle", "bundles/b")
    place.write_new("1.json", b"{}")

    assert calls == ["fsync 3 bytes", "replace b", "fsync 2 bytes", "link 1.json"]


def test_a_fetched_bundle_is_whole_or_absent(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    place = _storage._Folder(tmp_path / "collection")
    (tmp_path / "bundle").write_bytes(b"new")
    place.upload(tmp_path / "bundle", "b")
    sha = _storage.digest_of_file(tmp_path / "bundle")
    (tmp_path / "cache").mkdir()
    injected = fail(os, "replace", code)

    with pytest.raises(StoreError, match="cannot be written") as error:
        _storage._fetch(place, "b", sha, tmp_path / "cache" / "b")

    assert injected.hits == 1
    assert has_remedy(error, code)
    assert names(tmp_path / "cache") == []


def test_a_bundle_whose_verification_is_not_noted_is_verified_again(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    bundle = tmp_path / "b"
    bundle.write_bytes(b"x")
    (tmp_path / "seen").mkdir()
    injected = fail(os, "replace", code)

    _storage._remember(tmp_path, "sha", bundle)

    assert injected.hits == 1
    assert not _storage._seen(tmp_path, "sha", bundle)


def test_a_collection_is_unpacked_whole_or_not_at_all(
    store: Path, tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    pack(store, tmp_path / "collection")
    (tmp_path / "new").mkdir()
    to = tmp_path / "new" / "again.sgstore"
    injected = fail(os, "rename", code, at=lambda _from, to_: Path(to_) == to)

    with pytest.raises(StoreError, match="cannot be made") as error:
        unpack(tmp_path / "collection", to)

    assert injected.hits == 1
    assert has_remedy(error, code)
    assert names(tmp_path / "new") == []


def test_verdicts_of_a_collection_are_read_or_an_error(
    store: Path, tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    pack(store, tmp_path / "collection")
    injected = fail(os, "replace", code, at=lambda _from, to: "verdicts-" in str(to))

    with pytest.raises(StoreError, match="cannot be written") as error:
        list(
            Collection(tmp_path / "collection").check(
                "CHECK calm: ALWAYS ego.speed < 8", status=True
            )
        )

    assert injected.hits == 1
    assert has_remedy(error, code)


def test_a_partial_answer_is_moved_or_an_error(
    tmp_path: Path, code: int, fail: Callable[..., Injected]
) -> None:
    (tmp_path / "part").write_bytes(b"x")
    part = PartFile(tmp_path / "part", (), (), 1, [])
    injected = fail(os, "replace", code)

    with pytest.raises(StoreError) as error:
        part.moved(tmp_path / "there")

    assert injected.hits == 1
    assert has_remedy(error, code)
    assert (tmp_path / "part").read_bytes() == b"x"
