"""Saturated and dead pixels: read as NaN, of the right camera, and refused in words where they are said wrongly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

import leafflow_ti as lf
from leafflow_ti.capture import Capture, open_capture
from leafflow_ti.errors import ConfigError, InputError
from leafflow_ti.status import Status

RNG = np.random.default_rng(5)
IMAGES = RNG.integers(0, 200, (9, 2, 44, 50), np.uint8)  # t, sx, y, x
GRID = "[camera]\nfocal_length_px = 1000.0\n[grid]\nbaseline_mm = 5.0\n"


def described(folder: Path, lines: str = "", images: np.ndarray = IMAGES) -> Path:
    """A capture of two cameras; its description."""
    for t, sx in np.ndindex(images.shape[:2]):
        tifffile.imwrite(folder / f"c{sx}_{t}.tif", images[t, sx])
    path = folder / "capture.toml"
    path.write_text(f'[images]\npattern = "c{{sx}}_{{t}}.tif"\n{lines}\n{GRID}', encoding="utf-8")
    return path


def whole(capture: Capture) -> np.ndarray:
    return capture.block(range(9), [0], [0, 1], 0, 44, 0, 50)[:, 0]


def test_saturated_pixels_are_no_numbers(tmp_path: Path) -> None:
    images = IMAGES.copy()
    images[2, 1, 7, 9], images[3, 0, 4, 5] = 255, 250
    assert np.isfinite(whole(open_capture(described(tmp_path, images=images)))).all()
    for stated, expected in (('"auto"', [(2, 1, 7, 9)]), ("250", [(2, 1, 7, 9), (3, 0, 4, 5)])):
        capture = open_capture(described(tmp_path, f"saturated = {stated}", images))
        assert not capture.finite
        found = whole(capture)
        assert [tuple(at) for at in np.argwhere(np.isnan(found)).tolist()] == expected
        np.testing.assert_array_equal(found[np.isfinite(found)], images[np.isfinite(found)])


def test_the_largest_value_is_that_of_the_stated_bit_depth(tmp_path: Path) -> None:
    images = IMAGES.astype(np.uint16)
    images[1, 1, 3, 3] = 1023
    capture = open_capture(described(tmp_path, 'bit_depth = 10\nsaturated = "auto"', images))
    assert np.argwhere(np.isnan(whole(capture))).tolist() == [[1, 1, 3, 3]]


def test_dead_pixels_of_all_cameras_and_of_each(tmp_path: Path) -> None:
    for sx in (0, 1):
        dead = np.zeros((44, 50), np.uint8)
        dead[10 + sx, 20] = 1
        tifffile.imwrite(tmp_path / f"dead{sx}.tif", dead)
    one = np.isnan(whole(open_capture(described(tmp_path, 'dead = "dead0.tif"'))))
    assert np.argwhere(one[0]).tolist() == [[0, 10, 20], [1, 10, 20]]
    each = open_capture(described(tmp_path, 'dead = "dead{sx}.tif"'))
    found = np.isnan(whole(each))
    assert np.argwhere(found[0]).tolist() == [[0, 10, 20], [1, 11, 20]]
    assert (found == found[0]).all()
    # A window shifted against the image sees them at their place on the sensor.
    shifted = each.block([0], [0], [0, 1], 5, 15, 10, 30, shift_px=(3, 0))
    assert np.argwhere(np.isnan(shifted[0, 0])).tolist() == [[0, 5, 13], [1, 6, 10]]
    assert len(each.fingerprint()["dead_sha256"]) == 2


@pytest.mark.parametrize(
    ("lines", "error", "message"),
    [
        ('saturated = "high"', ConfigError, "saturated"),
        ('dead = "dead{t}.tif"', ConfigError, "the fields sx and sy"),
        ('dead = "none.tif"', InputError, "none.tif"),
        ('dead = "small.tif"', ConfigError, "dead pixels of 8 x 6 px for images of 50 x 44: make it the same size"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, lines: str, error: type[Exception], message: str) -> None:
    tifffile.imwrite(tmp_path / "small.tif", np.zeros((6, 8), np.uint8))
    with pytest.raises(error, match=message):
        open_capture(described(tmp_path, lines))


def test_floats_have_no_largest_value(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="float32 have no largest one: give the value"):
        open_capture(described(tmp_path, 'saturated = "auto"', IMAGES.astype(np.float32)))


def test_a_dead_pixel_costs_itself_alone(tmp_path: Path) -> None:
    """Its neighbours are measured by what else their windows hold."""
    dead = np.zeros((44, 50), np.uint8)
    dead[22, 25] = 1
    tifffile.imwrite(tmp_path / "dead.tif", dead)
    smooth = np.cumsum(np.cumsum(IMAGES.astype(np.float32) - 100, axis=2), axis=3)
    images = np.broadcast_to(128 + 100 * np.sin(smooth / 300), IMAGES.shape).astype(np.uint8)
    images[:] = images[0, 0]
    path = described(tmp_path, 'dead = "dead.tif"', images)
    field = lf.estimate(open_capture(path), 4, model="flow-affine", window=11, sigma=3)
    assert np.argwhere(field.status == Status.NOT_FINITE).tolist() == [[22, 25]]
    assert np.isfinite(field["flow_x"][22, 24])
