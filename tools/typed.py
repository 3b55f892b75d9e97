"""Types of the package, checked unless nothing has changed since they were found right: ``make lint``.

To check them takes a processor a minute or more. A digest of what was found right is kept in ``build/types``:
of the sources, of the settings, and of the versions of all packages, whose types count, too.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "build" / "types"


def digest() -> str:
    """Digest of all that decides what is said of types."""
    made = hashlib.sha256()
    for path in (*sorted((ROOT / "sgstore").rglob("*.py*")), ROOT / "pyproject.toml"):
        if path.suffix in {".py", ".pyi", ".toml"}:
            made.update(f"{path.relative_to(ROOT)}\0".encode() + path.read_bytes() + b"\0")
    made.update(repr(sorted(f"{one.name} {one.version}" for one in distributions())).encode())
    return made.hexdigest()


def main() -> int:
    now = digest()
    if KEPT.exists() and KEPT.read_text() == now:
        print("types: as they were when they were checked")
        return 0
    code = subprocess.run(
        [Path(sys.executable).parent / "basedpyright"], cwd=ROOT, check=False
    ).returncode
    if not code and digest() == now:
        KEPT.parent.mkdir(exist_ok=True)
        KEPT.write_text(now)
    return code


if __name__ == "__main__":
    sys.exit(main())
