"""Files that are written: all of them or nothing, whatever was there before."""

from __future__ import annotations

import errno
import os
import resource
import stat
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from thorough import some

from sgstore.apps.cli import run
from sgstore.base.output_files import OutputFile, write_bytes, written, written_at
from sgstore.errors import ExportError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

pytestmark = pytest.mark.seconds(13)

ROWS = "MATCH (e:Ego)-[:visible]->(v:Vehicle) RETURN v.name, e.speed"
CAMERA = "/ego/camera/front/image"
WRITERS = {
    "rows.csv": ["find", "{store}", ROWS],
    "rows.json": ["find", "{store}", ROWS],
    "rows.ndjson": ["sql", "{store}", "SELECT * FROM frames"],
    "rows.txt": ["sql", "{store}", "SELECT * FROM frames"],
    "rows.parquet": ["find", "{store}", ROWS],
    "rows.arrow": ["sql", "{store}", "SELECT * FROM frames"],
    "verdicts.csv": ["check", "{store}", "-e", "CHECK ALWAYS ego.speed < 3"],
    "like.csv": ["like", "{store}", "town#264"],
    "library.csv": ["patterns", "list"],
    "pattern.txt": ["patterns", "show", "cut_in"],
    "classes.csv": ["coverage", "classes", "{store}"],
    "image.jpg": ["payload", "{store}", "town#264", CAMERA],
    "frame.png": ["show", "{store}", "town#264", "--camera", "none"],
    "frame.svg": ["show", "{store}", "town#264", "--camera", "none"],
    "clip.gif": ["show", "{store}", "town#264..265", "--camera", "none"],
    "map.png": ["map", "{recording}"],
    "when.png": ["timeline", "{store}", "MATCH (e:Ego) WHERE e.speed > 9"],  # few rows to draw
    "tests.lock": ["select", "{store}", "--minimal", "--no-payloads"],
    "both.lock": ["lock", "union", "{lock}", "{lock}"],
    "cases.csv": ["lock", "list", "{lock}"],
}
"""A file that each verb with ``-o`` writes."""


@pytest.fixture(scope="module")
def named(
    town_store: Path,
    tmp_path_factory: pytest.TempPathFactory,
    kept_open: Callable[[Path], None],
) -> dict[str, str]:
    """What stands in the command lines."""
    from sgstore.apps.demo import RECORDING

    kept_open(town_store)
    lock = tmp_path_factory.mktemp("locks") / "town.lock"
    assert run(["select", str(town_store), "--minimal", "--no-payloads", "-o", str(lock)]) == 0
    return {"store": str(town_store), "recording": str(RECORDING), "lock": str(lock)}


@contextmanager
def full_disk(most: int = 100) -> Iterator[None]:
    """No file gets longer than so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def names(folder: Path) -> list[str]:
    return [one.name for one in folder.iterdir()]


def command(name: str, named: dict[str, str], to: Path) -> list[str]:
    return [*(part.format(**named) for part in WRITERS[name]), "-o", str(to)]


@pytest.mark.parametrize("name", some([*WRITERS], 3))
def test_what_was_there_survives_a_full_disk_and_a_pipe_gets_what_a_file_gets(
    name: str, named: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    to = tmp_path / name
    to.write_bytes(b"of yesterday")
    to.chmod(0o640)

    with full_disk():
        code = run(command(name, named, to))

    assert code == 1
    assert "limit of the file size" in capsys.readouterr().err
    assert to.read_bytes() == b"of yesterday"
    assert names(tmp_path) == [name]
    assert run(command(name, named, to)) == 0
    assert to.stat().st_size > 100
    assert stat.S_IMODE(to.stat().st_mode) == 0o640
    assert names(tmp_path) == [name]
    if name.endswith(".lock") and name != "tests.lock":
        return  # the same writer

    pipe = tmp_path / "pipe" / name
    pipe.parent.mkdir()
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    assert run(command(name, named, pipe)) == 0
    reader.join()
    assert len(read[0]) == to.stat().st_size
    assert stat.S_ISFIFO(pipe.stat().st_mode)


INTO_EACH = """
import sys
from sgstore.apps.cli import run
for name in sys.argv[1:]:
    print(f"into {name}", flush=True)
    assert run(["patterns", "show", "cut_in", "-o", name]) == 0
