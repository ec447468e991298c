"""Captures: every naming and stacking of the same images reads alike; windows, preshift, refusals."""

from __future__ import annotations

import itertools
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile

from leafflow_ti.capture import Capture, Geometry, capture_from_array, open_capture
from leafflow_ti.errors import ConfigError, InputError

DATA = Path(os.environ.get("LEAFFLOW_TI_DATA", Path(__file__).parents[2] / "shared" / "data"))
RNG = np.random.default_rng(3)
IMAGES = RNG.integers(0, 4096, (3, 2, 4, 20, 24), np.uint16)  # t, sy, sx, y, x
GRID = "[camera]\nfocal_length_px = 1000.0\n[grid]\nbaseline_mm = [5.0, 4.0]\n"


def write_files(folder: Path, images: np.ndarray = IMAGES, first: int = 0, **options: object) -> None:
    for t, sy, sx in np.ndindex(images.shape[:3]):
        name = folder / f"row{sy + first}" / f"c{sx + first:02d}_{t + first:03d}.tif"
        name.parent.mkdir(exist_ok=True)
        tifffile.imwrite(name, images[t, sy, sx], **options)


def describe(folder: Path, images: str, rest: str = GRID) -> Path:
    path = folder / "capture.toml"
    path.write_text(f"[images]\n{images}\n{rest}", encoding="utf-8")
    return path


FILES = 'pattern = "row{sy}/c{sx:02d}_{t:03d}.tif"'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_files(tmp_path)
    describe(tmp_path, FILES)
    return tmp_path


def _whole(capture: Capture) -> np.ndarray:
    return capture.block(
        range(capture.n_frames), range(capture.n_rows), range(capture.n_cols), 0, capture.height, 0, capture.width
    )


def test_one_file_per_image(folder: Path) -> None:
    capture = open_capture(folder)
    assert capture.shape == IMAGES.shape
    assert (capture.dtype, capture.bits, capture.frames, capture.reference) == (np.uint16, 16, (0, 1, 2), (1, 2))
    assert capture.geometry == Geometry(1000.0, (11.5, 9.5), (5.0, 4.0), (0.0, 0.0))
    assert capture.frame_interval_s is None
    assert capture.path == folder / "capture.toml"
    block = _whole(capture)
    assert block.dtype == np.float32
    assert block.flags.c_contiguous
    np.testing.assert_array_equal(block, IMAGES)


def test_indices_may_start_anywhere_and_step(tmp_path: Path) -> None:
    for sx, t in itertools.product((1, 2), (10, 14, 18)):
        tifffile.imwrite(tmp_path / f"{sx}_{t}.tif", np.full((16, 16), 100 * sx + t, np.uint16))
    describe(tmp_path, 'pattern = "{sx}_{t}.tif"', "[camera]\nfocal_length_px = 9\n[grid]\nbaseline_mm = -3\n")
    capture = open_capture(tmp_path)
    assert capture.frames == (10, 14, 18)
    assert capture.geometry is not None
    assert capture.geometry.baseline_mm == (-3.0, 0.0)
    np.testing.assert_array_equal(_whole(capture)[:, 0, :, 0, 0], [[110, 210], [114, 214], [118, 218]])


@pytest.mark.parametrize("axes", ["t sy sx", "sx sy t", "sy t sx"])
@pytest.mark.parametrize("sizes", ["stated", "in the file"])
def test_one_stack_in_any_order_of_axes(tmp_path: Path, axes: str, sizes: str) -> None:
    order = [["t", "sy", "sx"].index(axis) for axis in axes.split()]
    stack = IMAGES.transpose([*order, 3, 4])
    shape = ""
    if sizes == "stated":
        stack = stack.reshape(-1, *stack.shape[3:])
        shape = "\nshape = { t = 3, sy = 2, sx = 4 }"
    tifffile.imwrite(tmp_path / "stack.tif", stack, photometric="minisblack")
    describe(tmp_path, f'path = "stack.tif"\naxes = "{axes} y x"{shape}')
    np.testing.assert_array_equal(_whole(open_capture(tmp_path)), IMAGES)


