"""Read an export with other clients, each in an environment of its own: ``make clients`` (downloads them).

python tools/client_matrix.py [NAME…]      those whose names begin so; all by default
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from clients import CLIENTS, Client

import sgstore
from sgstore.apps.cli import run
from sgstore.apps.demo import RECORDING

HOME = Path(__file__).parents[1] / "build" / "clients"


def exports(folder: Path) -> int:
    """Write a store and its exports into a folder, and return the number of rows of the ego."""
    store = folder / "town.sgstore"
    assert run(["ingest", str(store), str(RECORDING), "--until", "5"]) == 0
    for form in ("duckdb", "parquet"):
        assert run(["export", str(store), "--as", form, "--to", str(folder / form)]) == 0
    return sgstore.open(store).sql("SELECT count(*) FROM nodes WHERE is_ego").values[0][0]


def answer(python: str, client: Client, folder: Path) -> str:
    """What a client prints with a Python; its last lines of errors if it fails."""
    place = Path(tempfile.mkdtemp(dir=folder))
    arguments = [folder / "duckdb" / "scenes.duckdb", folder / "parquet", place]
    command = [python, "-c", client.program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=place, check=False)
    last = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    return last[-1] if last else ""


def environment(name: str, client: Client) -> str:
    """The Python of the environment of a client, made if it is missing; empty if it cannot be made."""
    place = HOME / "".join(c if c.isalnum() else "-" for c in name)
    python = place / "bin" / "python"
    if not (place / ".done").exists():
        shutil.rmtree(place, ignore_errors=True)
        uv = [sys.executable, "-m", "uv"]
        steps = [
            [*uv, "venv", "-q", "--python", sys.executable, str(place)],
            [*uv, "pip", "install", "-q", "--python", str(python), *client.packages],
        ]
        for step in steps:
            if subprocess.run(step, check=False).returncode:
                return ""
        (place / ".done").touch()
    return str(python)


def main(names: list[str]) -> int:
    chosen = {n: c for n, c in CLIENTS.items() if not names or n.startswith(tuple(names))}
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        expected = str(exports(Path(folder)))
        for name, client in chosen.items():
            python = environment(name, client)
            found = answer(python, client, Path(folder)) if python else "cannot be installed"
            good = found == expected
            wrong += not good
            print(f"{name:14} {'ok' if good else found}", flush=True)
    print(f"{len(chosen) - wrong} of {len(chosen)} clients read the export")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
