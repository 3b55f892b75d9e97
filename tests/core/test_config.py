"""Settings: what a config file can say, and what it is told when it says something else."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import fields, is_dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest
from conftest import REPOSITORY
from hypothesis import given, settings
from hypothesis import strategies as st
from opendrive_maps import a_map, a_road, element, line

from sgstore.apps.cli import run
from sgstore.errors import ConfigError
from sgstore.maps.opendrive import read_map
from sgstore.model.config import (
    MAX_CONFIG_BYTES,
    PRESETS,
    Config,
    Direction,
    LaneSettings,
    PairSettings,
    Payloads,
    Proximity,
    RangeSettings,
    as_markdown,
    as_toml,
    configured,
    from_dict,
    load,
    preset,
)
from sgstore.model.vocabulary import KINDS, SIGNALS, TypeMeaning

if TYPE_CHECKING:
    from pathlib import Path

    from sgstore.maps.roads import RoadMap


def written(folder: Path, text: str) -> Path:
    path = folder / "config.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_an_empty_file_is_the_default(tmp_path: Path) -> None:
    assert load(written(tmp_path, "")) == Config()


def test_what_a_file_does_not_name_keeps_its_default(tmp_path: Path) -> None:
    text = """
        ego = "hero"
        [range]
        radius = 30
        [proximity]
        names = ["near", "visible"]
        upper = [5, 20.5]
    """

    config = load(written(tmp_path, text))

    assert config == Config(
        ego="hero", range=RangeSettings(30.0), proximity=Proximity(("near", "visible"), (5.0, 20.5))
    )


@pytest.mark.parametrize(
    "config",
    [
        Config(),
        Config(
            direction=Direction((), ()),
            proximity=Proximity((), ()),
            pairs=PairSettings(0, ego=False),
        ),
        Config(direction=Direction(("inDFrontOf",), ()), payloads=Payloads("latest", 0.5)),
        Config(
            range=RangeSettings(shape="polygon", polygon=((9.0, 0.0), (-1.0, 4.0), (-1.0, -4.0))),
            types={"A.b": TypeMeaning("car", "taxi"), 'with "quotes"\t': TypeMeaning("prop")},
            egos=("hero", "7"),
        ),
        *(one.config for one in PRESETS.values()),
    ],
    ids=["none", "no relations of pairs", "one direction", "tables in tables", *PRESETS],
)
def test_a_config_survives_json_and_toml(tmp_path: Path, config: Config) -> None:
    assert from_dict(json.loads(json.dumps(config.as_dict()))) == config
    assert load(written(tmp_path, as_toml(config))) == config
    assert from_dict({**config.as_dict(), "preset": "carlasgg"}) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rangs = 3", "unknown setting 'rangs'; did you mean 'range'?"),
        ("[range]\nradios = 3", "unknown setting 'range.radios'; did you mean 'range.radius'?"),
        ("[range]\nxyz = 3", "unknown setting 'range.xyz'; known: by, front,"),
        ("range = 3", "setting 'range' is 3; expected a table [range]"),
        ("[range]\nradius = '50'", "setting 'range.radius' is '50'; expected a number"),
        ("[range]\nradius = true", "setting 'range.radius' is True; expected a number"),
        ("[range]\nradius = nan", "setting 'range.radius' is nan; expected a number"),
        (f"[range]\nradius = {10**400}", "expected a number"),
        ("[range]\nradius = -1", "setting 'range.radius' is -1.0; expected a length above 0"),
        ("[pairs]\nego = 1", "setting 'pairs.ego' is 1; expected true or false"),
        ("[pairs]\nwithin = -1", "setting 'pairs.within' is -1.0; expected a length of 0 or more"),
        ("ego = 7", "setting 'ego' is 7; expected a text"),
        ("[proximity]\nnames = 'near'", "setting 'proximity.names' is 'near'; expected a list"),
        ("[proximity]\nnames = ['isIn']", "setting 'proximity.names' is 'isIn'; expected one of"),
        (
            "[proximity]\nnames = ['very near']",
            "setting 'proximity.names': 'very near' is not a name",
        ),
        (
            "[proximity]\nnames = ['Near']",
            "setting 'proximity.names': 'Near' could be confused with",
        ),
        ("[proximity]\nupper = [1]", "expected 6 bounds for 6 names"),
        ("[proximity]\nupper = [1,2,3,4,4,5]", "expected ascending bounds above 0"),
        ("[proximity]\nupper = [0,1,2,3,4,5]", "expected ascending bounds above 0"),
        ("[proximity]\nnames = ['near', 'near']\nupper = [1, 2]", "expected each name once"),
        ("[direction]\nupper = [45, 90, 180]", "expected bounds below 180, in degrees"),
        ("[direction]\nupper = [45, 90]", "expected 3 bounds for 4 names"),
        ("[payloads]\njoin = 'next'", "expected 'nearest' or 'latest'"),
        ("[payloads]\ntolerance = -0.1", "expected 0 or more seconds"),
        ("radius =", "not TOML"),
        ("[range]\nshape = 'disc'", "expected 'radius', 'rectangle', 'polygon' or 'corridor'"),
        ("[range]\nshape = 'polygon'", "setting 'range.polygon' is (); expected 3 to 64 corners"),
        (
            "[range]\npolygon = [[0,0],[1,0],[2,0,0]]",
            "expected 3 to 64 corners [ahead, to the left]",
        ),
        (
            "[range]\npolygon = [[0,0],[4,4],[4,0],[0,4]]",
            "expected sides that meet at the corners only",
        ),
        ("[range]\npolygon = [[0,0],[4,0],[2,0]]", "expected sides that meet at the corners only"),
        (
            "[range]\npolygon = [[0,0],[4,0],[4,4],[2,0]]",
            "expected sides that meet at the corners only",
        ),
        ("[range]\npolygon = [[0,0],[0,0],[4,4]]", "expected sides that meet at the corners only"),
        ("[range]\npolygon = [[0,0],[1e9,0],[4,4]]", "expected corners up to 100000 m away"),
        ("[range]\nshape = 'rectangle'\nside = 0", "expected a rectangle with an area"),
        ("[range]\nfront = -1", "setting 'range.front' is -1.0; expected a length of 0 or more"),
        (
            "[range]\nby = 'corner'",
            "setting 'range.by' is 'corner'; expected 'footprint' or 'centre'",
        ),
        ("[range]\nheight = [2, -2]", "expected nothing, or [lowest, highest]"),
        ("[range]\ngrade = -0.1", "setting 'range.grade' is -0.1; expected 0 or more"),
        ("[lanes]\ngranularity = 'road'", "expected 'none', 'lane' or 'waypoint'"),
        (
            "[lanes]\ntypes = ['drivin']",
            "setting 'lanes.types' is 'drivin'; expected 'driving', perhaps",
        ),
        ("[lanes]\nspacing = 0", "expected a length of 0.1 or more"),
        ("[proximity]\nbetween = 'edges'", "expected 'centres', 'origins' or 'footprints'"),
        ("[direction]\nties = 'left'", "expected 'ahead', 'both' or 'carlasgg'"),
        ("[direction]\nsides = 'shut'", "expected 'open', 'closed' or 'none'"),
        ("[pairs]\nkinds = [['Ego']]", "setting 'pairs.kinds[0]' is ('Ego',); expected two labels"),
        ("[pairs]\nkinds = [['Ego', 'Cars']]", "is 'Cars'; expected 'Car', perhaps"),
        ("[pairs]\nkinds = ['Ego']", "setting 'pairs.kinds[0]' is 'Ego'; expected a list"),
        ("kinds = ['Ego']", "setting 'kinds' is 'Ego'; expected"),
        ("without = ['laneChange']", "setting 'without' is 'laneChange'; expected one of isIn"),
        ("without = ['lead']", "expected 'leads', perhaps"),
        ("ego = 'a'\negos = ['b']", "expected either ego or egos, not both"),
        ("egos = ['a', 'a']", "expected each ego once"),
        ("egos = ['all', 'a']", "expected 'all' alone, or a list of egos"),
        ("rate = -1", "expected 0 or more frames per second"),
        ("preset = 'carla'", "no preset 'carla'; did you mean 'carlasgg'?"),
        ("preset = 3", "setting 'preset' is 3; expected the name of a preset"),
        (
            "[types]\nx = { kind = 'cart' }",
            "setting 'types.\"x\".kind' is 'cart'; expected 'car', perhaps",
        ),
        (
            "[types]\nx = { special = 'taxi' }",
            "setting 'types.\"x\".kind' is None; expected a value",
        ),
        (
            "[types]\nx = { kind = 'car', sort = 'a' }",
            "unknown setting 'types.\"x\".sort'; known: kind",
        ),
        ("[types]\nx = { kind = 'car', special = 'Cab!' }", "expected a word of a-z, 0-9 and _"),
        ("[types]\nX = { kind = 'car' }\nx = { kind = 'bus' }", "expected each type name once"),
    ],
)
def test_a_wrong_setting_is_named_with_what_would_be_right(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        load(written(tmp_path, text))

    assert message in str(caught.value)
    assert "config.toml" in str(caught.value)


@pytest.mark.parametrize("value", [math.inf, math.nan])
def test_lengths_are_finite(value: float) -> None:
    with pytest.raises(ConfigError):
        RangeSettings(value)
    with pytest.raises(ConfigError):
        PairSettings(within=value)
    with pytest.raises(ConfigError):
        Proximity(("near",), (value,))
    with pytest.raises(ConfigError):
        Payloads(tolerance=value)


def test_files_that_are_no_config_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        load(tmp_path / "absent.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not TOML"):
        load(tmp_path / "binary.toml")
    with pytest.raises(ConfigError, match="larger than"):
        load(written(tmp_path, "#" * (MAX_CONFIG_BYTES + 1)))


# Keywords, presets, and what is printed ------------------------------------------------------------


def test_keywords_are_tables_of_either_form_on_top_of_a_preset() -> None:
    config = configured(
        preset="carlasgg", range={"front": 80}, pairs=PairSettings(within=9), rate=2
    )

    base = preset("carlasgg")
    assert config.range == RangeSettings(**{**vars_of(base.range), "front": 80.0})
    assert config.pairs == PairSettings(within=9)
    assert (config.rate, config.kinds, config.sees) == (2.0, base.kinds, False)


def vars_of(table: Any) -> dict[str, Any]:
    return {one.name: getattr(table, one.name) for one in fields(table)}


def test_a_file_may_begin_with_a_preset(tmp_path: Path) -> None:
    config = load(written(tmp_path, "preset = 'carlasgg'\n[lanes]\nahead = 70"))

    base = preset("carlasgg")
    assert config == configured(
        preset="carlasgg", lanes=LaneSettings(**{**vars_of(base.lanes), "ahead": 70})
    )


def test_equal_configs_have_equal_hashes_however_their_types_are_written() -> None:
    one = Config(types={"a.b": TypeMeaning("car"), "C": TypeMeaning("bus")})
    other = Config(types={"c": TypeMeaning("bus"), "A.B": TypeMeaning("car")})

    assert one == other
    assert hash(one) == hash(other)
    assert one != Config()


def settings_of(config: Any, prefix: str = "") -> set[str]:
    names: set[str] = set()
    for one in fields(config):
        value = getattr(config, one.name)
        inner = is_dataclass(value)
        names |= settings_of(value, f"{one.name}.") if inner else {f"{prefix}{one.name}"}
    return names


def test_every_setting_is_printed_with_a_comment() -> None:
    lines = as_toml(Config()).splitlines()
    table, printed = "", set()
    for before, text in pairwise(lines):
        if text.startswith("["):
            table = text.strip("[]")
            printed |= {table} if table in {"types", "relations"} else set()
        elif " = " in text and not text.startswith("#"):
            name = text.split(" = ")[0]
            printed.add(f"{table}.{name}" if table else name)
            assert before.startswith("# "), text

    assert printed == settings_of(Config())


def test_the_page_of_parameters_is_what_the_code_says() -> None:
    page = (REPOSITORY / "docs/parameters.md").read_text(encoding="utf-8")

    assert page == as_markdown(PRESETS), "run: sgstore config --page > docs/parameters.md"


@settings(deadline=None)
@given(
    st.dictionaries(st.text(min_size=1), st.sampled_from(["car", "sign", "unknown"]), max_size=5)
)
def test_any_type_name_survives_toml(types: dict[str, str]) -> None:
    try:
        config = Config(types={name: TypeMeaning(kind) for name, kind in types.items()})
    except ConfigError:
        return
    assert from_dict(tomllib.loads(as_toml(config))) == config


# The verb -------------------------------------------------------------------------------------------


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = run(["config", *map(str, arguments)])
    return code, *capsys.readouterr()


def test_the_verb_prints_configs_that_can_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = written(tmp_path, "preset = 'carlasgg'\nrate = 5")
    for arguments, config in (
        ((), Config()),
        (("--preset", "carlasgg"), preset("carlasgg")),
        ((own,), configured(preset="carlasgg", rate=5)),
    ):
        code, out, _ = said(capsys, *arguments)
        assert code == 0
        assert from_dict(tomllib.loads(out)) == config


def test_the_verb_lists_presets_and_says_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, out, _ = said(capsys, "--list", "--json")
    assert {row["preset"] for row in json.loads(out)} == set(PRESETS)

    code, _, err = said(capsys, "--preset", "carlasg")
    assert (code, "did you mean 'carlasgg'" in err) == (2, True)
    code, _, err = said(capsys, written(tmp_path, "rage = 3"))
    assert (code, "did you mean 'range'" in err) == (2, True)
    assert said(capsys, "--list", "--page")[0] == 2


# Signs of the map ------------------------------------------------------------------------------------


def test_signals_of_a_map_are_what_the_client_says_and_make_another_map() -> None:
    def stand(code: str, s: float) -> str:
        return element("signal", id=code, type=code, s=s, t=4, orientation="+", dynamic="no")

    text = a_map(a_road("1", line(90, x=0, y=0, hdg=0), signals=stand("206", 9) + stand("Z-9", 30)))
    config = Config(types={"z-9": TypeMeaning("stop_sign"), "x": TypeMeaning("car")})

    plain, told = read_map(text, "m"), read_map(text, "m", config.signs)

    def kinds(of: RoadMap) -> dict[str, str]:
        names = zip(of.nodes.name, of.nodes.kind.tolist(), strict=True)
        return {name: KINDS[kind] for name, kind in names if KINDS[kind] in SIGNALS}

    assert kinds(plain) == {"206": "stop_sign", "Z-9": "sign"}
    assert kinds(told) == {"206": "stop_sign", "Z-9": "stop_sign"}
    assert told.digest != plain.digest
    other = Config(types={"elsewhere": TypeMeaning("yield_sign")})
    assert read_map(text, "m", other.signs).digest == plain.digest
