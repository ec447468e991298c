"""Diel curves: bins of the day, weights, bands, days; and the figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.diel import DielCurves, fold, parse_light, write_diel_figure
from leafflow_ti.errors import InputError, MissingExtra, UsageError
from leafflow_ti.region_table import RegionTable

HOUR_S = 3600.0


def rhythm(hour: np.ndarray) -> np.ndarray:
    """Growth [%/h] by the time of day: most before dawn."""
    return 1.0 + 0.6 * np.cos(2 * np.pi * (hour - 5) / 24)


def table(
    days: float = 3.0, clock: bool = True, noise: float = 0.0, day_sd: float = 0.0, regions: int = 2
) -> RegionTable:
    """Frames every half hour from 6 o'clock on; region 2 grows twice as fast; every second frame is half as sure."""
    time = np.arange(0, days * 24 * HOUR_S, 0.5 * HOUR_S)
    hours = 6 + time / HOUR_S
    rng = np.random.default_rng(4)
    each_day = rng.normal(0, day_sd, 99)[(hours // 24).astype(int)]
    se = np.where(np.arange(time.size) % 2, 0.2, 0.1)
    growth = [
        k * rhythm(hours % 24) + each_day + noise * se * rng.normal(size=time.size) for k in range(1, regions + 1)
    ]
    columns = {
        "region": np.tile(np.arange(1, regions + 1), time.size),
        "frame": np.repeat(np.arange(time.size), regions),
        "time_s": np.repeat(time, regions),
        "growth_percent_per_h": np.stack(growth, axis=1).ravel(),
        "growth_se_percent_per_h": np.repeat(se, regions),
    }
    if clock:
        start = np.datetime64("2024-05-31T06:00", "ms")
        columns["clock"] = start + (1000 * columns["time_s"]).astype("timedelta64[ms]")
    return RegionTable(columns, correlation={"growth": (1.0,)})


def test_bins_are_weighted_means_of_the_day() -> None:
    curves = fold(table())
    rows = curves.of(2)
    np.testing.assert_array_equal(rows["hour_start"], np.arange(24))
    np.testing.assert_array_equal(rows["hour_end"], np.arange(24) + 1)
    weighted = 2 * (4 * rhythm(rows["hour_start"]) + rhythm(rows["hour_start"] + 0.5)) / 5  # weights 1/se²
    np.testing.assert_allclose(rows["growth_percent_per_h"], weighted, rtol=1e-12)
    np.testing.assert_array_equal(rows["days"], 3)
    np.testing.assert_array_equal(rows["frames"], 6)
    of_a_day = 1 / np.sqrt(1 / 0.1**2 + 1 / 0.2**2)
    np.testing.assert_allclose(rows["growth_se_percent_per_h"], of_a_day / np.sqrt(3))
    np.testing.assert_allclose(rows["growth_days_sd_percent_per_h"], 0, atol=1e-12)


def test_the_band_is_the_noise_and_the_spread_that_of_the_days() -> None:
    noisy = fold(table(days=40, noise=1.0)).of(1)
    expected = (4 * rhythm(noisy["hour_start"]) + rhythm(noisy["hour_start"] + 0.5)) / 5
    pull = (noisy["growth_percent_per_h"] - expected) / noisy["growth_se_percent_per_h"]
    assert 0.7 < np.std(pull) < 1.3  # of 24 bins: 15 % by chance
    differing = fold(table(days=40, day_sd=0.5)).of(1)
    np.testing.assert_allclose(differing["growth_days_sd_percent_per_h"], 0.5, rtol=0.4)


def test_neighbouring_frames_share_their_errors() -> None:
    alone = table()
    shared = RegionTable(alone.columns, correlation={"growth": (1.0, 1.0)})
    band = fold(shared, 2.0).of(1)["growth_se_percent_per_h"]
    assert (band > fold(alone, 2.0).of(1)["growth_se_percent_per_h"] * 1.2).all()


def test_hours_count_from_frame_0_without_a_clock() -> None:
    curves = fold(table(clock=False))
    assert not curves.clock
    assert "no start time is known" in curves.describe()
    rows = curves.of(1)
    np.testing.assert_allclose(rows["growth_percent_per_h"][0], (4 * rhythm(6) + rhythm(6.5)) / 5)


def test_less_than_a_day_says_so() -> None:
    curves = fold(table(days=0.5))
    assert "less than a day: every hour is seen once at most" in curves.describe()
    rows = curves.of(1)
    np.testing.assert_array_equal(rows["hour_start"], np.arange(6, 18))  # no rows for hours that were not seen
    assert np.isnan(rows["growth_days_sd_percent_per_h"]).all()


def test_missing_frames_leave_gaps() -> None:
    given = table()
    growth = given["growth_percent_per_h"].copy()
    hours = given["clock"].astype("datetime64[h]").astype(int) % 24
    growth[hours == 9] = np.nan
    rows = fold(RegionTable({**given.columns, "growth_percent_per_h": growth}, correlation=given.correlation)).of(1)
    assert 9 not in rows["hour_start"]
    assert len(rows["hour_start"]) == 23


@pytest.mark.parametrize("bin_h", [0.7, 0.0, -1.0, 48.0])
def test_bins_divide_the_day(bin_h: float) -> None:
    with pytest.raises(UsageError, match="do not divide a day"):
        fold(table(), bin_h)


def test_growth_per_hour_is_needed() -> None:
    columns = {name: values for name, values in table().columns.items() if "growth" not in name}
    with pytest.raises(InputError, match="needs a growth rate and the time between frames"):
        fold(RegionTable(columns, correlation={"growth": (1.0,)}))


@pytest.mark.parametrize(("text", "hours"), [("8-22", (8.0, 22.0)), ("6.5-0", (6.5, 0.0)), ("22-6", (22.0, 6.0))])
def test_light(text: str, hours: tuple[float, float]) -> None:
    assert parse_light(text) == hours


@pytest.mark.parametrize("text", ["8", "8-25", "a-b", "8-8", "8-22-3"])
def test_light_that_is_none(text: str) -> None:
    with pytest.raises(UsageError, match="give the hours"):
        parse_light(text)


def test_growth_of_the_motion_stands_in() -> None:
    given = table()
    columns = {name.replace("growth", "area_rate"): values for name, values in given.columns.items()}
    curves = fold(RegionTable(columns, correlation={"area_rate": (1.0,)}))
    np.testing.assert_array_equal(curves.of(1)["area_rate_percent_per_h"], fold(given).of(1)["growth_percent_per_h"])


def test_curves_as_csv(tmp_path: Path) -> None:
    path = fold(table()).to_csv(tmp_path / "d.csv")
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0] == (
        "region,hour_start,hour_end,growth_percent_per_h,growth_se_percent_per_h,growth_days_sd_percent_per_h,days,frames"
    )
    assert len(lines) == 1 + 2 * 24


def test_figure_shades_the_night(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    image = pytest.importorskip("PIL.Image", reason="pillow is not installed")
    curves = fold(table(noise=1.0, day_sd=0.1))
    pictures = []
    for name, light in (("day.png", None), ("night.png", (8.0, 22.0))):
        path = write_diel_figure(curves, tmp_path / name, light)
        pictures.append(np.asarray(image.open(path).convert("RGB")).astype(int))
    night = np.abs(pictures[1] - pictures[0]).max(axis=2) > 10
    columns = np.flatnonzero(night.mean(axis=0) > 0.3)  # the hours 0-8 and 22-24 of 24
    assert 0.3 < columns.size / np.ptp(columns) < 0.5
    with pytest.raises(UsageError, match="give --overwrite"):
        write_diel_figure(curves, tmp_path / "day.png")
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtra, match=r"leafflow-ti\[plot\]"):
        write_diel_figure(curves, tmp_path / "other.png")


def test_no_values_make_no_curve(tmp_path: Path) -> None:
    given = table(days=1)
    nothing = np.full(len(given), np.nan)
    curves = fold(RegionTable({**given.columns, "growth_percent_per_h": nothing}, correlation=given.correlation))
    assert isinstance(curves, DielCurves)
    assert curves.of(1)["hour_start"].size == 0
    assert "0 bins from" in curves.describe()
