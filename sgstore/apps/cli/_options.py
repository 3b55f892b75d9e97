"""Shared arguments and options of the commands, and their typer classes.

A command describes its options in its docstring. This docstring describes options of several commands.

Parameters
----------
store : STORE
    The store: one DuckDB file.
frame : FRAME
    A frame_id, TRACE#SEQ, or TRACE@12.3s.
parameters : NAME=VALUE
    Value of $NAME in the query; write a list as [1, 2]; repeatable.
tables : [NAME=]FILE
    Join a table of your own (Parquet, CSV, JSON): by frame_id, or by trace and seq, time_ns or t;
    repeatable.
query : QUERY
    A pattern: 'MATCH (e:Ego) …', the name of one in the library, or a file.
file
    Read the query from a file; - reads stdin.
picture : FILE
    Picture to draw: .png or .svg.
trace
    Use only this trace; repeatable.
traces
    Use only this trace; repeatable.
look_in : FOLDER
    Folder with recordings that were moved; repeatable.
jobs
    Recordings to read at a time; 0: one per core.
as_json
    Short for --format json.
to : FILE
    Write to this file instead of stdout.
url : URL
    The collection: a folder, or s3://bucket/prefix.
a : A
    Frames: a store or a collection, STORE:QUERY for matching frames, STORE:TESTS.lock for the
    frames of a lock; TESTS.lock alone uses the store in its folder with its recordings.
b : B
    Frames, written like A.
limit
    Maximum number of results; 0: all.
safe
    Run in a separate process with bounded time (5s), memory and rows.
name : NAME
    Name of a pattern, such as cut_in or ParkingExit.
kinds
    Only this kind; repeatable.
force
    Read again and replace traces of the store.
path : LOCK
    A lock that select wrote.
payloads
    Include messages of sensors, which are read from the recordings.
files
    Read queries, or checks, from a file; repeatable.
"""

from __future__ import annotations

import inspect
import os
import re
import shlex
import sys
import tomllib
from collections import Counter
from copy import copy
from dataclasses import dataclass, fields, is_dataclass
from difflib import get_close_matches
from functools import cache, partial, wraps
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Final,
    Literal,
    get_args,
    get_origin,
    get_type_hints,
)

import typer
from typer import Argument, Option
from typer.core import TyperCommand, TyperGroup

import sgstore.apps.cli._completion as completion
from sgstore.apps.cli._completion import STORE
from sgstore.apps.cli._output import LONG_TABLE, Format, say, say_json, set_verbosity, write_rows
from sgstore.apps.cli._process import set_deadline
from sgstore.base.display import excerpts, number_of
from sgstore.base.docstrings import split_docstring
from sgstore.errors import ConfigError, url_named

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from sgstore.apps.sandbox import Answer
    from sgstore.collection import CollectionRows
    from sgstore.matches import Matches
    from sgstore.model.config import Config
    from sgstore.query import Store, UserStatement
    from sgstore.testsets.coverage import ChosenFrames, ReportTable


class Verb(TyperCommand):
    """Command of ``sgstore``. It rejects an option that occurs twice, except options with several values."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments of a command, and return the unparsed ones."""
        if ctx.resilient_parsing:  # completion of an unfinished command line
            # the value of this option is being typed
            whole = args[:-1] if args and args[-1].startswith("-") else args
            return super().parse_args(ctx, _with_store(self, ctx, whole))
        try:
            args = renamed(self, ctx, args)
            args = _with_store(self, ctx, args)
            _, _, order = self.make_parser(ctx).parse_args(args=list(args))
            given: Counter[Any] = Counter(order)
            for parameter, times in given.items():
                if times > 1 and _says_one_thing(parameter):
                    raise typer.BadParameter(
                        f"has {times} values; expected one", ctx=ctx, param=parameter
                    )
            rest = super().parse_args(ctx, list(args))
        except Exception as error:
            _advise(error, self, ctx, args)
            raise
        _refuse_late_store(self, ctx, args)
        return rest

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help of a command, followed by its examples.

        Options of a method of the library have the help of its docstring.
        """
        options: list[Any] = self.get_params(ctx)
        undescribed = [one for one in options if not one.help]
        about = library_help(_path_of(ctx)) if undescribed else {}
        for one in undescribed:
            one.help = about.get(one.name or "")
        for one in options:
            _show_plainly(one, ctx)
        super().format_help(ctx, formatter)
        _write_examples(ctx)


def _path_of(ctx: Any) -> str:
    """Return the words that name a command, without ``sgstore``."""
    return str(ctx.command_path).partition(" ")[2]


def library_help(path: str) -> dict[str, str]:
    """Return the help texts of a command's parameters from the library method with the same name."""
    from sgstore.query import Store  # only for help

    words = (word for word in path.split() if word not in _GROUPS)
    methods = (getattr(Store, word.replace("-", "_"), None) for word in words)
    method = next(filter(callable, methods), None)
    entries = {} if method is None else split_docstring(method)[1]
    return {name.strip("*"): text.replace("`", "") for name, (_, text) in entries.items()}


_GROUPS: Final = {"patterns", "lock", "collection"}
"""Groups of commands for which the library has no method of the same name."""

