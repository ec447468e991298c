"""Measured camera positions and time stamps: how they are stated, what is refused, how images are read with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

import leafflow_ti as lf
from leafflow_ti.capture import Geometry, capture_from_array, open_capture
from leafflow_ti.capture.measured import REACH, TAPS, interpolated, interpolation
from leafflow_ti.cli.main import main
from leafflow_ti.errors import ConfigError, InputError

CAMERAS, FRAMES = 3, 4
POSITIONS = [[10.0, 0.0], [15.02, 0.03], [19.95, -0.01]]
STAMPS = [0.0, 60.0, 125.0, 300.0]
GRID = f"[camera]\nfocal_length_px = 500\n[grid]\nbaseline_mm = 5.0\npositions_mm = {POSITIONS}\n"


def written(folder: Path, images: str = "", grid: str = GRID, time: str = f"stamps_s = {STAMPS}") -> Path:
    """A capture of three cameras and four frames in ``folder``."""
    rng = np.random.default_rng(0)
    for sx in range(CAMERAS):
        for t in range(FRAMES):
            image = rng.integers(0, 200, (32, 40)).astype(np.uint8)
            tifffile.imwrite(folder / f"{sx}_{t}.tif", image)
    text = f'[images]\npattern = "{{sx}}_{{t}}.tif"\n{images}\n{grid}[time]\n{time}\n'
    (folder / "capture.toml").write_text(text, encoding="utf-8")
    return folder


def test_positions_and_stamps_are_read(tmp_path: Path) -> None:
    capture = open_capture(written(tmp_path))
    assert capture.positions_mm is not None
    assert np.allclose(capture.positions_mm[0], np.array(POSITIONS) - POSITIONS[1], atol=1e-12)
    x, y = capture.camera_steps
    assert np.allclose(x, [[-5.02 / 5, 0, 4.93 / 5]], atol=1e-12)
    assert np.allclose(y, [[-0.03 / 5, 0, -0.04 / 5]], atol=1e-12)  # counted in steps along x
    assert capture.stamps_s == tuple(STAMPS)
    assert capture.frame_interval_s == 65.0  # the median step
    assert np.allclose(capture.frame_times, np.array(STAMPS) / 65)
    found = capture.fingerprint()
    assert found["stamps_s"] == STAMPS
    assert np.allclose(found["positions_mm"], capture.positions_mm)


def test_stamps_from_a_file_and_a_stated_interval(tmp_path: Path) -> None:
    (tmp_path / "times.txt").write_text("\n".join(map(str, STAMPS)) + "\n\n", encoding="utf-8")
    capture = open_capture(written(tmp_path, time='stamps = "times.txt"\ninterval_s = 60'))
    assert capture.stamps_s == tuple(STAMPS)
    assert capture.frame_interval_s == 60.0


def test_select_picks_stamps_and_positions_along(tmp_path: Path) -> None:
    capture = open_capture(written(tmp_path, "select = { t = [1, 3, 2], sx = [0, 1] }"))
    assert capture.stamps_s == (60.0, 300.0)
    assert capture.positions_mm is not None
    assert np.allclose(capture.positions_mm[0], np.array(POSITIONS[:2]) - POSITIONS[1], atol=1e-12)


def test_even_captures_have_whole_steps(tmp_path: Path) -> None:
    capture = open_capture(written(tmp_path, grid=GRID.split("positions")[0], time="interval_s = 10"))
    assert capture.positions_mm is None
    assert capture.stamps_s is None
    assert capture.frame_times == (0.0, 1.0, 2.0, 3.0)
    assert capture.camera_steps[0].tolist() == [[-1.0, 0.0, 1.0]]
    assert "positions_mm" not in capture.fingerprint()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"grid": GRID.replace("[15.02, 0.03], ", "")}, "positions_mm: 2 entries for 3 cameras"),
        (
            {"grid": GRID.replace("15.02", "11.0")},
            "step along x behind camera row 0, column 0 is 1 mm",
        ),
        ({"grid": GRID.replace("15.02, ", "")}, "positions_mm"),
        ({"time": "stamps_s = [0, 1, 2]"}, "stamps_s: 3 stamps for 4 frames"),
        ({"time": "stamps_s = [0, 2, 2, 3]"}, "stamps_s: stamp 2 is 2 s after 2 s"),
        ({"time": 'stamps_s = [0, 1, 2, 3]\nstamps = "times.txt"'}, "give either stamps_s or the file stamps"),
        ({"time": "stamps_s = 3"}, "stamps_s"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=r"capture\.toml") as error:
        open_capture(written(tmp_path, **options))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_bad_file_of_stamps_is_named(tmp_path: Path) -> None:
    folder = written(tmp_path, time='stamps = "times.txt"')
    with pytest.raises(InputError, match=r"times\.txt: cannot be read"):
        open_capture(folder)
    (tmp_path / "times.txt").write_text("0\nsoon\n", encoding="utf-8")
    with pytest.raises(InputError, match="line 2 is 'soon'"):
        open_capture(folder)
    (tmp_path / "times.txt").write_text("0\n1\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"times\.txt: 2 stamps for 4 frames"):
        open_capture(folder)


def test_arrays_take_them_too() -> None:
    images = np.zeros((2, 1, 3, 8, 8))
    capture = capture_from_array(
        images, Geometry(500.0, (3.5, 3.5), (5.0, 0.0)), positions_mm=POSITIONS, stamps_s=(0.0, 7.0)
    )
    assert capture.frame_interval_s == 7.0
    assert capture.camera_steps[0][0, 2] == pytest.approx(4.93 / 5)
    with pytest.raises(ConfigError, match="one camera"):
        capture_from_array(images[:, :, :1], positions_mm=[[0, 0]])
    with pytest.raises(ConfigError, match="2 frames"):
        capture_from_array(images, Geometry(500.0, (3.5, 3.5), (5.0, 0.0)), stamps_s=(0.0,))


@pytest.mark.parametrize("fraction", [0.0, 0.14, 0.5, 0.93])
def test_interpolation_is_exact_where_filters_see(fraction: float) -> None:
    """Up to 2 rad/px, where 5 taps have suppressed all but a twentieth."""
    taps = interpolation(fraction)
    assert taps.sum() == pytest.approx(1, abs=1e-12)
    at = np.arange(TAPS) + 1 - REACH
    ω = np.linspace(0, 2, 41)
    gain = np.exp(1j * np.outer(ω, at)) @ taps
    assert np.abs(gain - np.exp(1j * ω * fraction)).max() < 2e-4


def test_images_are_read_between_pixels() -> None:
    """A wave of 9 px read at -14.14 px per step; whole shifts stay what they are."""
    y, x = np.mgrid[:60, :120].astype(float)

    def wave(dy: float, dx: float) -> np.ndarray:
        return np.sin(0.7 * (x + dx) + 0.3 * (y + dy))

    positions = [[-5.05, 0.0], [0.0, 0.0], [5.0, 0.1]]
    images = np.stack([wave(0, 0)] * 3)[None, None]
    capture = capture_from_array(images, Geometry(500.0, (0, 0), (5.0, 0.0)), positions_mm=positions)
    found = capture.block([0], [0], range(3), 20, 40, 40, 60, (-14, 0), np.float64)[0, 0]
    for k, (px, py) in enumerate(positions):
        wanted = wave(-14 * py / 5, -14 * px / 5)[20:40, 40:60]
        assert np.abs(found[k] - wanted).max() < 1e-4
    assert np.array_equal(found[1], images[0, 0, 1, 20:40, 40:60])
    first_y, last_y, first_x, last_x = capture.pixels_read((-14, 0))
    assert (first_y[0], last_y[0]) == (-REACH, REACH)
    assert first_x.tolist() == [14 - REACH, 0, -14]
    assert last_x.tolist() == [14 + REACH, 0, -14]


def test_interpolation_loses_its_margin() -> None:
    image = np.random.default_rng(0).normal(size=(30, 26))
    assert interpolated(image, (0.3, 0.0)).shape == (30 - 2 * REACH, 26 - 2 * REACH)
    assert np.array_equal(interpolated(image, (0.0, 0.0)), image[REACH:-REACH, REACH:-REACH])


def test_info_tells_what_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["info", str(written(tmp_path))])
    told = capsys.readouterr().out
    assert "farthest from its nominal place: camera row 0, column 2, by -0.07, -0.04 mm" in told
    assert "steps from 60 to 175 s" in told


def test_a_run_is_not_resumed_with_other_stamps() -> None:
    """What resuming compares: the fingerprint holds positions and stamps."""
    images = np.zeros((3, 1, 1, 8, 8), np.uint8)
    one, two = (capture_from_array(images, stamps_s=s).fingerprint() for s in ((0.0, 1.0, 2.0), (0.0, 1.0, 2.1)))
    assert one != two


def test_one_frame_has_no_flow() -> None:
    with pytest.raises(ConfigError, match="at least 2 frames, the capture has 1"):
        lf.plan_run(capture_from_array(np.zeros((1, 1, 1, 64, 64))), lf.load_config(overrides={"model": "flow"}))