"""


def test_what_is_called_stdout_is_stdout(tmp_path: Path, capfdbinary: Any) -> None:
    assert run(["patterns", "show", "cut_in"]) == 0
    shown = capfdbinary.readouterr().out
    assert shown
    file, other = tmp_path / "out.txt", tmp_path / "link"
    other.symlink_to("/dev/stdout")
    places = ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1", str(other)]
    expected = b"".join(f"into {place}\n".encode() + shown for place in places)
    command = [sys.executable, "-c", INTO_EACH, *places]

    piped = subprocess.run(command, capture_output=True, check=True).stdout
    with file.open("wb") as stream:
        stream.write(b"first\n")
        stream.flush()
        subprocess.run(command, stdout=stream, check=True)

    assert piped == expected
    assert file.read_bytes() == b"first\n" + expected
    assert other.is_symlink()


def test_a_device_is_written_into(named: dict[str, str]) -> None:
    assert run(command("rows.csv", named, Path("/dev/null"))) in {0, 2}
    assert run([*command("rows.csv", named, Path("/dev/null")), "--format", "csv"]) == 0
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


def test_a_device_that_is_full_says_so(named: dict[str, str], capsys) -> None:
    assert run([*command("rows.csv", named, Path("/dev/full")), "--format", "csv"]) == 1
    assert "/dev/full: the disk is full; free space" in capsys.readouterr().err


def test_a_link_stays_one_and_a_new_file_has_the_usual_rights(tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    link, target = tmp_path / "link.txt", tmp_path / "here" / "target.txt"
    link.symlink_to(target)

    for text in (b"first", b"second"):
        write_bytes(link, text)
        assert link.is_symlink()
        assert target.read_bytes() == text
    other = tmp_path / "other"
    other.touch()
    assert stat.S_IMODE(target.stat().st_mode) == stat.S_IMODE(other.stat().st_mode)


def test_a_file_that_can_be_written_and_not_replaced_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def busy(_from: Path, _to: Path) -> None:  # as of a single file in a container
        raise OSError(errno.EBUSY, "busy")

    (tmp_path / "a.txt").write_bytes(b"longer than what comes")
    monkeypatch.setattr(Path, "replace", busy)
    write_bytes(tmp_path / "a.txt", b"second")

    assert (tmp_path / "a.txt").read_bytes() == b"second"
    with pytest.raises(ExportError, match=r"b\.txt: busy"):
        write_bytes(tmp_path / "b.txt", b"new")
    assert names(tmp_path) == ["a.txt"]


def test_what_is_broken_off_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"before")

    def break_off(way: Callable[[Path], Any]) -> None:
        with way(tmp_path / "a.txt") as there:
            (there.write_bytes if isinstance(there, Path) else there.write)(b"half")
            raise KeyboardInterrupt

    for way in (written, written_at):
        with pytest.raises(KeyboardInterrupt):
            break_off(way)
    output = OutputFile(tmp_path / "a.txt")
    output.stream().write(b"half")
    output.discard()

    assert (tmp_path / "a.txt").read_bytes() == b"before"
    assert names(tmp_path) == ["a.txt"]


@pytest.mark.parametrize(
    ("place", "reason"),
    [("none/a.txt", "No such file"), (".", "Is a directory"), ("a\0b", "null byte")],
)
def test_a_place_that_is_none_is_an_error_of_ours(place: str, reason: str, tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=reason):
        write_bytes(f"{tmp_path}/{place}", b"x")
    with pytest.raises(ExportError, match=reason), written_at(f"{tmp_path}/{place}"):
        pass


@pytest.mark.parametrize("form", ["table", "csv", "json", "ndjson"])
def test_no_form_of_rows_gives_orders_to_a_terminal(
    form: str, named: dict[str, str], capsys
) -> None:
    turning = (0x61C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A))
    codes = (*range(1, 32), *range(127, 160), *turning)
    every = " || ".join(f"chr({code})" for code in codes)
    statement = f"SELECT 'a' || {every} || 'z' AS name, [chr(27), chr(155)] AS names"

    assert run(["sql", named["store"], statement, "--format", form]) == 0

    out = capsys.readouterr().out
    dangerous = {chr(code) for code in (0, *codes)} - {"\n", "\t"}
    assert not set(out) & dangerous
    assert "a" in out
    assert "z" in out


def test_messages_give_no_orders_to_a_terminal(named: dict[str, str], capsys) -> None:
    assert run(["info", named["store"], "--trace", "\x1b[31mred\x9b\u202e"]) == 1
    err = capsys.readouterr().err
    assert "red" in err
    assert not {"\x1b", "\x9b", "\u202e"} & set(err)