OLD_WORDS: Final[dict[str, dict[str, str]]] = {
    "": {"--output": "--to", "--max-rows": "--limit"},
    "coverage combos": {"--ego": "--of-ego"},
    "coverage explain": {"--vs": "--by", "--frames": "--by-frame"},
    "coverage novel": {"--not-in": "--by", "--list": "--items"},
    "coverage sequences": {"-m": "--manoeuvre"},
    "derive": {"--as": "--name"},
    "export": {"--format": "--as"},
    "import": {"--format": "--as", "--rows": "--format"},
    "like": {"--pattern": "--describe"},
    "prioritize": {"--by": "--order"},
    "select": {"--ego": "--of-ego", "--least": "--objective", "-m": "--manoeuvre"}
    | {"--temper": "--alpha"},
    "shrink": {"--clip": "--range"},
}
"""Old options of a command → new options; they work until 0.3. An empty command means all commands."""


def renamed(verb: Verb, ctx: Any, args: list[str]) -> list[str]:
    """Return the arguments of a command; old names of options are replaced. Print a note for each old name."""
    known = {word for one in verb.params for word in (*one.opts, *one.secondary_opts)}
    words = {old: new for old, new in OLD_WORDS[""].items() if new in known}
    words |= OLD_WORDS.get(_path_of(ctx), {})
    if words.get("--format") == "--as" and not _means_files(_path_of(ctx), args):
        del words["--format"]
    end = args.index("--") if "--" in args else len(args)
    found: list[str] = []
    for text in args[:end]:
        name, equals, value = text.partition("=")
        if new := words.get(name):
            say(f"{name} is now {new}; the old word works until 0.3")
            text = f"{new}{equals}{value}"  # noqa: PLW2901
        found.append(text)
    return [*found, *args[end:]]


def _means_files(path: str, args: Sequence[str]) -> bool:
    """True if the old option ``--format`` selects the format of written files; False for printed rows."""
    if any(one == "--as" or one.startswith("--as=") for one in args):
        return False
    values = [value for name, value in pairwise(args) if name == "--format"]
    values += [one.partition("=")[2] for one in args if one.startswith("--format=")]
    return path == "import" or not {*values} <= {*Format} - {Format.parquet}


_TYPES: Final = {"str": "text", "Path": "path", "int": "number", "float": "number"}
"""Python types → placeholders in the help."""


def _show_plainly(parameter: Any, ctx: Any) -> None:
    """Set how the help shows the value of a parameter: a placeholder, not a Python type; nothing for flags."""
    if getattr(parameter, "is_flag", False):
        parameter.metavar = ""
    kind = parameter.display_type(ctx).strip("<>").removeprefix("list[").removesuffix("]")
    kind = kind.removesuffix(" range")
    shown = f"<{_TYPES.get(kind, kind)}>"
    parameter.display_type = lambda *_: shown  # pyright: ignore[reportUnknownLambdaType]


