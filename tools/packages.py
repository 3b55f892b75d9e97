"""The package as people get it: ``python packages.py wheel`` and ``python packages.py versions``.

``wheel`` (``make test-wheel``) builds the wheel as it is published: from the source distribution of a clone. It
looks at its size and its files, runs the demonstration where no extra is installed, and runs the short tests in
an environment of its own: nothing is imported from the checkout. ``versions`` (``make test-versions``) installs
it twice, with the lowest and with the highest versions of other packages that ``pyproject.toml`` allows. It
runs ingest, verify, find and check under both: the answers must be the same.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).parents[1]
RECORDING = Path("apps") / "sample" / "town.mcap"
"""In the package of a checkout only: a wheel has a small one (``sgstore/apps/demo.py`` says why)."""

SHORT = (
    "test_cli_errors.py",
    "test_config.py",
    "test_lang_parser.py",
    "test_query.py",
)
"""Test files that use the shipped data files: settings, grammar, library, schema and recording.

``make test`` runs the other tests. The code is the same there; ``check_contents`` compares the file lists.
"""

VERBS: tuple[tuple[str, ...], ...] = (
    ("verify", "town.sgstore", "--payloads"),
    ("info", "town.sgstore", "--json"),
    ("find", "town.sgstore", "--json", "MATCH (e:Ego)-[:near_coll]->(v:Vehicle) RETURN v, e.speed"),
    (
        "find",
        "town.sgstore",
        "--json",
        "MATCH (e:Ego), (v:Car) WHERE dist(e, v) < 9 RETURN COUNT(*)",
    ),
    ("patterns", "run", "town.sgstore", "jaywalking", "--json"),
    ("check", "town.sgstore", "-p", "phi1", "--json"),
    ("sql", "town.sgstore", "SELECT relation, count(*) FROM edges GROUP BY ALL ORDER BY ALL"),
)
"""What each version is asked after it made its store."""

VARIES = {"seconds", "ingested_at", "file", "path", "uri", "sgstore", "duckdb", "bytes", "size"}
"""Of a trace: when and where it was read, and how large its store is."""


LARGEST = 3_500_000
"""Bytes of a wheel."""


def shipped() -> set[str]:
    """The files of the last commit that a wheel must hold: the package without the long recording."""
    command = ["git", "ls-tree", "-r", "--name-only", "HEAD", "sgstore/"]
    listed = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    return {*listed.stdout.splitlines()} - {("sgstore" / RECORDING).as_posix()}


def clean_copy(folder: Path) -> Path:
    """A clone of the last commit: nothing that only lies in this checkout."""
    copy = folder / "clone"
    command = ["git", "clone", "-q", "--depth", "1", REPOSITORY.as_uri(), str(copy)]
    subprocess.run(command, check=True)
    return copy


def distribution(source: Path, kind: str) -> Path:
    """Build one file of a source tree with the installed setuptools; ``kind`` is sdist or wheel."""
    made = f"from setuptools.build_meta import build_{kind}; build_{kind}('dist')"
    subprocess.run([sys.executable, "-c", made], cwd=source, capture_output=True, check=True)
    (file,) = (source / "dist").iterdir()
    return file


def unpacked(archive: Path, folder: Path) -> Path:
    """The tree of a source distribution."""
    with tarfile.open(archive) as held:
        held.extractall(folder / "unpacked", filter="data")
    (source,) = (folder / "unpacked").iterdir()
    return source


def build(folder: Path, *, isolated: bool) -> Path:
    """The wheel that is published: from the source distribution of a clone.

    Parameters
    ----------
    folder : Path
        Where it is put.
    isolated : bool
        Whether pip fetches what builds it; otherwise that is what is installed here.
    """
    with tempfile.TemporaryDirectory() as name:
        archive = distribution(clean_copy(Path(name)), "sdist")
        if isolated:
            pip("wheel", "--no-deps", "--wheel-dir", str(folder), str(archive))
        else:
            shutil.copy(distribution(unpacked(archive, Path(name)), "wheel"), folder)
    (wheel,) = folder.glob("sgstore-*.whl")
    return wheel


def check_contents(wheel: Path, expected: set[str]) -> None:
    """Compare a wheel with the files that it must hold, and its size with the limit.

    Raises
    ------
    AssertionError
        The wheel is too large, lacks a file, or holds another one.
    """
    size = wheel.stat().st_size
    assert size <= LARGEST, f"{wheel.name}: {size:,} bytes; at most {LARGEST:,}"
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    pages = f"{wheel.name.partition('-py3')[0]}.data/data/share/doc/sgstore/"  # of sgstore docs
    held = {name for name in names if ".dist-info/" not in name and not name.startswith(pages)}
    assert held == expected, f"extra {sorted(held - expected)}, missing {sorted(expected - held)}"


def pip(*arguments: str) -> None:
    """Run pip."""
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q", *arguments]
    subprocess.run(command, check=True)


def environment(folder: Path, *packages: str) -> Path:
    """An environment with packages and nothing else; its folder of programs.

    Parameters
    ----------
    folder : Path
        Where it is made.
    *packages : str
        What is to be installed, as pip is told it.
    """
    # Without a pip of its own: that takes seconds, and not every machine can make one.
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    python = str(folder / "bin" / "python")
    by_uv = [sys.executable, "-m", "uv", "pip", "install", "-q", "--python", python, *packages]
    # uv is faster; where it cannot (an index that only pip is told of), pip does.
    if not find_spec("uv") or subprocess.run(by_uv, check=False).returncode:
        pip("--python", python, "install", *packages)
    return folder / "bin"


def project() -> dict[str, Any]:
    """What ``pyproject.toml`` says of the project."""
    return tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def lowest() -> list[str]:
    """The lower bound of each package that is needed, as constraints.

    Raises
    ------
    ValueError
        One of them has none.
    """
    found: list[str] = []
    for needed in project()["dependencies"]:
        told = re.match(r"([\w.-]+)>=([\d.]+)", needed)
        if told is None:
            raise ValueError(f"{needed}: no lower bound")
        found.append(f"{told[1]}=={told[2]}")
    return found


def try_wheel(folder: Path) -> None:
    """Run the demonstration without extras and the short tests from the published wheel.

    The folder of the tests is without the package.

    Raises
    ------
    subprocess.CalledProcessError
        A test fails.
    AssertionError
        What was tested is not what was installed.
    """
    wheel = build(folder, isolated=True)
    check_contents(wheel, shipped())
    bare = environment(folder / "bare", str(wheel))
    missing = [str(bare / "python"), "-c", "import PIL"]
    assert subprocess.run(missing, check=False, capture_output=True).returncode, "PIL is installed"
    demo = [str(bare / "sgstore"), "demo", "demonstration"]
    subprocess.run(demo, check=True, cwd=folder, stdout=subprocess.DEVNULL)
    needs = ("pytest>=8.3", "pytest-xdist>=3.8", "hypothesis>=6.100", "polars>=1")
    programs = environment(folder / "env", f"{wheel}[viz,arrow]", *needs)
    where = [str(programs / "python"), "-c", "import sgstore; print(sgstore.__path__[0])"]
    (folder / "copy").mkdir()
    shown = subprocess.run(where, check=True, capture_output=True, text=True, cwd=folder / "copy")
    package = Path(shown.stdout.strip())
    assert package.is_relative_to(folder / "env"), package
    demo = [str(programs / "sgstore"), "demo", "pictures"]
    subprocess.run(demo, check=True, cwd=folder, stdout=subprocess.DEVNULL)
    shutil.copy(REPOSITORY / "sgstore" / RECORDING, package / RECORDING)
    for name in ("tests", "tools", "docs", "bench", "samples"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / name, folder / "copy" / name, ignore=ignored)
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(REPOSITORY / name, folder / "copy")
    tests = [f"tests/core/{name}" for name in SHORT]
    command = [str(programs / "pytest"), "-q", "-n", "2", "--dist", "loadfile", *tests]
    data = os.environ.get("SGSTORE_DATA") or str((REPOSITORY / "../shared/data").resolve())
    subprocess.run(
        [*command, "-p", "no:cacheprovider"],
        check=True,
        cwd=folder / "copy",
        env={**os.environ, "SGSTORE_DATA": data},
    )


def try_versions(folder: Path) -> None:
    """Ask the same of the lowest and of the highest versions.

    Raises
    ------
    subprocess.CalledProcessError
        A verb fails.
    AssertionError
        The answers differ.
    """
    wheel = build(folder, isolated=False)  # ``wheel`` builds it as it is published
    constraints = folder / "lowest.txt"
    constraints.write_text("\n".join(lowest()), encoding="utf-8")
    low = environment(folder / "low", str(wheel), "--constraint", str(constraints))
    high = environment(folder / "high", str(wheel))
    for programs in (low, high):
        own = folder / f"of-{programs.parent.name}"
        own.mkdir()
        recording = str(REPOSITORY / "sgstore" / RECORDING)
        asked(programs, own, "ingest", "town.sgstore", recording, "--until", "30s")
    # Each asks what the other made: where rows or answers of one differ, so do these.
    ours = answers(low, folder / "of-high")
    theirs = answers(high, folder / "of-low")
    for verb, one, two in zip(VERBS, ours, theirs, strict=True):
        assert one == two, f"sgstore {' '.join(verb)}\nlow asks high: {one}\nhigh asks low: {two}"
    for programs in (low, high):
        print(f"{programs.parent.name}: {', '.join(versions(programs))}")


def asked(programs: Path, folder: Path, *verb: str) -> str:
    """What a verb of an environment prints."""
    command = [str(programs / "sgstore"), *verb]
    done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=folder)
    if done.returncode:
        print(f"{programs.parent.name}: sgstore {' '.join(verb)}\n{done.stdout}{done.stderr}")
        done.check_returncode()
    return done.stdout


ANSWERS = """
import contextlib, io, json, sys
from sgstore.apps.cli import run
for verb in json.load(sys.stdin):
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = run(verb)
    print(json.dumps([code, out.getvalue()]))
