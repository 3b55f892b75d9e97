"""One table of verbs: command line, Python, assistants and the page of commands have the same words."""

from __future__ import annotations

import asyncio
import inspect
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
import typer
from verb_lines import verbs
from verbs_page import PAGE, table

from sgstore.apps.assistant import StoreTools, server_of
from sgstore.apps.cli import app, run
from sgstore.apps.cli._options import OLD_WORDS, library_help
from sgstore.base.docstrings import split_docstring
from sgstore.draw import draw_stored
from sgstore.ingest import ingest
from sgstore.query import Store, StoreVerbs

COMMANDS = verbs(typer.main.get_command(app))
PATHS = [
    *("select", "prioritize", "criticality", "diff", "report", "export", "timeline"),
    *(path for path in COMMANDS if path.startswith("coverage ")),
    *("verify", "lock verify", "like", "shrink"),
    *("find", "why-not", "sql", "check", "payload", "info", "ingest", "show"),
]
"""Commands with a method of the library."""

FUNCTIONS = {"ingest": ingest, "show": draw_stored}
"""Commands whose method passes its options on to a function."""

WITHOUT_METHOD = {
    **dict.fromkeys(("doctor", "map", "lint", "translate"), "about a file, not a store"),
    **dict.fromkeys(("record", "monitor", "demo", "try"), "a recording, or a simulator"),
    **dict.fromkeys(("serve", "mcp"), "a server"),
    **dict.fromkeys(("config", "docs"), "about the package"),
    **dict.fromkeys(("import", "remove", "rebuild", "derive"), "a function of the library"),
    **dict.fromkeys(
        (path for path in COMMANDS if path.split()[0] in {"patterns", "collection"}), "a group"
    ),
    **dict.fromkeys(("lock list", "lock union", "lock intersect", "lock minus"), "methods of Lock"),
}
"""Commands without a method of a store, each with its reason."""

OWN_OPTIONS = {
    *("store", "file", "name", "names", "files", "checks", "every", "quiet", "verbose", "a", "b"),
    *(
        "tables",
        "timeout",
        "max_spill",
        "engine",
        "partial",
        "rows_as",
        "as_json",
        "require",
        "require_known",
    ),
    *("to", "picture", "curve", "limit", "top", "threshold", "novel", "train", "test", "path"),
}
"""Options of the process: where texts come from, limits, and the form of the output."""

DIFFERENT = {
    ("coverage windows", "window"): "a command for windows of ten frames",
    ("coverage failures", "outcomes"): "required there",
    ("lock verify", "payloads"): "read for a lock, not for a store",
    ("verify", "payloads"): "one sentence for a store",
    ("like", "every"): "--all is each_trace=False",
    ("diff", "query"): "an option, because B is an argument",
    ("coverage spec", "query"): "its own sentence",
    ("timeline", "parts"): "Store.parts",
    ("export", "frames"): "a file with their names",
    ("timeline", "to"): "without it the terminal shows lanes",
    **dict.fromkeys((("report", "to"), ("export", "to"), ("shrink", "to")), "a file or a folder"),
    **dict.fromkeys((("select", "to"), ("prioritize", "to")), "Store.lock writes a lock"),
}
"""Differences that stay, each with its reason."""

ADDED = {
    "find": {"count", "explain", "each_frame", "safe"},  # methods of Matches; a process of its own
    "sql": {"statement", "each", "safe"},  # its text; the stores of a collection; a process
    "check": {"explain", "texts", "junit", "sarif", "evidence", "library"},  # files for others
    "info": {"traces"},  # fewer rows
    "payload": {"message"},  # Store.picture has the picture
    "ingest": {
        "config",
        "preset",
        "ego",
        "shard",
    },  # objects in Python: config, egos; of collections
    "show": {"fps"},  # of a clip: Store.animate
}
"""Options of commands that their method lacks, each with its reason."""

OWN_SENTENCES = {
    ("payload", "channel"): "without it, the command lists the topics",
    **dict.fromkeys(
        (
            (path, name)
            for path, of in FUNCTIONS.items()
            for name in inspect.signature(of).parameters
        ),
        "texts in place of objects",
    ),
}
"""Options with a sentence of the command, each with its reason."""


