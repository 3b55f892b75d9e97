"""Settings: what a config file can say, and what it is told when it says something else."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

import pytest

from sgstore.config import (
    MAX_CONFIG_BYTES,
    Config,
    Direction,
    Pairs,
    Payloads,
    Proximity,
    Range,
    from_dict,
    load,
)
from sgstore.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path


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
        ego="hero", range=Range(30.0), proximity=Proximity(("near", "visible"), (5.0, 20.5))
    )


@pytest.mark.parametrize(
    "config",
    [
        Config(),
        Config(direction=Direction((), ()), proximity=Proximity((), ()), pairs=Pairs(0, ego=False)),
        Config(direction=Direction(("inDFrontOf",), ()), payloads=Payloads("latest", 0.5)),
    ],
    ids=["default", "no relations of pairs", "one direction"],
)
def test_a_config_survives_json(config: Config) -> None:
    assert from_dict(json.loads(json.dumps(config.as_dict()))) == config


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
        ("[range]\nradius = -1", "setting 'range.radius' is -1.0; expected a length above 0"),
        ("[pairs]\nego = 1", "setting 'pairs.ego' is 1; expected true or false"),
        ("[pairs]\nwithin = -1", "setting 'pairs.within' is -1.0; expected a length of 0 or more"),
        ("ego = 7", "setting 'ego' is 7; expected a text"),
        ("[proximity]\nnames = 'near'", "setting 'proximity.names' is 'near'; expected a list"),
        ("[proximity]\nnames = ['close']", "setting 'proximity.names' is 'close'; expected one of"),
        ("[proximity]\nupper = [1]", "expected 6 bounds for 6 names"),
        ("[proximity]\nupper = [1,2,3,4,4,5]", "expected ascending bounds above 0"),
        ("[proximity]\nupper = [0,1,2,3,4,5]", "expected ascending bounds above 0"),
        ("[proximity]\nnames = ['near', 'near']\nupper = [1, 2]", "expected each name once"),
        ("[direction]\nupper = [45, 90, 180]", "expected bounds below 180, in degrees"),
        ("[direction]\nupper = [45, 90]", "expected 3 bounds for 4 names"),
        ("[payloads]\njoin = 'next'", "expected 'nearest' or 'latest'"),
        ("[payloads]\ntolerance = -0.1", "expected 0 or more seconds"),
        ("radius =", "not TOML"),
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
        Range(value)
    with pytest.raises(ConfigError):
        Pairs(within=value)
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
