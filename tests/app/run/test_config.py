"""Configuration: precedence, types, and keys that nobody knows."""

from __future__ import annotations

import dataclasses
import math
import re
import tomllib
from typing import Literal

import pytest

from graphslam.app.run import config as cfg
from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.app.worlds import simulate
from graphslam.backend.config import GpsOptions, ImuOptions
from graphslam.core.config import (
    build_config,
    check_options,
    dump_toml,
    merge_options,
    options_dict,
    parse_setting,
    read_toml,
)
from graphslam.core.errors import ConfigError, UnknownNameError
from graphslam.graph.factors.imu.config import ImuConfig
from graphslam.graph.noise import RobustKernel
from graphslam.graph.sensors.gps import GpsConfig
from graphslam_frontends.landmarks.config import RbpfEkfConfig
from graphslam_frontends.segslam.front_end import SegSlamFrontEndConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pair:
    """Options with a list of two."""

    bounds: tuple[float, float] = (0.0, 1.0)


def test_nested_options_are_built_and_checked():
    c = build_config(
        RbpfEkfConfig, {"particles": 7, "motion": {"speed": 1}, "noise": {"range_sigma": 0.1, "bearing_sigma": 0.01}}
    )
    assert (c.particles, c.motion.speed, c.noise.range_sigma) == (7, 1.0, 0.1)
    assert isinstance(c.motion.speed, float)


def test_lists_of_any_length_and_of_a_given_one():
    c = build_config(
        SegSlamFrontEndConfig, {"segslam": {"registration": {"radii": [3, 1, 0.5]}}, "steps": {"scanners": ["a"]}}
    )
    assert (c.segslam.registration.radii, c.steps.scanners) == ((3.0, 1.0, 0.5), ("a",))
    assert build_config(Pair, {"bounds": [0.1, 0.9]}).bounds == (0.1, 0.9)
    with pytest.raises(ConfigError, match=re.escape("bounds = [0.1]; wanted 2 values")):
        build_config(Pair, {"bounds": [0.1]})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"segslam": {"registration": {"radii": 3.0}}}, "radii = 3.0; wanted a list"),
        ({"segslam": {"registration": {"radii": ["wide"]}}}, "radii = 'wide'"),
    ],
)
def test_wrong_lists_are_refused(values, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        build_config(SegSlamFrontEndConfig, values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"particle": 7}, "frontend.particle"),
        ({"motion": {"spede": 1.0}}, "frontend.motion.spede"),
        ({"particles": "many"}, "frontend.particles"),
        ({"particles": True}, "frontend.particles"),
        ({"proposal": "3.0"}, "known: 2.0, 1.0"),
        ({"motion": 3}, "table of options"),
        ({"particles": 0}, "wanted ≥ 1"),
        ({"noise": {"range_sigma": 0.1}}, "bearing_sigma"),
    ],
)
def test_wrong_options_are_named_in_full(values, message):
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        make_front_end("rbpf-ekf", values)


def test_unknown_front_end_is_refused():
    with pytest.raises(UnknownNameError, match="rbpf-ekf"):
        make_front_end("nonsense", {})


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a.b=3", {"a": {"b": 3}}),
        ("a=0.5", {"a": 0.5}),
        ("gps.use=every-second", {"gps": {"use": "every-second"}}),
        ('a="1.0"', {"a": "1.0"}),
        ("a=true", {"a": True}),
    ],
)
def test_settings_of_the_command_line(text, value):
    assert parse_setting(text) == value


@pytest.mark.parametrize("text", ["a", "=3", "a..b=1", ""])
def test_malformed_settings_are_refused(text):
    with pytest.raises(ConfigError, match="--set"):
        parse_setting(text)


def test_names_that_look_like_numbers_are_names():
    assert build_config(RbpfEkfConfig, parse_setting("proposal=1.0")).proposal == "1.0"
    with pytest.raises(ConfigError, match=r"proposal = 3\.0; known"):
        build_config(RbpfEkfConfig, parse_setting("proposal=3.0"))


def test_merge_is_deep_and_the_later_wins():
    assert merge_options({"a": {"b": 1, "c": 2}}, {"a": {"b": 5}, "d": 1}) == {"a": {"b": 5, "c": 2}, "d": 1}