@cache
def examples() -> dict[str, list[str]]:
    """Return the examples for the help of each command: the rest of the command line, and its purpose."""
    text = resources.files("sgstore.apps.cli").joinpath("examples.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def _write_examples(ctx: Any) -> None:
    """Print the examples of a command as plain lines without a frame, so that users can copy them."""
    lines: list[str] = []
    for one in examples().get(ctx.command_path.partition(" ")[2], ()):
        typed, _, purpose = one.rpartition("  # ")
        lines += ["", f"   # {purpose}", f"   sgstore {typed}"]
    typer.echo("\n".join([" Examples:", *lines[1:], "", ""]) if lines else "", nl=False)


def _with_store(verb: Verb, ctx: Any, args: list[str]) -> list[str]:
    """Return the arguments of a command. If the store is missing, insert the value of ``SGSTORE_STORE``.

    The first argument is a store if it looks like one, or if the number of arguments is complete.
    """
    named = os.environ.get(STORE)
    arguments = [one for one in verb.params if one.param_type_name == "argument"]
    if not named or not arguments or arguments[0].envvar != STORE:
        return args
    values, _, _ = verb.make_parser(ctx).parse_args(args=list(args))
    given = [text for one in arguments for text in _texts(values.get(one.name))]
    places = [one.nargs for one in arguments]
    if not given or _looks_like_store(given[0]) or (-1 not in places and len(given) == sum(places)):
        return args
    needed = sum(one.required for one in arguments[1:])
    whole = url_named(given[0]) is not None and len(given) > needed
    return args if whole else [named, *args]


def _texts(value: Any) -> list[str]:
    several = value if isinstance(value, list | tuple) else [value]
    return [one for one in several if isinstance(one, str)]


def _looks_like_store(place: str) -> bool:
    path = Path(place)
    return (
        _is_file(path / COLLECTION_FILE)
        or path.suffix in completion.STORE_ENDINGS
        or _is_database(path)
    )


def _advise(error: Any, verb: Verb, ctx: Any, args: list[str]) -> None:
    """Add advice to the message of a usage error, such as the right option."""
    name = getattr(error, "option_name", "")
    if type(error).__name__ == "NoSuchOption":
        error.possibilities = None
        if advice := _option_advice(verb, ctx, args, name):
            error.message = f"No such option: {name}; {advice}"
    stores = [one for one in args if _is_database(one)] if _places(verb) else []
    if len(stores) > 1 and "extra argument" in str(getattr(error, "message", "")):
        error.message = _several_stores(ctx, stores)
    elif type(error).__name__ == "UsageError" and "--trace" in _words_of(verb):
        _, extra, _ = verb.make_parser(ctx).parse_args(args=list(args))
        rest = [one for one in args if one not in extra]
        named = [word for one in extra for word in ("--trace", one)]
        if extra:
            line = shlex.join([*ctx.command_path.split(), *rest, *named])
            error.message = f"{error.message}; write: {line}"
    if type(error).__name__ == "MissingParameter":
        if error.param.name in _places(verb)[1:]:
            error.message = "Write the store first."
        elif "\n" in (text := error.format_message()):  # a line for each choice
            raise typer.BadParameter(" ".join(text.split()), ctx=ctx) from None


def _option_advice(verb: Verb, ctx: Any, args: list[str], name: str) -> str:
    """Return advice for an unknown option, or an empty text."""
    known = _words_of(verb)
    limits = "--limit", *_OPTIONS_OF_OTHERS["--limit"]
    if name in limits and "--format" in known and "--limit" not in known:
        return f"{verb.name} prints all rows; '| head' shows the first, -o FILE writes all"
    if line := _option_instead(verb, ctx, args, name):
        return f"write: {line}"
    others = _commands_with(ctx.find_root().command, name)
    return f"it is an option of: {', '.join(others)}" if others else ""


def _several_stores(ctx: Any, stores: Sequence[str]) -> str:
    """Return an error message for several stores where one is expected. It shows how to make a collection."""
    lines = [shlex.join(["sgstore", "collection", "pack", one, "fleet"]) for one in stores]
    each = " --each" if _path_of(ctx) == "sql" else ""
    lines.append(f"{ctx.command_path} fleet{each} …")
    return f"expected one store, found {len(stores)}; make a collection of them: {'; '.join(lines)}"


def _words_of(verb: Verb) -> list[str]:
    """Return the words of all options of a command, sorted."""
    return sorted({word for one in verb.params for word in (*one.opts, *one.secondary_opts)})


def _commands_with(command: Any, option: str, path: tuple[str, ...] = ()) -> list[str]:
    """Return those commands of a group, and of the groups inside it, that have an option."""
    inner = getattr(command, "commands", None)
    if inner is None:
        return [" ".join(path)] if option in _words_of(command) else []
    found = (_commands_with(one, option, (*path, name)) for name, one in inner.items())
    return sorted(name for names in found for name in names)


def _places(verb: Verb) -> list[str]:
    """Return the argument names of a command if the first one is a store; otherwise an empty list."""
    names = [one.name or "" for one in verb.params if one.param_type_name == "argument"]
    return names if names[:1] == ["store"] else []


_QUERY: Final = re.compile(r"\s*(?:MATCH|CHECK|SELECT|USING|DEFINE|ALWAYS)\b", re.IGNORECASE)
"""Regular expression of the start of a query, to detect a query in the position of the store."""


def _refuse_late_store(verb: Verb, ctx: Any, args: list[str]) -> None:
    """Raise an error if a store file is in the position of another argument, such as ``find QUERY STORE``."""
    values = [ctx.params[name] for name in _places(verb)]
    if not values or _is_database(values[0]):
        return
    later = [one for v in values[1:] for one in (v if isinstance(v, list | tuple) else [v])]
    found = next((one for one in later if one is not None and _is_database(one)), None)
    if found is not None:
        rest = [one for one in args if one != str(found)]
        line = shlex.join([*ctx.command_path.split(), str(found), *rest])
        reason = f"{values[0]} is not a store, but {found} is; write the store first"
        raise typer.BadParameter(f"{reason}; write: {line}", ctx=ctx)
    if _QUERY.match(str(values[0])):
        stores = [one.name for one in Path().iterdir() if one.suffix in completion.STORE_ENDINGS]
        store = stores[0] if len(stores) == 1 else "STORE"
        line = shlex.join([*ctx.command_path.split(), store, *args])
        raise typer.BadParameter(f"the store is missing; write: {line}", ctx=ctx)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a query is not a file name
        return False


def _is_database(place: str | Path) -> bool:
    path = Path(place)
    if not _is_file(path):  # opening a pipe would block
        return False
    try:
        with path.open("rb") as file:
            return file.read(12)[8:] == b"DUCK"
    except OSError:
        return False


class Group(TyperGroup):
    """Group of commands (such as ``sgstore coverage``) with examples at the end of its help.

    The error of an unknown command shows the right command line.
    """

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the first argument names, and the arguments of the command."""
        try:
            return super().resolve_command(ctx, args)
        except Exception as error:
            instead = _command_instead(self, ctx, args)
            if instead and hasattr(error, "message"):
                vars(error)["message"] = f"No such command {args[0]!r}; write: {instead}"
            raise

    _shows_options = True

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the options of the group; an empty list while the help of the group is written."""
        return super().get_params(ctx) if self._shows_options else []

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help of a group: its commands, its options and its examples."""
        self._shows_options = False
        try:
            super().format_help(ctx, formatter)
        finally:
            self._shows_options = True
        texts = {", ".join(one.opts): one.help or "" for one in self.get_params(ctx)}
        width = max(map(len, texts))
        typer.echo(
            "\n".join(["", " Options:", *(f"   {n:{width}}  {t}" for n, t in texts.items()), ""])
        )
        _write_examples(ctx)


_WORDS_OF_OTHERS: Final = {
    "info": ("list", "ls", "traces", "stat", "describe"),
    "find": ("query", "search", "match", "filter"),
    "sql": ("select-sql", "duckdb", "run"),
    "ingest": ("add", "load", "convert", "build", "create", "index", "init"),
    "show": ("view", "plot", "draw", "render", "picture"),
    "serve": ("explore", "explorer", "open", "ui", "web", "gui", "browse"),
    "remove": ("rm", "delete", "drop"),
    "export": ("clip", "clips", "cut", "extract"),
    "check": ("test", "validate", "rules", "assert"),
    "doctor": ("inspect", "diagnose"),
    "prioritize": ("rank", "order", "sort"),
    "criticality": ("metrics", "ttc"),
    "config": ("settings", "presets", "parameters"),
    "patterns list": ("library", "pattern", "scenarios"),
}
"""Name of a command → names of the same command in other tools."""


_OPTIONS_OF_OTHERS: Final = {
    "--to": ("--out", "--outfile", "--output-file", "--outdir", "--dest"),
    "--limit": ("--top", "--head", "--max", "--first", "-n"),
    "--format": ("--fmt", "--output-format"),
    "--file": ("--query-file", "--input"),
    "--pattern": ("--name",),
    "--param": ("--set", "--var", "--parameter"),
    "--jobs": ("--threads", "--workers", "--parallel"),
    "--force": ("--overwrite", "--replace"),
    "--trace": ("--recording",),
    "--since": ("--start",),
    "--until": ("--end", "--stop"),
    "--require": ("--fail", "--exit-code"),
    "--by": ("--versus", "--reference", "--baseline"),
}
"""Name of an option → names of the same option in other tools."""


_OPTIONS_OF_STORE: Final = {"-o", "--to", "--output", "--store", "-s", "--db", "--database"}
"""Options for a store in other tools. Here a store is the first argument."""


def _option_instead(verb: Verb, ctx: Any, args: list[str], name: str) -> str:
    """If an option is unknown, return a command line with a similar option; empty if none is similar."""
    known = _words_of(verb)
    others = [new for new, words in _OPTIONS_OF_OTHERS.items() if name in words and new in known]
    if name in _OPTIONS_OF_STORE and name in args[:-1] and _places(verb):
        place = args.index(name)
        return shlex.join(
            [*ctx.command_path.split(), args[place + 1], *args[:place], *args[place + 2 :]]
        )
    bare = {word.lstrip("-"): word for word in known}  # dashes would make all options similar
    elsewhere = len(name) > 2 and _commands_with(ctx.find_root().command, name)
    close = get_close_matches(name.lstrip("-"), bare, 1, 0.8 if elsewhere else 0.6)
    new = next(iter([*others, *(bare[word] for word in close)]), "")
    fixed = [f"{new}{one[len(name) :]}" if one.partition("=")[0] == name else one for one in args]
    return "" if not new or fixed == args else shlex.join([*ctx.command_path.split(), *fixed])


_USUAL: Final = {"coverage": "classes", "collection": "verify", "patterns": "run"}
"""Group of commands → the command to suggest if the user gives only a store."""


def _command_instead(group: TyperGroup, ctx: Any, args: list[str]) -> str:
    """If a command is unknown, return a command line with a similar command; empty if none is similar."""
    (word, *rest), path = args, ctx.command_path.partition(" ")[2]
    place = _looks_like_store(word) or Path(word).suffix in {".mcap", ".osi", ".log", ".lock"}
    if path and not place:
        from sgstore.lang.library import patterns

        words = ["show" if word in patterns() else "search", *args] if path == "patterns" else []
    elif path == "lock":
        words = ["list", *args] if word.endswith(".lock") else []
        path, words = (path, words) if words else ("", ["select", *args, "-o", "tests.lock"])
    elif path:
        words = [_USUAL[path], *args, *(["--all"] if path == "patterns" else [])]
    elif place:
        words = ["info" if _looks_like_store(word) else "doctor", *args]
    else:
        verbs = {name: name for name in group.commands}
        verbs |= {other: verb for verb, known in _WORDS_OF_OTHERS.items() for other in known}
        close = get_close_matches(word.lower(), verbs, 1)
        words = [*verbs[close[0]].split(), *rest] if close else []
    return shlex.join(["sgstore", *path.split(), *words]) if words else ""


def _says_one_thing(parameter: Any) -> bool:
    """True if a command line option takes one value, so that a repeated option would replace it."""
    if parameter.param_type_name != "option" or parameter.multiple or parameter.count:
        return False
    return not parameter.is_flag or bool(parameter.secondary_opts)  # a repeated flag has no effect


class Verbs(typer.Typer):
    """Typer application whose commands are :class:`Verb` objects.

    A parameter of a verb with a dataclass type represents the options of its fields.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(cls=Group, **options)

    def command(self, name: str | None = None, **options: Any) -> Callable[[Any], Any]:
        """Return a decorator that registers a function as a command; see :meth:`typer.Typer.command`."""
        register = super().command(name, cls=Verb, **options)

        def registered(function: Callable[..., Any]) -> Callable[..., Any]:
            register(_unbundled(function))
            return function

        return registered


PLACEHOLDERS: Final = {
    **dict.fromkeys(("clip", "stride", "within", "before", "after", "around"), "TIME"),
    **dict.fromkeys(("manoeuvres", "measures", "abstraction"), "NAME"),
    **dict.fromkeys(("stratify", "weakest"), "EXPR"),
    **dict.fromkeys(("per_class", "combos", "sequences"), "K"),
    **dict.fromkeys(("outcomes", "learn_outcomes"), "CSV"),
    **dict.fromkeys(("slots", "lock"), "FILE"),
    "learn_from": "STORE",
    "by": "B",
    "most": "X",
    "labels": "NAME=TEXT",
    "mounts": "AXES=X,Y,Z[,YAW]",
    "channels": "TOPIC",
    "storage": "VERSION",
    "crs": "CRS",
}
"""Placeholders in the help of options that are described in the docstring of a library method."""

_hints = cache(partial(get_type_hints, include_extras=True))
"""Cached types of parameters and fields, because many commands share the dataclasses of options."""


def _unbundled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Convert a function for typer: each dataclass parameter is replaced by one parameter per field.

    Docstrings describe the options: the section *Parameters* has a name, a placeholder such as
    ``TIME`` if the help needs one, and the help.
    """
    hints = _hints(function)
    bundles: dict[str, Any] = {name: kind for name, kind in hints.items() if is_dataclass(kind)}
    parameters: list[inspect.Parameter] = []
    for one in inspect.signature(function).parameters.values():
        bundle = bundles.get(one.name)
        if bundle is None:
            parameters.append(_described(one, hints[one.name], function))
            continue
        own = _hints(bundle)
        for field in fields(bundle):
            option = inspect.Parameter(field.name, one.KEYWORD_ONLY, default=field.default)
            parameters.append(_described(option, own[field.name], *bundle.__mro__))

    parameters += (
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=about)
        for name, about in _VERBOSITY.items()
    )

    @wraps(function)
    def verb(**values: Any) -> Any:
        set_verbosity(**{name: values.pop(name) for name in _VERBOSITY})
        for name, bundle in bundles.items():
            values[name] = bundle(**{one.name: values.pop(one.name) for one in fields(bundle)})
        return function(**values)

    verb.__doc__ = split_docstring(function)[0]
    verb.__annotations__ = {one.name: one.annotation for one in parameters}
    vars(verb)["__signature__"] = inspect.Signature(parameters)
    return verb


def _described(parameter: inspect.Parameter, hint: Any, *documented: Any) -> inspect.Parameter:
    """Return a parameter of a command with its placeholder and its help.

    They are those of its first description in docstrings, else of its type, else of this module.
    """
    name, module = parameter.name, sys.modules[__name__]
    kind, *infos = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    shared = [] if infos and infos[0].help else [module]
    known = (split_docstring(one)[1].get(name) for one in (*documented, *shared))
    found = next(filter(None, known), None) or (PLACEHOLDERS.get(name, ""), "")
    if any(found) or not infos:
        required = parameter.default is parameter.empty
        flag = [f"--{name.replace('_', '-')}"] * (kind is bool)
        info = copy(infos[0]) if infos else Argument() if required else Option(*flag)
        info.metavar, info.help = found[0] or info.metavar, found[1] or info.help
        hint = Annotated[kind, info]
    return parameter.replace(annotation=hint, kind=parameter.KEYWORD_ONLY)


ERROR, USAGE, LOSS, NO_MATCH = 1, 2, 3, 4
"""Exit codes; 0 means success."""

IN_TABLE: Final = 40
"""Default number of report rows that are printed on a terminal."""

COLLECTION_FILE: Final = "COLLECTION.json"
"""Name of the file that marks a folder as a collection."""

StorePath = Annotated[Path, Argument(envvar=STORE, autocompletion=completion.stores)]
AskedPath = Annotated[
    Path,
    Argument(
        metavar="STORE",
        envvar=STORE,
        help="The store, one DuckDB file; or a collection of stores.",
        autocompletion=completion.stores,
    ),
]
FrameName = Annotated[str, Argument(autocompletion=completion.frames)]
Parameters = Annotated[list[str] | None, Option("--param")]
With = Annotated[list[str] | None, Option("--with")]
QueryText = Annotated[str | None, Argument()]
QueryFile = Annotated[Path | None, Option("--file", "-f")]


def pattern_option(about: str) -> Any:
    """Return the declaration of the option ``-p NAME``, which selects a pattern of the library."""
    names = ("--pattern", "-p")
    return Option(*names, metavar="NAME", help=about, autocompletion=completion.patterns)


PatternNames = Annotated[list[str] | None, pattern_option("One of the library; repeatable.")]
CaseUnit = Annotated[
    Literal["frame", "clip", "trace"], Option("--unit", help="Frames, clips, or whole traces.")
]
Abstraction = Annotated[str, Option("--abstraction", autocompletion=completion.abstractions)]
Traces = Annotated[list[str] | None, Option("--trace", autocompletion=completion.traces)]
Jobs = Annotated[int, Option("--jobs", "-j", min=0)]
ROWS: Final = "Rows"
LIMITS: Final = "Limits"
MESSAGES: Final = "Messages"
Quiet = Annotated[
    bool, Option("--quiet", help="Print only results and errors.", rich_help_panel=MESSAGES)
]
Verbose = Annotated[
    bool, Option("--verbose", help="Also log steps and times on stderr.", rich_help_panel=MESSAGES)
]
_VERBOSITY: Final = {"quiet": Quiet, "verbose": Verbose}
"""Options that every command has."""
AsJson = Annotated[bool, Option("--json", rich_help_panel=ROWS)]
To = Annotated[Path | None, Option("--to", "-o", rich_help_panel=ROWS)]
Limit = Annotated[int, Option("--limit", min=0, rich_help_panel=ROWS)]


@dataclass(frozen=True)
class PrintedRows:
    """Command line options for the format of result rows, with the methods that print the rows.

    Parameters
    ----------
    rows_as
        Format of the rows.
    """

    rows_as: Annotated[Format, Option("--format", rich_help_panel=ROWS)] = Format.table
    as_json: AsJson = False

    def __post_init__(self) -> None:
        _ = self.chosen  # reject inconsistent options early

    @property
    def file(self) -> Path | None:
        """Return the output file for result rows, or ``None`` for stdout."""
        return getattr(self, "to", None)

    @property
    def chosen(self) -> Format:
        """Output format according to ``--format``, ``--json`` and the suffix of the output file."""
        return form_of(self.rows_as, self.file, as_json=self.as_json)

    @property
    def for_people(self) -> bool:
        """True if result rows are printed as a text table for users, not in a format for programs."""
        return self.chosen is Format.table

    def write(
        self,
        columns: Sequence[str],
        rows: Iterable[Sequence[Any]],
        types: Sequence[str] | None = None,
        totals: Mapping[str, str] | None = None,
    ) -> int:
        """Print result rows in the chosen format, and return their number.

        A long table on a terminal ends with the number of rows, and sums of the columns in
        ``totals`` (column → unit).
        """
        if not on_terminal(self):
            return write_rows(columns, rows, self.chosen, self.file, types)
        sums = dict.fromkeys(totals or (), 0)
        places = [(name, columns.index(name)) for name in sums]

        def counted() -> Iterator[Sequence[Any]]:
            for row in rows:
                for name, place in places:
                    sums[name] += row[place] or 0
                yield row

        number = write_rows(columns, counted(), self.chosen, self.file, types)
        if number >= LONG_TABLE:
            said = [f"{round(sums[name], 3):,} {unit}" for name, unit in (totals or {}).items()]
            say(", ".join([number_of(number, "row"), *said]))
        return number

    def report(self, table: ReportTable, limit: int | None = 0) -> None:
        """Print a table of results and its notes.

        ``limit`` 0 means all rows; ``None`` means some rows on a terminal.
        """
        if limit is None:
            limit = IN_TABLE if self.for_people and self.file is None else 0
        rows = table.rows[:limit] if limit else table.rows
        self.write(table.columns, rows)
        if len(rows) < len(table.rows):
            say(f"{number_of(len(table.rows) - len(rows), 'more row')}; --limit 0 shows all")
        for text in table.said:
            say(text)


def on_terminal(out: PrintedRows) -> bool:
    """True if result rows go to a terminal, not to a file or a pipe."""
    return out.for_people and out.file is None and sys.stdout.isatty()


@dataclass(frozen=True)
class RowOptions(PrintedRows):
    """Command line options for the format of result rows and for their file."""

    to: To = None


@dataclass(frozen=True)
class QueryLimits:
    """Command line options that limit the time and the temporary disk space of a query.

    Parameters
    ----------
    timeout : TIME
        Stop after this time, such as 30s.
    max_spill : SIZE
        Maximum disk space for data that exceeds memory: 500MB, 50GB.
    """

    timeout: Annotated[str | None, Option(rich_help_panel=LIMITS)] = None
    max_spill: Annotated[str | None, Option(show_default="10GB", rich_help_panel=LIMITS)] = None

    def spill(self) -> int:
        """Start the time limit of the command. Return the limit of temporary disk space; bytes.

        Returns
        -------
        int
            Greatest disk space of a query, in bytes; 0 means the store's default.
        """
        spill = 0 if self.max_spill is None else bytes_of(self.max_spill, "--max-spill")
        if self.timeout is not None:
            set_deadline(seconds_of(self.timeout, "--timeout"))
        return spill

    def opened(self, store: Path, tables: Mapping[str, Path] | None = None) -> Store:
        """Open a store for queries with the time and disk limits of the command line, and with user tables.

        Rows without a matching frame are reported.
        """
        from sgstore.query import Store

        opened = Store(store, tables=tables, max_spill=self.spill())
        for name, joined in opened.file.joined().items():
            if joined.matched < joined.rows:
                lost = joined.rows - joined.matched
                say(
                    f"{name}: {lost} of {number_of(joined.rows, 'row')} without a frame of the store"
                )
        return opened


@dataclass(frozen=True)
class AskOptions(QueryLimits, RowOptions):
    """Command line options of a command with queries: format of the rows, their file, time and disk limits."""


@dataclass(frozen=True)
class Question:
    """Query on the command line: a text, a file or a pattern of the library, with values of its parameters."""

    query: QueryText = None
    file: QueryFile = None
    name: Annotated[
        str | None, pattern_option("A pattern of the library, in place of a query.")
    ] = None
    parameters: Parameters = None

    def __bool__(self) -> bool:
        """True if the command line contains a query."""
        return bool(self.query or self.file or self.name)

    def typed(self) -> str:
        """Query as the user typed it, or the name of a library pattern; empty without a query."""
        if sum(source is not None for source in (self.query, self.file, self.name)) > 1:
            raise typer.BadParameter("expected one of: a query, -f FILE, -p NAME")
        return (self.name or query_of(self.query, self.file)) if self else ""

    def asked(self) -> tuple[str, Mapping[str, Any]]:
        """Return the text of the query on the command line, and the values of its parameters."""
        return asked_of(self.query, self.file, self.name, parameters_of(self.parameters))


@dataclass(frozen=True)
class Statements:
    """Statements of a command: from files, from the library and from the command line.

    Parameters
    ----------
    texts : TEXT
        'CHECK ALWAYS …'; repeatable.
    sgsm_compat
        Report a violation if any prefix of a trace violates a check, as SGSM does.
    """

    names: PatternNames = None
    texts: Annotated[list[str] | None, Option("--expression", "-e")] = None
    files: Annotated[list[Path] | None, Option("--file", "-f")] = None
    parameters: Parameters = None
    sgsm_compat: bool = False

    def asked(self, given: Sequence[str] | None) -> tuple[dict[str, list[str]], dict[str, Any]]:
        """Return the statements of the command by name, and the values of their parameters.

        Returns
        -------
        asked : dict
            Name of a pattern → texts: its name in the library, else ``pattern``.
        values : dict
            Library patterns take the values of their own parameters; all others belong to the
            texts.
        """
        from sgstore.lang.library import pattern_named, statement

        values = parameters_of(self.parameters)
        named, texts = named_and_texts(given or ())
        more = [*(self.texts or ()), *map(text_of, self.files or ())]
        texts += [statement(one, {}, check=True)[0] for one in more]
        if not (named or self.names or texts):
            raise typer.BadParameter("add a CHECK, a FILE or the NAME of a pattern")
        found = {one.name: one for one in map(pattern_named, (*named, *(self.names or ())))}
        taken = {name for one in found.values() for name in one.parameters}
        rest = {name: value for name, value in values.items() if name not in taken}
        if rest and not texts:
            found[next(iter(found))].written(**rest)  # raises an error with the known parameters
        asked = {"pattern": texts} if texts else {}
        for name, one in found.items():
            own = {key: value for key, value in values.items() if key in one.parameters}
            asked[name] = [one.written(**own)]
        return asked, rest


@dataclass(frozen=True)
class GraphOptions:
    """Command line options that select a file or a preset with the settings of the scene graphs.

    Parameters
    ----------
    config
        TOML file with settings of the scene graphs.
    preset : NAME
        Name of a preset; config --list shows them.
    """

    config: Path | None = None
    preset: Annotated[str | None, Option(autocompletion=completion.presets)] = None

    def settings(self) -> Config | None:
        """Return the scene graph settings that ``--config`` or ``--preset`` selects.

        ``None`` means that neither is given.
        """
        from sgstore.model.config import load
        from sgstore.model.config import preset as preset_named

        if self.config and self.preset:
            raise typer.BadParameter("use --config or --preset; a file can name a preset")
        if self.preset:
            return preset_named(self.preset)
        return load(self.config) if self.config else None


@dataclass(frozen=True)
class ReadingOptions(GraphOptions):
    """Command line options for reading a recording: its road map, and the settings of the scene graphs.

    Parameters
    ----------
    road_map
        OpenDRIVE or Lanelet2 file, or a folder of them, for recordings without a map.
    """

    road_map: Annotated[Path | None, Option("--map")] = None


_ENDINGS: Final = {
    ".csv": Format.csv,
    ".json": Format.json,
    ".ndjson": Format.ndjson,
    ".jsonl": Format.ndjson,
    ".parquet": Format.parquet,
    ".arrow": Format.arrow,
    ".feather": Format.arrow,
    ".txt": Format.table,
    "": Format.table,
}


def given(options: Any) -> dict[str, Any]:
    """Return the fields of an options object that have a value, by name."""
    return {name: value for name, value in vars(options).items() if value is not None}


def form_of(form: Format, output: Path | None = None, *, as_json: bool) -> Format:
    """Return the output format that ``--format``, ``--json`` or the suffix of the output file selects."""
    if as_json and form not in {Format.table, Format.json}:
        raise typer.BadParameter(f"expected only one of --json and --format {form}")
    if as_json or form is not Format.table or output is None:
        return Format.json if as_json else form
    found = _ENDINGS.get(output.suffix.lower())
    if found is None:
        known = ", ".join(filter(None, _ENDINGS))
        raise typer.BadParameter(
            f"--to {output}: unknown format '{output.suffix}'; expected one of {known}"
        )
    return found


def tables_of(given: list[str] | None) -> dict[str, Path]:
    """Return the files of the option ``--with`` by table name. Without ``NAME=``, the file names the table."""
    tables: dict[str, Path] = {}
    for text in given or []:
        name, equals, path = text.partition("=")
        file = Path(path if equals else text)
        name = name if equals else re.sub(r"\W", "_", file.stem)
        if not name.isidentifier():
            raise typer.BadParameter(f"--with {text!r}: expected NAME=FILE, such as labels={file}")
        if name in tables:
            raise typer.BadParameter(f"--with: two tables have the name {name!r}; write NAME=FILE")
        tables[name] = file
    return tables


def query_of(text: str | None, file: Path | None) -> str:
    """Return the text of a query, from an argument or from a file."""
    if text is not None and file is not None:
        raise typer.BadParameter("expected one of: a query, -f FILE")
    if text is None and file is None:
        raise typer.BadParameter("add a query as an argument, or a file with -f FILE")
    return text_or_file(text) if text is not None else text_of(file or Path("-"))


def named_and_texts(arguments: Iterable[str]) -> tuple[list[str], list[str]]:
    """Split arguments into names of library patterns, and texts of statements."""
    from sgstore.lang.library import patterns, statement

    named, texts = list[str](), list[str]()
    for one in arguments:
        if one in patterns():
            named.append(one)
        else:
            texts.append(statement(text_or_file(one), {}, check=True)[0])
    return named, texts


def text_or_file(argument: str) -> str:
    """If an argument is ``-`` or the name of a file, return the text of the file; otherwise the argument."""
    path = Path(argument)
    found = _is_file(path)
    named = path.suffix in {".sgql", ".sql", ".txt"} and not re.search(r"\s", argument)
    return text_of(path) if found or named or argument == "-" else argument


def asked_of(
    text: str | None, file: Path | None, name: str | None, values: Mapping[str, Any]
) -> tuple[str, Mapping[str, Any]]:
    """Return the text of a query (argument, file or library name), and the values of its parameters."""
    if sum(source is not None for source in (text, file, name)) != 1:
        raise typer.BadParameter("expected one of: a query, -f FILE, -p NAME")
    from sgstore.lang.library import pattern_named, statement

    if name is None:
        return statement(query_of(text, file), values)
    return pattern_named(name).written(**values), {}


def text_of(file: Path) -> str:
    """Return the text of a file; the name ``-`` means stdin."""
    try:
        return sys.stdin.read() if str(file) == "-" else file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: {getattr(error, 'strerror', None) or error}") from error


def lines_of(file: Path) -> list[str]:
    """Return the non-empty lines of a file."""
    return [line.strip() for line in text_of(file).splitlines() if line.strip()]


def parameters_of(pairs: list[str] | None) -> dict[str, Any]:
    """Return query parameters from texts ``NAME=VALUE``, as numbers, truth values, JSON lists or texts."""
    values: dict[str, Any] = {}
    for pair in pairs or []:
        name, equals, value = pair.partition("=")
        if not equals or not name.isidentifier():
            raise typer.BadParameter(f"--param {pair!r}: expected NAME=VALUE")
        if name in values:
            raise typer.BadParameter(f"--param {pair!r}: {name} has a value already")
        values[name] = _listed(pair, value) if value.startswith("[") else _parameter(value)
    return values


def _listed(pair: str, value: str) -> Any:
    import json  # rarely needed

    try:
        return json.loads(value)
    except (ValueError, RecursionError):
        hint = """expected a list as in JSON: '["car", "bus"]'"""
        raise typer.BadParameter(f"--param {pair!r}: {hint}") from None


def _parameter(value: str) -> Any:
    if value.lower() in {"true", "false"}:
        return value.lower() == "true"
    for number in (int, float):
        try:
            return number(value)
        except ValueError:
            continue
    return value


def jobs_of(number: int) -> int:
    """Return the number of worker processes for the option ``--jobs``; 0 means one per core."""
    return number or os.cpu_count() or 1


def seconds_of(text: str, option: str) -> float:
    """Convert an option value such as ``2s`` to seconds."""
    from sgstore.apps.verbs import seconds

    return seconds(text, option)


_SIZE: Final = re.compile(r"(\d+(?:\.\d+)?)\s*([kMGT]?)B", re.IGNORECASE)


def bytes_of(text: str, option: str) -> int:
    """Convert an option value such as ``20GB`` to a number of bytes."""
    match = _SIZE.fullmatch(text.strip())
    size = round(float(match[1]) * 1000 ** "_kmgt".find(match[2].lower() or "_")) if match else 0
    if match is None or not 1000 <= size < 1 << 62:
        raise typer.BadParameter(f"{option} {text!r}: expected a size such as 500MB or 20GB")
    return size


def say_left_out(
    matches: Matches | Answer | ChosenFrames | UserStatement | CollectionRows,
    notes: tuple[str, ...] | None = None,
) -> None:
    """Print the traces that cannot answer a query, with reasons, and notes about likely mistakes."""
    of: dict[str, list[str]] = {}
    for name, reason in matches.reasons.items():
        of.setdefault(reason, []).append(name)
    for reason, names in of.items():
        say(f"skipped, because they lack data for this query ({reason}): {excerpts(names)}")
    say_notes(getattr(matches, "notes", ()) if notes is None else notes)


def say_scope(found: Mapping[str, Any], chosen: Format) -> None:
    """Print one line about data that the settings excluded from the store, as text or as JSON."""
    if not found:
        return
    if chosen in {Format.json, Format.ndjson}:
        say_json({"scope": found})
    else:
        say(_scope_text(found))


def say_unknown(told: Iterable[tuple[str, str, str]]) -> None:
    """Print which parts of a query have an unknown value, with the trace and the reason."""
    from sgstore.temporal import unknown_notes

    for note in unknown_notes((f"{name} is unknown", trace, why) for name, trace, why in told):
        say(note)


def say_notes(notes: Iterable[str]) -> None:
    """Print notes about likely mistakes in a query."""
    for note in notes:
        say(f"note: {note}")


def _scope_text(found: Mapping[str, Any]) -> str:
    """Return one line of text about the data that settings excluded from a store."""
    if not found:
        return ""
    scope, states = found.get("scope", ""), f"of {number_of(found['states'], 'state')}"
    parts: list[str] = []
    for of, what, reach in (("graph", "the graphs", "radius"), ("world", "the world", "world")):
        beyond, far = found[f"beyond_{reach}"], found[reach]
        if beyond and scope in {of, ""}:
            range_text = "" if far is None else f" ({far:g} m)"
            parts.append(f"{beyond:,} {states} lie beyond {what}{range_text}")
    parts += [f"{many:,} of {kind} are excluded" for kind, many in found["excluded"].items()]
    parts += [f"frames are kept at {found['rate']:g} Hz"] if found["rate"] else []
    return f"{f'scope {scope}'.rstrip()}: {', '.join(parts)}"