"""
"""A process that is asked many command lines: to start one for each takes longer than the answers."""


def answers(programs: Path, folder: Path) -> list[Any]:
    """What an environment answers to each of the verbs.

    Raises
    ------
    subprocess.CalledProcessError
        The process fails.
    AssertionError
        A verb fails.
    """
    done = subprocess.run(
        [str(programs / "python"), "-c", ANSWERS],
        input=json.dumps(VERBS),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        cwd=folder,
    )
    found: list[Any] = []
    for verb, line in zip(VERBS, done.stdout.splitlines(), strict=True):
        code, text = json.loads(line)
        assert code == 0, f"{programs.parent.name}: sgstore {' '.join(verb)}\n{text}"
        found.append(plain(text))
    return found


def plain(text: str) -> Any:
    """What was printed, without what differs from run to run, and numbers rounded: sums have any order."""
    if not text.startswith(("[", "{")):
        return text
    return _plain(json.loads(text))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items() if key not in VARIES}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return float(f"{value:.9g}") if isinstance(value, float) else value


def versions(programs: Path) -> list[str]:
    """Packages of an environment that ``pyproject.toml`` names, with their versions."""
    names = {constraint.partition("==")[0] for constraint in lowest()}
    of = ["--python", str(programs / "python"), "list", "--format=json"]
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *of]
    listed = subprocess.run(command, check=True, capture_output=True, text=True)
    return [f"{p['name']} {p['version']}" for p in json.loads(listed.stdout) if p["name"] in names]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        {"wheel": try_wheel, "versions": try_versions}[sys.argv[1]](Path(scratch))