def test_one_stack_per_camera(tmp_path: Path) -> None:
    for sy, sx in np.ndindex(2, 4):
        tifffile.imwrite(tmp_path / f"{sy}-{sx}.tif", IMAGES[:, sy, sx], photometric="minisblack")
    describe(tmp_path, 'pattern = "{sy}-{sx}.tif"\naxes = "t y x"')
    np.testing.assert_array_equal(_whole(open_capture(tmp_path)), IMAGES)


@pytest.mark.parametrize("first", [0, 1])
def test_a_running_index(tmp_path: Path, first: int) -> None:
    for index, image in enumerate(IMAGES.reshape(-1, 20, 24)):
        tifffile.imwrite(tmp_path / f"{index + first:04d}.tif", image)
    describe(tmp_path, 'pattern = "{i:04d}.tif"\norder = "t sy sx"\nshape = { t = 3, sy = 2, sx = 4 }')
    np.testing.assert_array_equal(_whole(open_capture(tmp_path)), IMAGES)
    (tmp_path / f"{5 + first:04d}.tif").unlink()
    with pytest.raises(InputError, match=rf"1 of 24 images are missing: .*{5 + first:04d}\.tif"):
        open_capture(tmp_path)


def test_a_running_index_beyond_the_shape(tmp_path: Path) -> None:
    for index in range(5):
        tifffile.imwrite(tmp_path / f"{index}.tif", IMAGES[0, 0, 0])
    describe(tmp_path, 'pattern = "{i}.tif"\norder = "sx"\nshape = { sx = 4 }', GRID)
    with pytest.raises(InputError, match=r"4\.tif: image 5 of a shape with 4"):
        open_capture(tmp_path)


def test_select_leaves_the_rest_out(folder: Path) -> None:
    describe(folder, FILES + "\nselect = { t = [0, 2, 2], sx = [1, 3] }")
    capture = open_capture(folder)
    assert capture.frames == (0, 2)
    np.testing.assert_array_equal(_whole(capture), IMAGES[::2, :, 1:4])
    describe(folder, FILES + "\nselect = { t = [0, 3] }")
    with pytest.raises(InputError, match=r"8 of 32 images are missing: .*c00_003\.tif.* and 4 more"):
        open_capture(folder)


def test_windows_outside_the_image_are_zero(folder: Path) -> None:
    capture = open_capture(folder)
    padded = np.pad(IMAGES[1, 0, 2], 50).astype(np.float32)
    for y0, y1, x0, x1 in [(-3, 7, 18, 30), (-10, 40, -10, 40), (5, 9, 6, 11), (20, 25, 0, 5), (-40, -30, -50, 74)]:
        expected = padded[50 + y0 : 50 + y1, 50 + x0 : 50 + x1]
        np.testing.assert_array_equal(capture.read(1, 0, 2, y0, y1, x0, x1), expected)
    assert capture.read(1, 0, 2, 5, 9, 6, 11, dtype=np.float64).dtype == np.float64
    for index in ((3, 0, 0), (0, 2, 0), (0, 0, 4), (-1, 0, 0)):
        with pytest.raises(IndexError, match="does not exist: the capture has 0 to"):
            capture.read(*index, 0, 1, 0, 1)


