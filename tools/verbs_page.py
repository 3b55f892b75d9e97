"""Write the table of verbs of ``docs/commands.md`` from the signatures of the library: ``make api``."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from sgstore.base.docstrings import split_docstring
from sgstore.query import Store, StoreVerbs

PAGE = Path(__file__).parents[1] / "docs" / "commands.md"

TITLE = "## Verbs in Python"
WORDS = {"form": "as", "labels": "label", "mounts": "mount", "channels": "channel"} | {
    "measures": "measure",
    "manoeuvres": "manoeuvre",
    "traces": "trace",
    "parameters": "param",
    "timeout_s": "timeout",
    "max_rows": "limit",
}
"""Names in Python → words of the command line: a list is a repeated option, and ``as`` is a keyword."""


def plain(text: str) -> str:
    """Return a sentence of a docstring with the quotes of Markdown."""
    return re.sub(r":\w+:`~?", "`", text).replace("``", "`")


def table() -> str:
    """The section with one table for each verb: option, name in Python, default and meaning."""
    lines = [f"{TITLE}\n", "`store.VERB(…)` takes the options of `sgstore VERB`.\n"]
    others = {verb: getattr(Store, verb) for verb in ("find", "why_not", "sql", "check")}
    for verb, method in {**others, **vars(StoreVerbs)}.items():
        if verb.startswith("_"):
            continue
        about = split_docstring(method)[1]
        first = plain((method.__doc__ or "").partition("\n")[0])
        lines += [f"**{verb.replace('_', '-')}**: {first}\n"]
        lines += ["| Option | Python | Default | Meaning |", "|---|---|---|---|"]
        for one in inspect.signature(method).parameters.values():
            if one.name in about and (one.kind is one.KEYWORD_ONLY or method in others.values()):
                word = WORDS.get(one.name, one.name).replace("_", "-")
                option = word.upper() if one.kind is one.POSITIONAL_ONLY else f"--{word}"
                free = one.default in (None, (), "", False, one.empty)
                default = "" if free else f"`{one.default}`"
                text = plain(about[one.name][1]).replace("|", "\\|")
                lines.append(f"| `{option}` | `{one.name}` | {default} | {text} |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    """Replace the section in the page, or append it."""
    text = PAGE.read_text(encoding="utf-8")
    before, found, after = text.partition(f"{TITLE}\n")
    rest = re.search(r"^## ", after, re.MULTILINE) if found else None
    kept = f"\n{after[rest.start() :]}" if rest else ""
    PAGE.write_text(f"{before.rstrip()}\n\n{table()}{kept}", encoding="utf-8")


if __name__ == "__main__":
    main()