def method_of(path: str) -> Any:
    if path in FUNCTIONS:
        return FUNCTIONS[path]
    (word, *_) = (word for word in path.split() if word != "lock")
    return getattr(Store, word.replace("-", "_"))


def seconds(default: Any) -> Any:
    """A default, where a time of the command line is a number of seconds for an assistant."""
    times = {2.0: "2s"}
    return times.get(default, plain(default)) if isinstance(default, float) else plain(default)


def plain(default: Any) -> Any:
    """A default without the differences of the languages: text and path, empty list and none."""
    return None if default in (None, (), "", []) else str(default)


def shared(path: str) -> dict[str, tuple[Any, inspect.Parameter]]:
    """Options of a command that its method has, too."""
    known = inspect.signature(method_of(path)).parameters
    return {
        one.name: (one, known[one.name])
        for one in COMMANDS[path].params
        if one.name in known and (path, one.name) not in DIFFERENT
    }


def test_every_command_is_compared_or_has_a_reason() -> None:
    assert {*PATHS}.isdisjoint(WITHOUT_METHOD)
    assert {*COMMANDS} == {*PATHS, *WITHOUT_METHOD}


def test_every_method_with_the_words_of_a_command_is_compared() -> None:
    compared = {one for path in PATHS for one in path.replace("-", "_").split()}
    verbs_of_stores = {name for name in vars(StoreVerbs) if not name.startswith("_")}

    assert verbs_of_stores <= compared
    assert {*vars(Store)} & {path.replace("-", "_") for path in WITHOUT_METHOD} == set()


@pytest.mark.parametrize("path", PATHS)
def test_a_command_has_the_words_of_its_method(path: str) -> None:
    known = inspect.signature(method_of(path)).parameters
    about = library_help(path)
    for name, (option, parameter) in shared(path).items():
        required = parameter.default is parameter.empty or option.required
        assert required or plain(option.default) == plain(parameter.default), name
        own = OWN_OPTIONS | {"query", "queries", "parameters", "ignore", "clip", "frame"}
        if name not in own and (path, name) not in OWN_SENTENCES:
            assert option.help in {None, "", about[name]}, name
    own = OWN_OPTIONS | ADDED.get(path, set())
    extra = {one.name for one in COMMANDS[path].params} - known.keys() - own
    extra = {name for name in extra if (path, name) not in DIFFERENT}
    assert extra <= {"query", "parameters", "split", "payloads", "queries", "describe"}, path
    for one in COMMANDS[path].params:
        assert one.help or one.name in about or one.name in {"a", "b"}, one.name


@pytest.mark.parametrize("verb", ["select", "prioritize", "coverage", "report", "export"])
def test_a_method_has_no_option_that_its_commands_lack(verb: str) -> None:
    commands = [one for path, one in COMMANDS.items() if path.split()[0] == verb]
    options = {one.name for command in commands for one in command.params}
    known = inspect.signature(getattr(Store, verb)).parameters.keys() - {"self", "kind", "query"}
    assert known <= options | {"parameters"}


def test_types_are_the_same() -> None:
    """A choice has the same values, a number is a number, and a list is a list."""
    for path in PATHS:
        for name, (option, parameter) in shared(path).items():
            kind = str(parameter.annotation)
            multiple = kind.startswith(("Sequence", "Mapping", "object"))
            assert option.multiple is multiple or option.param_type_name == "argument", name
            choices = re.findall(r"'(\w+)'|\"(\w+)\"", kind) if kind.startswith("Literal") else []
            shown = choices and option.get_help_record(typer.Context(COMMANDS[path]))[0]
            for one in choices:
                assert "".join(one) in shown, (path, name, shown)
            if kind == "bool":
                assert option.is_flag, name
            if re.fullmatch(r"(?:int|float)(?: \| None)?", kind):
                if name in {"since", "until"}:  # texts such as 10s
                    continue
                shown = option.display_type(typer.Context(COMMANDS[path]))
                assert re.search(r"(?i)int|float|number", shown), (path, name, shown)


OF_TOOLS = {"export_clips": "export", "coverage_missing": "coverage", "list_traces": "traces"}
"""Tools of assistants → methods with another name."""