@pytest.mark.parametrize("shift", [(0, 0), (-3, 2), (5, -1), (-40, 0)])
def test_preshift_moves_every_camera_by_its_steps_from_the_reference(folder: Path, shift: tuple[int, int]) -> None:
    """Block pixel x' is image pixel x' + nx k; a point that shows at x + nx k in camera k stands still in the block."""
    capture = open_capture(folder)
    y0, y1, x0, x1 = 3, 12, 4, 17
    block = capture.block([2, 0], [0, 1], [3, 0, 2], y0, y1, x0, x1, shift)
    assert block.shape == (2, 2, 3, 9, 13)
    for i, t in enumerate([2, 0]):
        for j, sy in enumerate([0, 1]):
            for k, sx in enumerate([3, 0, 2]):
                dx, dy = shift[0] * (sx - 2), shift[1] * (sy - 1)
                expected = capture.read(t, sy, sx, y0 + dy, y1 + dy, x0 + dx, x1 + dx)
                np.testing.assert_array_equal(block[i, j, k], expected)
    points = np.zeros((1, 1, 5, 8, 60), np.uint8)
    for k in range(-2, 3):
        points[0, 0, k + 2, 4, 30 - 7 * k] = 200  # nu = -7: to the left as the camera moves right
    moving = capture_from_array(points, Geometry(1000.0, (29.5, 3.5), (5.0, 0.0)))
    still = moving.block([0], [0], range(5), 0, 8, 20, 40, (-7, 0))
    np.testing.assert_array_equal(np.argwhere(still[0, 0])[:, 1:], [[4, 10]] * 5)


def test_array_and_files_are_the_same_capture(folder: Path) -> None:
    geometry = Geometry(1000.0, (11.5, 9.5), (5.0, 4.0))
    memory, disk = capture_from_array(IMAGES, geometry, 60.0), open_capture(folder)
    assert memory.shape == disk.shape
    assert memory.geometry == disk.geometry
    assert (memory.bits, memory.dtype, memory.frames, memory.frame_interval_s) == (16, np.uint16, (0, 1, 2), 60.0)
    arguments = ([0, 2], [1], [0, 1, 3], -2, 9, 3, 30, (-2, 1))
    np.testing.assert_array_equal(memory.block(*arguments), disk.block(*arguments))
    assert memory.fingerprint() == capture_from_array(IMAGES.copy(), geometry).fingerprint()
    assert memory.fingerprint() != capture_from_array(IMAGES + 1, geometry).fingerprint()


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (np.zeros((3, 4, 4)), r"shape \(3, 4, 4\): five axes"),
        (np.zeros((1, 1, 0, 4, 4)), "none empty"),
        (np.zeros((1, 1, 1, 4, 4), complex), "type complex128"),
        (np.zeros((1, 1, 2, 4, 4)), "1 x 2 cameras need a geometry"),
    ],
)
def test_arrays_that_are_no_capture(images: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        capture_from_array(images)


def test_frames_with_stamps_may_have_gaps_in_their_numbers(tmp_path: Path) -> None:
    """Each has a time of its own; without stamps the numbers are the times, and images are missing."""
    numbers = (0, 4, 8, 10)
    for t in numbers:
        tifffile.imwrite(tmp_path / f"f{t:02d}.tif", np.full((8, 9), t, np.uint8))
    text = '[images]\npattern = "f{t:02d}.tif"\n[time]\n'
    (tmp_path / "capture.toml").write_text(text + "stamps_s = [0.0, 4.0, 8.0, 10.0]\n", encoding="utf-8")
    capture = open_capture(tmp_path)
    assert capture.frames == numbers
    assert capture.frame_times == (0.0, 1.0, 2.0, 2.5)
    assert [int(capture.read(t, 0, 0, 0, 1, 0, 1)[0, 0]) for t in range(4)] == list(numbers)
    (tmp_path / "capture.toml").write_text(text + "interval_s = 4.0\n", encoding="utf-8")
    with pytest.raises(InputError, match="2 of 6 images are missing"):
        open_capture(tmp_path)


def test_missing_images_are_named(folder: Path) -> None:
    for name in ("row0/c01_001.tif", "row1/c03_002.tif"):
        (folder / name).unlink()
    with pytest.raises(
        InputError, match=r"2 of 24 images are missing: .*row0/c01_001\.tif, .*row1/c03_002\.tif"
    ) as caught:
        open_capture(folder)
    assert "\n" not in str(caught.value)


def test_doubled_images_are_named(folder: Path) -> None:
    shutil.copy(folder / "row0/c00_000.tif", folder / "row0/c00_0.tif")
    describe(folder, 'pattern = "row{sy}/c{sx:02d}_{t}.tif"')
    with pytest.raises(InputError, match=r"two files for one image: .*c00_0\.tif and .*c00_000\.tif"):
        open_capture(folder)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((20, 25), np.uint16), r"1 of 24 files are not like .*c00_000\.tif .*c02_001\.tif \(20 x 25, gray"),
        (np.zeros((20, 24), np.uint8), r"c02_001\.tif \(20 x 24, gray, 8 bit uint8\)"),
        (np.zeros((20, 24, 3), np.uint16), r"c02_001\.tif \(20 x 24, rgb, 16 bit uint16\)"),
    ],
)
def test_images_unlike_the_others_are_named(folder: Path, image: np.ndarray, message: str) -> None:
    photometric = "rgb" if image.ndim == 3 else "minisblack"
    tifffile.imwrite(folder / "row1/c02_001.tif", image, photometric=photometric)
    with pytest.raises(InputError, match=message):
        open_capture(folder)


