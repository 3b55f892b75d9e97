"""Settings as commented TOML text, and the documentation page of all settings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from importlib import resources
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

from sgstore.base.docstrings import split_docstring
from sgstore.model.config._settings import Config

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sgstore.model.config._presets import Preset


WIDTH: Final = 98
"""Line width of comments in TOML; characters."""


def as_toml(config: Config) -> str:
    """Return all settings as TOML text, each with its comment. :func:`load` reads this text."""
    _, own = split_docstring(Config)
    lines = ["# Settings of sgstore. Lengths are metres, angles degrees, times seconds.", ""]
    tables: list[str] = []
    for one in fields(config):
        value = getattr(config, one.name)
        if is_dataclass(value):
            about, comments = split_docstring(type(value))
            tables += ["", f"# {about.splitlines()[0]}", f"[{one.name}]"]
            for inner in fields(value):
                tables += _setting(inner.name, getattr(value, inner.name), comments)
        elif one.name == "relations":
            tables += ["", *_comment(own[one.name][1]), *([] if value else ["[relations]"])]
            for name, values in value.items():
                tables.append(f"[relations.{name}]")
                tables += [f"{k} = {_literal(v)}" for k, v in values.items()]
        elif isinstance(value, Mapping):
            tables += ["", *_comment(own[one.name][1]), f"[{one.name}]"]
            tables += [f"{_text(key)} = {_meaning(asdict(v))}" for key, v in value.items()]
        else:
            lines += _setting(one.name, value, own)
    return "\n".join([*lines, *tables, ""])


def _setting(name: str, value: Any, comments: Mapping[str, tuple[str, str]]) -> list[str]:
    return [*_comment(comments[name][1]), f"{name} = {_literal(value)}"]


def _comment(text: str) -> list[str]:
    return [f"# {line}" for paragraph in text.splitlines() for line in wrap(paragraph, WIDTH)]


def _literal(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_literal, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return _text(value) if isinstance(value, str) else repr(value)


def _text(value: str) -> str:
    # Every JSON string of characters above U+001F is a TOML string, but for DEL.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _meaning(parts: dict[str, str]) -> str:
    said = ", ".join(f"{name} = {_text(word)}" for name, word in parts.items() if word)
    return f"{{ {said} }}"


def as_markdown(presets: Mapping[str, Preset]) -> str:
    """Return the text of ``docs/parameters.md``: all settings with their defaults, and the presets."""
    parts = [_preset_text(name, one) for name, one in presets.items()]
    page = resources.files("sgstore.model.config").joinpath("parameters.md")
    text = page.read_text(encoding="utf-8")
    return text.format(settings=as_toml(Config()), presets="\n".join(parts))


def _preset_text(name: str, one: Preset) -> str:
    different = list(_differences(Config().as_dict(), one.config.as_dict(), ""))
    changes = ["```toml", *different, "```", ""] if different else []
    return "\n".join([f"### `{name}`", "", one.summary, "", *changes, one.notes])


def _differences(
    default: Mapping[str, Any], other: Mapping[str, Any], prefix: str
) -> Iterator[str]:
    for name, value in other.items():
        if isinstance(value, Mapping) and name not in {"types", "relations"}:
            yield from _differences(default[name], value, f"{prefix}{name}.")
        elif value != default[name]:
            yield f"{prefix}{name} = {_literal(value)}"
