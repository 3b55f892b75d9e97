"""The documentation as a site: ``make docs``. Every page is one of the repository, which is read there, too."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pygments.lexer import RegexLexer
from pygments.lexers.special import TextLexer
from pygments.token import Comment, Keyword, Name, Number, Operator, Punctuation, String, Text

import sgstore
from sgstore.lang.syntax import keywords

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project, author, release = "sgstore", "the sgstore contributors", sgstore.__version__
project_copyright = author

extensions = ["myst_parser"]
root_doc = "README"
include_patterns = ["*.md", "docs/**.md", "samples/town/README.md", "sgstore/mcap/README.md"]
exclude_patterns = ["docs/description.md"]  # of the package index, which says what README says
myst_heading_anchors = 4
highlight_language = "text"

html_theme = "furo"
html_title = f"sgstore {release}"
html_show_sphinx = False
html_copy_source = False
html_static_path = ["site.css"]
html_css_files = ["site.css"]

_project = tomllib.loads(Path(__file__).parents[1].joinpath("pyproject.toml").read_text("utf-8"))
if _source := _project["project"]["urls"].get("Source"):  # the one place that tells the address
    html_theme_options = {
        "source_repository": _source,
        "source_branch": "main",
        "source_directory": "",
    }

CONTENTS = {
    "Start": ("docs/install", "docs/first-hour", "docs/gallery", "docs/pictures/README"),
    "How do I": (
        *("docs/howto_cut_ins", "docs/howto_carla_pyg", "docs/howto_autoware", "docs/howto_ci"),
        *("docs/howto_bi", "docs/howto_not_read", "docs/howto_share", "docs/howto_upgrade"),
        *("docs/cookbook", "docs/notebooks", "docs/explorer", "docs/assistants", "docs/online"),
    ),
    "Reference": (
        *("docs/commands", "docs/api", "docs/language", "docs/one_page", "docs/patterns"),
        *(
            "docs/views",
            "docs/graphs",
            "docs/relations",
            "docs/parameters",
            "docs/exports",
            "docs/topics",
        ),
        *("docs/coverage", "docs/selection", "docs/criticality", "docs/scale", "docs/flavours"),
        *("docs/source_osi", "docs/source_carla", "docs/source_autoware", "docs/source_foxglove"),
        *("docs/source_av2", "docs/source_py123d", "docs/source_rosbags", "docs/source_sumo"),
        *("docs/source_commonroad", "docs/source_lanelet2", "docs/glossary"),
    ),
    "Why": ("docs/why", "docs/noise", "docs/performance", "docs/reproduction"),
    "Work on it": (
        *("docs/architecture", "CONTRIBUTING", "sgstore/mcap/README", "samples/town/README"),
        *("SECURITY", "CODE_OF_CONDUCT", "CHANGELOG"),
    ),
}
"""The pages in their order: one that is missing here, or is not there, ends the build."""


def _with_contents(app: Sphinx, page: str, source: list[str]) -> None:
    """Append the list of all pages to the first one, where the theme looks for it."""
    if page == root_doc:
        for caption, names in CONTENTS.items():
            pages = "\n".join(names)
            source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n{pages}\n```\n"


def _with_start(app: Sphinx, exception: Exception | None) -> None:
    """Let the site begin where a browser looks for it."""
    if exception is None:
        page = f'<!doctype html><meta http-equiv="refresh" content="0; url={root_doc}.html">'
        (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


class QueryLexer(RegexLexer):
    """Colours of queries: words of the language, labels and relations, functions, values."""

    name, aliases = "sgql", ["sgql", "sgql-check"]
    flags = re.IGNORECASE
    tokens = {  # noqa: RUF012  as Pygments has it
        "root": [
            (r"--[^\n]*", Comment.Single),
            (r"'(?:[^'\\]|\\.)*'|\"(?:[^\"\\]|\\.)*\"", String),
            (
                rf"\b(?:{'|'.join(sorted(filter(str.isalpha, keywords()), reverse=True))})\b",
                Keyword,
            ),
            (r"\$\w+", Name.Variable),
            (r"(?<=:)\s*\w+", Name.Class),
            (r"\w+(?=\()", Name.Function),
            (r"\d+(?:\.\d+)?(?:ms|s|min|frames)?\b", Number),
            (r"\w+", Name),
            (r"[-<>=!+*/%|&]+", Operator),
            (r"[^\w\s]", Punctuation),
            (r"\s+", Text),
        ]
    }


def setup(app: Sphinx) -> dict[str, Any]:
    """Make what is said above known."""
    for name in QueryLexer.aliases:
        app.add_lexer(name, QueryLexer)
    app.add_lexer("csv", TextLexer)
    app.connect("source-read", _with_contents)
    app.connect("build-finished", _with_start)
    return {"parallel_read_safe": True}