TOOLS_ALONE = {"vocabulary": "the pages of the documentation", "patterns_search": "patterns search"}
"""Tools without a method, each with its counterpart."""

JSON_TYPES = {"bool": "boolean", "int": "number", "float": "number", "Sequence": "array"} | {
    "list": "array",
    "Mapping": "object",
    "dict": "object",
}
"""Types of Python → types of JSON; all others are texts."""


def json_types(schema: dict[str, Any]) -> set[str]:
    """The types of an argument in a JSON schema, without null."""
    several = [one["type"] for one in schema.get("anyOf", [schema])]
    return {"number" if one == "integer" else one for one in several} - {"null"}


def test_every_tool_is_compared_and_has_the_types_of_its_method() -> None:
    compared = set[str]()
    for tool in asyncio.run(_tools()):
        method = getattr(Store, OF_TOOLS.get(tool.name, tool.name), None)
        assert (method is None) is (tool.name in TOOLS_ALONE), tool.name
        known = {} if method is None else inspect.signature(method).parameters
        for name, schema in tool.input_schema["properties"].items():
            if name in known and not str(known[name]).startswith("*"):
                words = str(known[name].annotation).split(" | ")
                kinds = {JSON_TYPES.get(word.partition("[")[0], "string") for word in words}
                assert json_types(schema) <= kinds, (tool.name, name)
                compared.add(tool.name)
    assert compared >= {"find", "why_not", "timeline", "show", "picture", *OF_TOOLS} - {
        "list_traces"
    }


def test_tools_of_assistants_have_the_same_words() -> None:
    of = {"export_clips": "export", "coverage_missing": "coverage", "check": "check"}
    differing = {
        *(("find", "limit"), ("sql", "limit"), ("check", "limit")),  # bounded answers
        *(("coverage_missing", "abstraction"), ("coverage_missing", "of_ego")),  # a smaller choice
        *(("timeline", "traces"), ("export_clips", "limit"), ("show", "query")),
    }
    for name in ("find", "why_not", "sql", "check", "timeline", "show", "picture", *of):
        tool, method = getattr(StoreTools, name), getattr(Store, of.get(name, name))
        known = inspect.signature(method).parameters
        for one in inspect.signature(tool).parameters.values():
            if one.name in known and one.name != "self" and (name, one.name) not in differing:
                free = inspect.Parameter.empty in (one.default, known[one.name].default)
                assert free or seconds(one.default) == seconds(known[one.name].default), name


def test_tools_of_assistants_have_the_same_sentences() -> None:
    """The first sentence is that of the command or method, and arguments with one name have one sentence."""
    of = {"export_clips": "export", "coverage_missing": "coverage"}
    same = 0
    own = {("coverage_missing", "by"), ("coverage_missing", "query"), ("export_clips", "query")}
    own |= {("export_clips", "parameters")}  # a query of one store, and values as an object
    with_server = {tool.name: tool for tool in asyncio.run(_tools())}
    for name in ("find", "why_not", "sql", "check", "timeline", "show", *of):
        word = of.get(name, name)
        method, tool = getattr(Store, word), with_server[name]
        sentences = {split_docstring(method)[0].partition(". ")[0].strip(".") + "."}
        sentences |= {
            (one.help or "").splitlines()[0]
            for path, one in COMMANDS.items()
            if path.split()[0] == word.replace("_", "-")
        }
        first = tool.description.splitlines()[0]
        assert first in sentences or name == "coverage_missing", (first, sentences)
        about = split_docstring(method)[1] if hasattr(StoreVerbs, word) else {}
        for argument, schema in tool.input_schema["properties"].items():
            if argument in about and (name, argument) not in own:
                assert schema["description"] == about[argument][1], (name, argument)
                same += 1
    assert same >= 8


async def _tools() -> Any:
    with StoreTools.__new__(StoreTools) as tools:
        tools.close = lambda: None  # type: ignore[method-assign]
        vars(tools)["_write_to"] = Path()
        return await server_of(tools).list_tools()


def test_the_page_of_commands_has_the_table() -> None:
    assert table() in PAGE.read_text(encoding="utf-8"), "run 'python tools/verbs_page.py'"