def test_unreadable_images_are_named(folder: Path) -> None:
    (folder / "row1/c02_001.tif").write_bytes(b"II*\0nothing")
    with pytest.raises(InputError, match=r"c02_001\.tif: page 0 has its header at byte \d+: damaged"):
        open_capture(folder)
    (folder / "row1/c02_001.tif").write_bytes(b"text")
    with pytest.raises(InputError, match=r"c02_001\.tif: another format"):
        open_capture(folder)


def test_nothing_found_and_no_description(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"capture\.toml: cannot be read"):
        open_capture(tmp_path)
    describe(tmp_path, FILES)
    with pytest.raises(InputError, match=r"no file fits .*row\{sy\}"):
        open_capture(tmp_path)
    describe(tmp_path, 'path = "none.tif"', "")
    with pytest.raises(InputError, match=r"none\.tif: cannot be read"):
        open_capture(tmp_path)


def test_pages_and_axes_must_fit(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", IMAGES[:, 0, 0], photometric="minisblack")
    for images, message in [
        ('path = "a.tif"', r"a\.tif: 3 pages: name their axes"),
        ('path = "a.tif"\naxes = "t y x"\nshape = { t = 4 }', "3 pages, the description asks for t 4"),
        ('path = "a.tif"\naxes = "t sx y x"', r"3 pages for the axes t sx: state their sizes"),
    ]:
        describe(tmp_path, images)
        with pytest.raises(InputError, match=message):
            open_capture(tmp_path)
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        writer.write(IMAGES[0, 0, 0], metadata=None)
        writer.write(IMAGES[0, 0, 0, :10], metadata=None)
    describe(tmp_path, 'path = "a.tif"\naxes = "t y x"')
    with pytest.raises(InputError, match=r"a\.tif: pages differ \(page 1 is 10 x 24"):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    ("rest", "message"),
    [
        ("", r"2 x 4 cameras \(rows x columns\) needs \[camera\] focal_length_px"),
        ("[camera]\nfocal_length_px = 9\n", r"needs \[grid\] baseline_mm"),
        (
            "[camera]\nfocal_length_px = 9\n[grid]\nbaseline_mm = 5\n",
            r"baseline_mm = 5.0 for 2 x 4 cameras: give \[x, y\]",
        ),
        ("[camera]\nfocal_length_px = 9\n[grid]\nbaseline_mm = [5, 0]\n", "along y is 0 for 2 cameras"),
        (GRID + "disparity_offset_px = 1\n", "disparity_offset_px = 1.0 for 2 x 4 cameras"),
    ],
)
def test_a_grid_needs_its_geometry(folder: Path, rest: str, message: str) -> None:
    describe(folder, FILES, rest)
    with pytest.raises(ConfigError, match=message):
        open_capture(folder)