def test_effective_configuration_round_trips_through_toml():
    front = make_front_end("rbpf-ekf", {"trim": 16.0, "smoothing_noise": {"range_sigma": 0.1, "bearing_sigma": 0.01}})
    text = dump_toml(options_dict(front.config))
    assert make_front_end("rbpf-ekf", tomllib.loads(text)).config == front.config


def test_simulated_log_brings_its_own_noise():
    log = simulate("landmark-field", preset="quick", seed=0, sigma_speed=0.11)
    options = recommended_options(log, "rbpf-ekf")
    assert options["frontend"]["motion"]["speed"] == 0.11
    assert options["frontend"]["association"] == "known"


def test_every_option_of_gps_and_imu_can_be_set_and_comes_back_from_toml():
    """One definition each: the factors' own options and those of the run are the same."""
    gps = {"use": "all", "sigma": 0.5, "baseline": 7.0, "bias_sigma": 1.5, "segment_gap": 3.0, "every": 2.0}
    gps |= {"bias_time": 60.0, "errors": "stated"}
    imu = {"use": "auto", "longest": 4.0, "pause": 0.3, "accelerometer": False, "gravity": False, "window": 2.0}
    imu |= {"acceleration": 0.1, "still": 0.02, "axes": "warn"}
    values = {
        "gps": gps | {"robust": "huber", "robust_width": 1.2},
        "imu": imu | {"robust": "cauchy", "robust_width": 1.7},
    }
    run = build_config(cfg.RunConfig, values)
    for part, kind in ((run.gps, GpsConfig), (run.imu, ImuConfig)):
        assert isinstance(part, kind)
        assert all(getattr(part, f.name) != f.default for f in dataclasses.fields(part))
    written = dump_toml(options_dict(run))
    assert {k: tomllib.loads(written)[k] for k in values} == values
    assert build_config(cfg.RunConfig, tomllib.loads(written)) == run


def test_a_width_alone_leaves_the_kernel_as_it_was():
    assert build_config(GpsOptions, parse_setting("robust_width=1.5")).robust == RobustKernel("cauchy", 1.5)
    assert build_config(ImuOptions, parse_setting("robust=huber")).robust == RobustKernel("huber", 2.385)
    with pytest.raises(ConfigError, match=r"gps.robust_width = 'wide'"):
        build_config(GpsOptions, {"robust_width": "wide"}, "gps")
    with pytest.raises(ConfigError, match="width must be positive"):
        build_config(GpsOptions, {"robust_width": -1.0}, "gps")


def test_presets_are_valid():
    for name in ("victoria-park.rbpf-ekf", "landmark-field.rbpf-ekf"):
        run = build_config(cfg.RunConfig, cfg.preset(name))
        make_front_end("rbpf-ekf", run.frontend)
    assert cfg.preset("never-heard-of") == {}


def test_broken_toml_is_refused(tmp_path):
    file = tmp_path / "c.toml"
    file.write_text("a = [1,")
    with pytest.raises(ConfigError, match="not a TOML"):
        read_toml(file)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_toml(tmp_path / "nothing.toml")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Checked:
    gain: float = 1.0
    share: float | None = None
    rounds: int = 2
    far: float = math.inf
    rule: Literal["near", "joint"] = "near"
    on: bool = False

    def __post_init__(self):
        check_options(self, "checked.", {"in (0, 1]": "share", "> 0 or inf": "far", "≥ 1": "rounds", "finite": "*"})


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"share": 0.0}, "checked.share = 0.0; wanted in (0, 1]"),
        ({"share": 1.1}, "checked.share = 1.1; wanted in (0, 1]"),
        ({"share": math.nan}, "checked.share = nan; wanted in (0, 1]"),
        ({"far": 0.0}, "checked.far = 0.0; wanted > 0 or inf"),
        ({"far": math.nan}, "checked.far = nan; wanted > 0 or inf"),
        ({"rounds": 0}, "checked.rounds = 0; wanted ≥ 1"),
        ({"gain": -math.inf}, "checked.gain = -inf; wanted finite"),
        ({"rule": "far"}, "checked.rule = 'far'; known: near, joint"),
    ],
)
def test_options_outside_their_range_are_refused(wrong, message):
    Checked(share=1.0, far=1e9, rounds=1, gain=-5.0, rule="joint")
    with pytest.raises(ConfigError, match=re.escape(message)):
        Checked(**wrong)