def test_one_word_means_one_thing() -> None:
    """A flag is a flag in all commands, and an option with a value has one kind of value."""
    kinds: dict[str, dict[Any, list[str]]] = defaultdict(lambda: defaultdict(list))
    for path, command in COMMANDS.items():
        for one in command.params:
            for word in one.opts if one.param_type_name == "option" else ():
                kinds[word][(bool(one.is_flag), one.name)].append(path)
    several = {word: dict(of) for word, of in kinds.items() if len(of) > 1}
    names = {"--all": "the names of Python differ"}
    names |= dict.fromkeys(
        ("--trace", "--file", "-f", "--pattern", "-p", "--novel"), "one or several"
    )
    names |= {
        "--timeout": "of a question",
        "--json": "",
        "--format": "",
        "--frames": "",
        "--kind": "",
    }
    names |= {"--as": "of files", "--query": "", "--measure": "", "-m": ""}
    assert several.keys() <= names.keys(), several
    assert {word for word, of in several.items() if len({flag for flag, _ in of}) > 1} == set()


def test_the_same_option_has_one_sentence() -> None:
    texts: dict[str, set[str]] = defaultdict(set)
    for path, command in COMMANDS.items():
        about = library_help(path)
        for one in command.params:
            if {"--limit", "--format", "--of-ego", "--within", "--manoeuvre"} & {*one.opts}:
                texts[one.opts[0]].add(one.help or about[one.name])
    assert {word: many for word, many in texts.items() if len(many) > 1} == {}


def test_no_help_has_a_placeholder_of_a_flag(capsys: pytest.CaptureFixture[str]) -> None:
    for path in ("find", "select", "coverage combos", "serve", "report"):
        assert run([*path.split(), "--help"]) == 0
        assert "bool" not in capsys.readouterr().out


def test_no_help_has_a_type_of_python(capsys: pytest.CaptureFixture[str]) -> None:
    for path in ("check", "info", "lint", "patterns list", "select", "timeline"):
        assert run([*path.split(), "--help"]) == 0
        assert not re.search(r"list\[|<(?:str|Path|int|float)\b", capsys.readouterr().out), path


# Old words


@pytest.mark.parametrize("path", OLD_WORDS)
def test_an_old_word_works_with_a_note(
    path: str, town_store: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    for old, new in OLD_WORDS[path].items():
        command = COMMANDS[path or ("find" if new == "--limit" else "check")]
        given: dict[str, Any] = {}
        monkeypatch.setattr(command, "callback", lambda given=given, **values: given.update(values))
        option = next(one for one in command.params if new in one.opts)
        value = () if option.is_flag else (_value_of(option),)
        needed = ["x"] * sum(o.required and o.param_type_name == "argument" for o in command.params)
        more = ["--as", "s3c"] if (path, old) == ("import", "--rows") else []
        more += ["--by", "x"] if path.startswith("coverage") and new != "--by" else []
        line = [*(path.split() or [command.name]), str(town_store), *needed[1:], *more, old, *value]

        assert run(line) in {0, None}, line
        assert f"{old} is now {new}" in capsys.readouterr().err
        assert plain(given[option.name]) is not None


VALUES = {"--limit": "3", "--as": "s3c", "--format": "csv", "--items": "clips", "--order": "both"}
VALUES |= {"--objective": "frames", "--alpha": "0.5", "--to": "x.csv"}


def _value_of(option: Any) -> str:
    return VALUES.get(option.opts[0], "x")


def test_new_words_are_not_renamed(
    town_store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["export", str(town_store), "cut_in", "--to", str(tmp_path / "new"), "--format", "json"]
    assert run(line) == 0
    assert "is now" not in capsys.readouterr().err


def test_an_old_word_of_other_commands_is_not_renamed(
    town_store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["info", str(town_store), "--output", "x"]) == 2
    told = capsys.readouterr().err
    assert "No such option: --output" in told
    assert "is now" not in told


def test_library_help_is_that_of_the_docstring() -> None:
    about = split_docstring(Store.select)[1]
    assert library_help("select")["minimal"] == about["minimal"][1]