def test_grid_along_y_and_single_camera(folder: Path) -> None:
    describe(folder, 'pattern = "row{sy}/c01_{t:03d}.tif"', GRID.replace("[5.0, 4.0]", "4.0\ndisparity_offset_px = -2"))
    capture = open_capture(folder)
    assert capture.shape == (3, 2, 1, 20, 24)
    assert capture.geometry == Geometry(1000.0, (11.5, 9.5), (0.0, 4.0), (0.0, -2.0))
    np.testing.assert_array_equal(_whole(capture), IMAGES[:, :, 1:2])
    describe(folder, 'pattern = "row1/c03_{t:03d}.tif"', "[time]\ninterval_s = 60.0\n")
    single = open_capture(folder)
    assert (single.geometry, single.frame_interval_s, single.reference) == (None, 60.0, (0, 0))
    np.testing.assert_array_equal(_whole(single), IMAGES[:, 1:, 3:])
    describe(folder, 'path = "row1/c03_002.tif"', "[camera]\nfocal_length_px = 9\nprincipal_point_px = [1, 2]\n")
    calibrated = open_capture(folder)
    assert calibrated.geometry == Geometry(9.0, (1.0, 2.0), (0.0, 0.0), (0.0, 0.0))
    assert calibrated.frames == (0,)


def test_stated_bit_depth_must_hold(folder: Path) -> None:
    describe(folder, FILES + "\nbit_depth = 12")
    capture = open_capture(folder)
    assert capture.bits == 12
    np.testing.assert_array_equal(_whole(capture), IMAGES)
    describe(folder, FILES + "\nbit_depth = 11")
    with pytest.raises(InputError, match=r"\.tif: grey value \d+ does not fit bit_depth = 11"):
        _whole(open_capture(folder))
    describe(folder, FILES + "\nbit_depth = 17")
    with pytest.raises(InputError, match="bit_depth = 17 does not fit"):
        open_capture(folder)


def test_colour_by_the_stated_channel(tmp_path: Path) -> None:
    rgb = RNG.integers(0, 255, (12, 16, 3), np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", rgb, photometric="rgb")
    for channel, expected in [('"red"', rgb[..., 0]), ("1", rgb[..., 1]), ('"mean"', rgb.mean(axis=-1))]:
        describe(tmp_path, f'path = "a.tif"\nchannel = {channel}', "")
        np.testing.assert_allclose(open_capture(tmp_path).read(0, 0, 0, 0, 12, 0, 16), expected, rtol=1e-6)
    describe(tmp_path, 'path = "a.tif"\nchannel = 3', "")
    with pytest.raises(InputError, match="no channel 3"):
        open_capture(tmp_path)


def test_fingerprint_survives_a_copy_and_sees_a_change(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    there = tmp_path_factory.mktemp("copy") / "moved"
    shutil.copytree(folder, there)
    original = open_capture(folder).fingerprint()
    assert original["files"] == 24
    assert open_capture(there).fingerprint() == original
    tifffile.imwrite(there / "row1/c03_002.tif", IMAGES[0, 0, 0])
    assert open_capture(there).fingerprint() != original


def test_the_real_light_field_opens(tmp_path: Path) -> None:
    source = DATA / "hci_cotton"
    if not source.is_dir():
        pytest.skip(f"no light field in {source}")
    describe(
        tmp_path,
        f'pattern = "{source.as_posix()}/input_Cam{{i:03d}}.png"\norder = "sy sx"\nshape = {{ sy = 9, sx = 9 }}',
        "[camera]\nfocal_length_px = 1462.86\n[grid]\nbaseline_mm = [25, 25]\ndisparity_offset_px = [-8.605, -8.605]\n",
    )
    capture = open_capture(tmp_path, outside=True)
    assert (capture.shape, capture.reference) == ((1, 9, 9, 512, 512), (4, 4))
    truth = np.fromfile(source / "gt_disp_lowres.pfm", "<f4", offset=14).reshape(512, 512)[::-1]
    # A smooth, textured spot: the neighbour to the right shows it d pixels further left.
    y, x, d = 256, 256, float(truth[256, 256])
    here = capture.read(0, 4, 4, y - 8, y + 9, x - 8, x + 9)
    there = capture.read(0, 4, 8, y - 8, y + 9, x - 8 - round(4 * d), x + 9 - round(4 * d))
    unmoved = capture.read(0, 4, 8, y - 8, y + 9, x - 8, x + 9)
    assert np.abs(here - there).mean() < 0.5 * np.abs(here - unmoved).mean()
