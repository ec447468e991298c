"""capture.toml: what is accepted, what is refused and with which line, and that writing gives back what was read."""

from __future__ import annotations

from pathlib import Path

import pytest

from leafflow_ti.capture.description import (
    Camera,
    Description,
    Grid,
    Images,
    Time,
    read_description,
    write_description,
)
from leafflow_ti.capture.files import Reach
from leafflow_ti.capture.pattern import Pattern
from leafflow_ti.errors import ConfigError, InputError

FULL = """
[images]
pattern = "cam_{sx:02d}/frame_{t:02d}.tif"
channel = "green"
bit_depth = 12
select = { t = [0, 8, 2] }
[camera]
focal_length_mm = 12
pixel_pitch_mm = 0.0044
principal_point_px = [319.5, 239]
[grid]
baseline_mm = 5.0
disparity_offset_px = [-8.605, 0.0]
[time]
interval_s = 120.0
"""


def _read(folder: Path, text: str) -> Description:
    (folder / "capture.toml").write_text(text, encoding="utf-8")
    return read_description(folder / "capture.toml")


def test_a_full_description(tmp_path: Path) -> None:
    description = _read(tmp_path, FULL)
    assert description.camera is not None
    assert description.camera.f_px == pytest.approx(12 / 0.0044)
    assert description.camera.principal_point_px == (319.5, 239.0)
    assert description.grid == Grid(baseline_mm=(5.0,), disparity_offset_px=(-8.605, 0.0))
    assert description.time == Time(interval_s=120.0)
    assert description.images.file_pattern.fields == ("sx", "t")


@pytest.mark.parametrize(
    "images",
    [
        Images(pattern="cam_{sx:02d}/frame_{t:02d}.tif"),
        Images(pattern="in_{i:03d}.png", order="sy sx", shape={"sy": 9, "sx": 9}, channel=2),
        Images(path='odd {name} "quoted" \\ é.tif', axes="t sx y x", shape={"t": 9, "sx": 9}, bit_depth=10),
        Images(pattern="cam{sx}.tif", axes="t y x", select={"sx": (1, 5)}),
    ],
)
def test_written_descriptions_read_back_equal(tmp_path: Path, images: Images) -> None:
    description = Description(
        images=images,
        camera=Camera(focal_length_px=2800.125, principal_point_px=(1e-7, 239.5)),
        grid=Grid(baseline_mm=(5.0, -2.5), disparity_offset_px=(0.1, -8.605)),
        time=Time(interval_s=1 / 3),
    )
    write_description(tmp_path / "capture.toml", description)
    assert read_description(tmp_path / "capture.toml") == description
    only_images = Description(images=images)
    write_description(tmp_path / "capture.toml", only_images)
    assert read_description(tmp_path / "capture.toml") == only_images


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[images]\npatern = 'a.tif'", r"\[images\] patern: unknown key; known are pattern, path"),
        ("[images]\npattern = 'a.tif'\n[lens]\nf = 1", r"\[lens\]: unknown key; known are images, camera, grid, time"),
        ("", r"\[images\]: missing: add it"),
        ("[images]\n", r"\[images\]: give either pattern or path"),
        ("[images]\npattern = 'a'\npath = 'b'", "give either pattern or path"),
        ("[images]\npattern = 'a_{z}.tif'", r"field '\{z\}' is unknown, the fields are t, sy, sx, i"),
        ("[images]\npattern = 'a_{t:3d}.tif'", r"format '3d' of field t must be d or 0Nd"),
        ("[images]\npattern = 'a_{i}.tif'", r"\{i\} and order"),
        ("[images]\npattern = 'a.tif'\norder = 'sy sx'", r"\{i\} and order"),
        ("[images]\npattern = 'a_{i}.tif'\norder = 'sy sx'\nshape = {sx = 3}", "order needs the sizes"),
        ("[images]\npattern = 'a_{t}.tif'\naxes = 't y x'", "axis 't' is given twice"),
        ("[images]\npath = 'a.tif'\naxes = 't z y x'", "axis 'z' is unknown"),
        ("[images]\npath = 'a.tif'\naxes = 't x y'", "must end in y x"),
        (
            "[images]\npath = 'a.tif'\naxes = 't y x'\nshape = {sx = 3}",
            "shape names 'sx', which is not in order or axes",
        ),
        (
            "[images]\npath = 'a.tif'\naxes = 't y x'\nshape = {t = 0}",
            r"\[images\] shape.t = 0: .*greater than or equal",
        ),
        ("[images]\npattern = 'a_{t}.tif'\nselect = {sx = [0, 1]}", "select names 'sx'"),
        ("[images]\npattern = 'a_{t}.tif'\nselect = {t = [3, 1]}", "first <= last"),
        ("[images]\npath = 'a.tif'\nchannel = 'grey'", r"channel = 'grey': use one of luminance, mean"),
        ("[images]\npath = 'a.tif'\nchannel = -1", "channel = -1: use one of"),
        ("[images]\npath = 'a.tif'\nbit_depth = 0", r"\[images\] bit_depth = 0: "),
        ("[images]\npath = 'a.tif'\n[camera]\nfocal_length_px = 0.0", r"focal_length_px = 0.0: .*greater than 0"),
        ("[images]\npath = 'a.tif'\n[camera]\nfocal_length_px = -2", r"focal_length_px = -2.*: .*greater than 0"),
        ("[images]\npath = 'a.tif'\n[camera]\nfocal_length_px = nan", r"focal_length_px = nan: "),
        ("[images]\npath = 'a.tif'\n[camera]\nfocal_length_px = '2800'", r"focal_length_px = '2800': .*number"),
        ("[images]\npath = 'a.tif'\n[camera]\nfocal_length_mm = 12", "give focal_length_px, or"),
        ("[images]\npath = 'a.tif'\n[camera]\nfocal_length_px = 9\npixel_pitch_mm = 1", "give focal_length_px, or"),
        ("[images]\npath = 'a.tif'\n[grid]\nbaseline_mm = [1, 2, 3]", r"\[grid\] baseline_mm = .*at most 2"),
        ("[images]\npath = 'a.tif'\n[grid]\nbaseline_mm = inf", r"\[grid\] baseline_mm.* = inf: .*finite"),
        ("[images]\npath = 'a.tif'\n[time]\ninterval_s = -1", r"\[time\] interval_s = -1"),
        ("[images\n", "not valid TOML"),
    ],
)
def test_mistakes_are_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        _read(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'capture.toml'}: ")
    assert "\n" not in str(caught.value)


