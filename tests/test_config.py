"""The run configuration: defaults, precedence, errors of one line, and the way back to TOML."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from pydantic import ValidationError

from leafflow_ti.config import (
    KEYWORDS,
    RunConfig,
    WindowSection,
    load_config,
    resolve,
)
from leafflow_ti.config_values import machine_memory, parse_memory
from leafflow_ti.errors import ConfigError
from leafflow_ti.presets import PRESETS, resolve_model


def write(folder: Path, text: str) -> Path:
    path = folder / "run.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_are_those_of_the_contract() -> None:
    config = load_config()
    assert (config.preset, config.precision, config.arch, config.preshift) == ("balanced", "f32", "auto", "auto")
    assert (config.window.size, config.window.sigma, config.window.stride) == (65, 19.0, "auto")
    assert (config.window.size_time, config.window.sigma_time) == ("auto", 1.0)
    assert (config.model.name, config.model.motion, config.model.rows) == ("auto", "auto", "auto")
    assert (config.model.estimator, config.model.solver, config.model.weighting) == ("tls-equilibrated", "fast", "wls")
    assert (config.filters.taps, config.filters.taps_time) == ("5", "auto")
    assert config.plan.max_memory == machine_memory() // 2
    assert (config.refine.steps, config.refine.window, config.refine.thin) == ("auto", "auto", "auto")
    assert config.output.roi is None


def resolved(*grid: int, **options: object) -> RunConfig:
    """For a capture of so many frames, rows and columns of cameras; by default 9, 1 and 9."""
    return resolve(load_config(overrides=options), *(grid or (9, 1, 9)))


def refinement(config: RunConfig) -> tuple[object, ...]:
    return config.refine.steps, config.refine.window, config.refine.thin


@pytest.mark.parametrize(
    ("preset", "precision", "steps", "thin", "stride", "unrefined_stride"),
    [("fast", "f32", 0, 3, 4, 4), ("balanced", "f32", 3, 3, 4, 1), ("accurate", "f64", 8, 1, 4, 1)],
)
def test_preset_decides_what_is_not_given(
    preset: str, precision: str, steps: int, thin: int, stride: int, unrefined_stride: int
) -> None:
    config = resolved(preset=preset)
    assert (config.model.name, config.precision, config.window.stride) == ("affine-scene-flow", precision, stride)
    assert refinement(config) == (steps, 65, thin)
    for other in (resolved(preset=preset, model="affine-4d"), resolved(1, 9, 9, preset=preset)):
        assert (other.refine.steps, other.window.stride) == (0, unrefined_stride)


def test_explicit_values_win_over_the_preset() -> None:
    config = load_config(sets=["window.stride=2", "precision=f32"], overrides={"preset": "accurate"})
    assert (config.window.stride, config.precision) == (2, "f32")
    assert resolved(stride=1, refine=5).window.stride == 1
    assert refinement(resolved(stride=1, refine=5, refine_window=33, thin=2)) == (5, 33, 2)
    assert resolved(refine=0).window.stride == 1
    assert resolved(preset="fast", stride=1).window.stride == 1
    on_demand = resolved(preset="fast", refine=2, model="affine-4d", stride=1)
    assert (on_demand.refine.steps, on_demand.window.stride) == (2, 1)
    assert resolved(model="affine-4d", refine=2).window.stride == 4


@pytest.mark.parametrize(
    ("size", "window", "thin", "accurate"), [(3, 9, 1, 1), (41, 41, 1, 1), (65, 65, 3, 1), (129, 129, 6, 1)]
)
def test_refinement_follows_the_window(size: int, window: int, thin: int, accurate: int) -> None:
    assert refinement(resolved(window=size)) == (3, window, thin)
    assert refinement(resolved(window=size, preset="accurate")) == (8, window, accurate)
    assert refinement(resolved(window=size, preset="accurate", thin=4)) == (8, window, 4)


def test_resolving_decides_everything_and_once() -> None:
    for preset in PRESETS:
        for grid in ((9, 1, 1), (1, 3, 3), (9, 5, 5)):
            config = resolved(*grid, preset=preset)
            values = (config.model.name, config.window.stride, *refinement(config))
            assert "auto" not in values
            assert resolve(config, *grid) == config


def test_precedence_file_then_set_then_option(tmp_path: Path) -> None:
    path = write(tmp_path, '[window]\nsize = 33\nsigma = 5.0\nstride = 2\n[model]\nestimator = "ols"\n')
    config = load_config(path, ["window.sigma=6", "window.stride=3"], {"stride": 8, "sigma": None})
    assert (config.window.size, config.window.sigma, config.window.stride) == (33, 6.0, 8)
    assert config.model.estimator == "ols"


def test_sigma_follows_the_window_size() -> None:
    assert math.isclose(load_config(overrides={"window": 33}).window.sigma, 33 * 19 / 65)
    assert (
        load_config(sets=["window.size=33", "window.sigma=auto"]).window.sigma
        == load_config(sets=["window.size=33"]).window.sigma
    )
    assert load_config(overrides={"window": 33, "sigma": 19.0}).window.sigma == 19.0
    assert math.isclose(WindowSection(size=13, sigma=None).sigma, 3.8)


def test_toml_round_trip(tmp_path: Path) -> None:
    config = load_config(
        None,
        ["filters.taps=7", "plan.threads=2", "output.arrays=depth,depth_std", "model.rows=2d+at+b5"],
        {
            "preset": "fast",
            "roi": "1,2,30,40",
            "frames": "2:5",
            "preshift": "-14",
            "max_memory": "1.5G",
            "mask": 'a "b" ö.tif',
        },
    )
    assert config.preshift == (-14, 0)
    assert config.plan.max_memory == 3 * 2**29
    assert config.output.arrays == ("depth", "depth_std")
    assert config.model.rows == "2d+b5+at"
    # The file's folder is the base of the mask, so the absolute path is what comes back unchanged.
    absolute = config.model_copy(update={"output": config.output.model_copy(update={"mask": tmp_path / 'a "b" ö.tif'})})
    assert load_config(write(tmp_path, config.to_toml())) == absolute
    assert load_config(write(tmp_path, RunConfig().to_toml())) == RunConfig()


def test_configuration_is_frozen() -> None:
    with pytest.raises(ValidationError):
        load_config().window.size = 33  # type: ignore[misc]


@pytest.mark.parametrize(
    ("setting", "parts"),
    [
        ("window.size=64", ["window.size = '64'", "--set", "odd integer >= 3"]),
        ("window.size=true", ["window.size", "odd integer"]),
        ("window.size_time=4", ["odd integer >= 1", '"auto"']),
        ("window.sigma=-1", ["window.sigma = '-1'", "greater than 0"]),
        ("window.sigma=nan", ["window.sigma", "finite"]),
        ("window.stride=0", ["integer >= 1"]),
        ("refine.steps=51", ["refine.steps = '51'", "from 0 to 50", '"auto"']),
        ("refine.window=7", ["refine.window = '7'", "odd integer >= 9"]),
        ("refine.thin=0", ["integer >= 1"]),
        ("refine=3", ["refine (--set)", "refine.steps"]),
        ("model.deformation=stretch", ["'growth' or 'strain'"]),
        ("model.estimator=best", ["model.estimator = 'best'", "'ols', 'tls', 'tls-equilibrated'", "'robust-tls'"]),
        ("model.rows=2d+b5+b5", ["2d+b5+b5", "+b5, +as, +at"]),
        ("filters.taps=9", ["filters.taps = '9'", "'3x1x1', '3', '5' or '7'"]),
        ("plan.max_memory=lots", ["plan.max_memory = 'lots'", "8G"]),
        ("plan.max_memory=1K", ["at least 64M"]),
        ("plan.threads=0", ["integer >= 1"]),
        ("output.frames=5:2", ["output.frames = '5:2'", "A < B"]),
        ("output.roi=1,2,3", ["output.roi", "x0,y0,x1,y1"]),
        ("output.roi=[5,5,5,9]", ["x0 < x1"]),
        ("output.arrays=depht", ["depht", "depth"]),
        ("preshift=a", ["preshift = 'a'", "X,Y"]),
        ("preshift=1.5", ["whole pixels"]),
        ("preset=slow", ["preset = 'slow'", "'fast', 'balanced' or 'accurate'"]),
        ("window.sise=3", ["unknown key 'window.sise'", "window.size"]),
        ("estimator=ols", ["unknown key 'estimator'", "model.estimator"]),
        ("windows=3", ["unknown key 'windows'"]),
        ("window=3", ["window (--set)", "window.size"]),
        ("window.size.x=3", ["unknown key 'window.size.x'"]),
        ("window.size", ["--set window.size", "KEY=VALUE"]),
    ],
)
def test_errors_are_one_line_with_key_value_and_limit(setting: str, parts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(sets=[setting])
    message = str(caught.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_errors_name_the_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"unknown key 'window.zise' \(.*run.toml\)"):
        load_config(write(tmp_path, "[window]\nzise = 3\n"))
    with pytest.raises(ConfigError, match=r"run.toml: not a TOML file"):
        load_config(write(tmp_path, "[window\n"))
    with pytest.raises(ConfigError, match=r"absent.toml: cannot be read"):
        load_config(tmp_path / "absent.toml")


def test_mask_in_a_file_is_relative_to_the_file(tmp_path: Path) -> None:
    assert load_config(write(tmp_path, '[output]\nmask = "m.tif"\n')).output.mask == tmp_path / "m.tif"
    assert load_config(overrides={"mask": "m.tif"}).output.mask == Path("m.tif")


def test_every_keyword_is_a_key() -> None:
    dumped = RunConfig().model_dump()
    for key in KEYWORDS.values():
        section, _, name = key.partition(".")
        assert (name in dumped[section]) if name else (section in dumped)
    assert len(set(KEYWORDS.values())) == len(KEYWORDS)


@pytest.mark.parametrize(
    ("text", "size"), [("8G", 8 * 2**30), ("512m", 2**29), ("1.5 GiB", 3 * 2**29), (2**27, 2**27), ("67108864", 2**26)]
)
def test_memory_sizes(text: str | int, size: int) -> None:
    assert parse_memory(text) == size


@pytest.mark.parametrize(
    ("frames", "expected"), [(None, range(9)), ("2:5", range(2, 5)), (":3", range(3)), ("7:", range(7, 9))]
)
def test_frame_range(frames: str | None, expected: range) -> None:
    assert load_config(overrides={"frames": frames}).output.frame_range(9) == expected


@pytest.mark.parametrize("frames", ["2:10", "9:"])
def test_frame_range_beyond_the_sequence(frames: str) -> None:
    with pytest.raises(ConfigError, match="0:9"):
        load_config(overrides={"frames": frames}).output.frame_range(9)


@pytest.mark.parametrize(
    ("n_frames", "n_rows", "n_cols", "name"),
    [
        (9, 1, 1, "flow-affine"),
        (1, 1, 9, "depth"),
        (9, 1, 9, "affine-scene-flow"),
        (9, 5, 1, "affine-scene-flow"),
        (9, 5, 5, "affine-scene-flow"),
    ],
)
def test_automatic_model(n_frames: int, n_rows: int, n_cols: int, name: str) -> None:
    assert resolve_model("auto", n_frames, n_rows, n_cols) == name
    assert resolve_model("affine", n_frames, n_rows, n_cols) == "affine"