def test_the_number_of_further_mistakes_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\(and 2 more\)$"):
        _read(tmp_path, "[images]\npatern = 'a'\n[time]\nintervall = 1\n[grid]\nbaseline_mm = nan")


def test_files_that_are_no_description(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml: cannot be read"):
        read_description(tmp_path / "none.toml")
    (tmp_path / "capture.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match=r"not UTF-8 text \(byte 0\)"):
        read_description(tmp_path / "capture.toml")


def test_patterns_match_what_they_format(tmp_path: Path) -> None:
    for name in ("cam_01/f_001.tif", "cam_02/f_001.tif", "cam_02/f_-02.tif", "cam_2/f_001.tif", "cam_02/f_1.tif"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    pattern = Pattern.parse("cam_{sx:02d}/f_{t:03d}.tif")
    found = {path.relative_to(tmp_path).as_posix(): values for values, path in pattern.discover(Reach(tmp_path))}
    assert found == {
        "cam_01/f_001.tif": {"sx": 1, "t": 1},
        "cam_02/f_001.tif": {"sx": 2, "t": 1},
        "cam_02/f_-02.tif": {"sx": 2, "t": -2},
    }
    assert all(pattern.format(values) == name for name, values in found.items())
    assert Pattern.parse("no/such/{t}.tif").discover(Reach(tmp_path)) == []


def test_a_repeated_field_must_agree_and_braces_can_be_literal(tmp_path: Path) -> None:
    for name in ("a1/x{y}_1.tif", "a1/x{y}_2.tif", "a2/x{y}_02.tif"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = Pattern.parse("a{sx}/x{{y}}_{sx}.tif").discover(Reach(tmp_path))
    assert [(values["sx"], path.name) for values, path in found] == [(1, "x{y}_1.tif"), (2, "x{y}_02.tif")]
