"""Image files written by hand or by another library: every depth, layout and format gives the values put in."""

from __future__ import annotations

import io
import logging
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

from leafflow_ti.capture.images import probe, read_gray, read_window
from leafflow_ti.errors import InputError

imagecodecs = pytest.importorskip("imagecodecs", reason="the codecs extra is not installed")
Image = pytest.importorskip("PIL.Image", reason="Pillow, the independent writer, is not installed")

RNG = np.random.default_rng(7)


def write_tiff(path: Path, data: bytes, width: int, height: int, **tags: int | tuple[int, ...]) -> None:
    """One-strip little-endian TIFF of the given raw data: independent of any library. Tags by TIFF name."""
    codes = {
        "BitsPerSample": 258,
        "Compression": 259,
        "PhotometricInterpretation": 262,
        "FillOrder": 266,
        "Orientation": 274,
        "SamplesPerPixel": 277,
        "ExtraSamples": 338,
        "SampleFormat": 339,
    }
    values = {256: (width,), 257: (height,), 273: (8,), 278: (height,), 279: (len(data),), 259: (1,)}
    values |= {codes[name]: value if isinstance(value, tuple) else (value,) for name, value in tags.items()}
    body = bytearray(data + b"\0" * (len(data) % 2))
    entries = b""
    for code in sorted(values):
        value = values[code]
        if len(value) == 1:
            entries += struct.pack("<HHII", code, 4, 1, value[0])
        else:
            entries += struct.pack("<HHII", code, 4, len(value), 8 + len(body))
            body += struct.pack(f"<{len(value)}I", *value)
    header = struct.pack("<2sHI", b"II", 42, 8 + len(body))
    path.write_bytes(header + bytes(body) + struct.pack("<H", len(values)) + entries + b"\0\0\0\0")


def pack(values: np.ndarray, bits: int) -> bytes:
    """Rows of big-endian packed integers, each row padded to whole bytes."""
    planes = (values[..., None] >> np.arange(bits - 1, -1, -1)) & 1
    return np.packbits(planes.reshape(len(values), -1).astype(np.uint8), axis=1).tobytes()


@pytest.mark.parametrize("bits", range(1, 17))
def test_every_packed_bit_depth_gives_its_integers(tmp_path: Path, bits: int) -> None:
    image = RNG.integers(0, 2**bits, (5, 7))
    data = pack(image, bits) if bits != 16 else image.astype("<u2").tobytes()
    write_tiff(tmp_path / "a.tif", data, 7, 5, BitsPerSample=bits, PhotometricInterpretation=1)
    info = probe(tmp_path / "a.tif")
    assert (info.bits, info.dtype.kind, info.height, info.width) == (bits, "u", 5, 7)
    np.testing.assert_array_equal(read_gray(tmp_path / "a.tif"), image)


@pytest.mark.parametrize("bits", [1, 4, 8, 12, 16])
def test_white_is_zero_is_inverted(tmp_path: Path, bits: int) -> None:
    image = RNG.integers(0, 2**bits, (4, 6))
    data = pack(image, bits) if bits != 16 else image.astype("<u2").tobytes()
    write_tiff(tmp_path / "a.tif", data, 6, 4, BitsPerSample=bits, PhotometricInterpretation=0)
    np.testing.assert_array_equal(read_gray(tmp_path / "a.tif"), 2**bits - 1 - image)


@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "f2", "f4", "f8", ">u2", ">i4", ">f4", ">f8"])
@pytest.mark.parametrize("layout", ["plain", "tiled", "zlib", "bigtiff", "strips"])
def test_every_type_and_layout_is_exact(tmp_path: Path, dtype: str, layout: str) -> None:
    kind = np.dtype(dtype)
    if kind.kind == "f":
        image = RNG.normal(0, 100, (40, 50)).astype(kind)
    else:
        limits = np.iinfo(kind)
        image = RNG.integers(limits.min, limits.max, (40, 50), kind.newbyteorder("="), endpoint=True).astype(kind)
    options: dict[str, object] = {
        "plain": {},
        "tiled": {"tile": (16, 16)},
        "zlib": {"compression": "zlib", "predictor": True, "rowsperstrip": 7},
        "bigtiff": {"bigtiff": True},
        "strips": {"rowsperstrip": 9},
    }[layout]
    if layout == "zlib" and kind == np.dtype("f2"):
        options = {"compression": "zlib"}
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, image, byteorder=">" if dtype[0] == ">" else "<", **options)
    whole = read_gray(path, dtype=np.float64)
    np.testing.assert_array_equal(whole, image.astype(np.float64))
    np.testing.assert_array_equal(read_gray(path), image.astype(np.float32))
    window = read_window(path, 0, "luminance", 5, 39, 11, 34)
    assert window.dtype == kind.newbyteorder("=")
    np.testing.assert_array_equal(window, image[5:39, 11:34])
    assert probe(path).windowed == (options != {"compression": "zlib"})  # that is one strip for the whole image


def test_window_decodes_the_strips_that_it_touches(tmp_path: Path) -> None:
    """Forty rows in strips of eight, the second and the last of which are damaged."""
    image = RNG.integers(0, 255, (40, 50), np.uint8)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, image, compression="zlib", rowsperstrip=8)
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as tif:
        page = tif.pages[0]
        assert isinstance(page, tifffile.TiffPage)
        for strip in (1, 4):
            start, count = page.dataoffsets[strip], page.databytecounts[strip]
            data[start : start + count] = bytes(count)
    path.write_bytes(data)
    np.testing.assert_array_equal(read_window(path, 0, "luminance", 17, 31, 3, 9), image[17:31, 3:9])
    with pytest.raises(InputError, match="cannot be decoded"):
        read_window(path, 0, "luminance", 15, 31, 3, 9)


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("tile", [None, (16, 32)])
@pytest.mark.parametrize("compression", [None, "lzw"])
def test_rgb_by_each_channel_rule(
    tmp_path: Path, planar: str, tile: tuple[int, int] | None, compression: str | None
) -> None:
    rgb = RNG.integers(0, 4096, (3, 33, 41), np.uint16)
    stored = rgb if planar == "separate" else np.moveaxis(rgb, 0, -1)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, stored, photometric="rgb", planarconfig=planar, tile=tile, compression=compression)
    red, green, blue = rgb.astype(np.float64)
    expected = {
        "luminance": 0.299 * red + 0.587 * green + 0.114 * blue,
        "mean": (red + green + blue) / 3,
        "red": red,
        "green": green,
        "blue": blue,
        2: blue,
    }
    for channel, image in expected.items():
        np.testing.assert_allclose(read_gray(path, channel=channel), image, rtol=1e-6)
        np.testing.assert_allclose(read_window(path, 0, channel, 3, 30, 8, 40), image[3:30, 8:40], rtol=1e-6)
    with pytest.raises(InputError, match="no channel 3"):
        read_gray(path, channel=3)


def test_declared_alpha_is_ignored_but_unnamed_samples_need_a_choice(tmp_path: Path) -> None:
    image = RNG.integers(0, 255, (6, 8, 2), np.uint8)
    path = tmp_path / "a.tif"
    common = {"BitsPerSample": (8, 8), "PhotometricInterpretation": 1, "SamplesPerPixel": 2}
    write_tiff(path, image.tobytes(), 8, 6, **common, ExtraSamples=2)
    np.testing.assert_array_equal(read_gray(path), image[..., 0])
    write_tiff(path, image.tobytes(), 8, 6, **common, ExtraSamples=0)
    with pytest.raises(InputError, match=r"a\.tif: 2 samples per pixel .* channel = 0 to 1"):
        read_gray(path)
    np.testing.assert_array_equal(read_gray(path, channel=1), image[..., 1])
    tifffile.imwrite(path, image[..., 0])
    with pytest.raises(InputError, match="grey image has no channel 'red'"):
        read_gray(path, channel="red")


@pytest.mark.parametrize(
    ("orientation", "upright"),
    [
        (1, lambda image: image),
        (2, np.fliplr),
        (3, lambda image: np.rot90(image, 2)),
        (4, np.flipud),
        (5, np.transpose),
        (6, lambda image: np.rot90(image, -1)),  # stored turned to the left: turn it clockwise
        (7, lambda image: np.rot90(image, 2).T),
        (8, lambda image: np.rot90(image, 1)),
    ],
)
def test_orientation_is_applied(tmp_path: Path, orientation: int, upright: Callable[[np.ndarray], np.ndarray]) -> None:
    image = RNG.integers(0, 255, (5, 7), np.uint8)
    expected = upright(image)
    path = tmp_path / "a.tif"
    write_tiff(path, image.tobytes(), 7, 5, BitsPerSample=8, PhotometricInterpretation=1, Orientation=orientation)
    info = probe(path)
    assert (info.height, info.width) == expected.shape
    np.testing.assert_array_equal(read_gray(path), expected)
    np.testing.assert_array_equal(read_window(path, 0, "luminance", 1, 4, 2, 5), expected[1:4, 2:5])


@pytest.mark.parametrize("bits", [4, 8])
def test_palette_gives_its_colours(tmp_path: Path, bits: int) -> None:
    index = RNG.integers(0, 2**bits, (9, 11)).astype(np.uint8)
    colours = RNG.integers(0, 256, (2**bits, 3)).astype(np.uint8)
    image = Image.fromarray(index)
    image.putpalette(colours.ravel().tolist())
    image.save(tmp_path / "a.tif")
    np.testing.assert_array_equal(read_gray(tmp_path / "a.tif", channel="green"), colours[index, 1])
    image.save(tmp_path / "a.png", bits=bits)
    np.testing.assert_array_equal(read_gray(tmp_path / "a.png", channel="blue"), colours[index, 2])


def test_jpeg_in_ycbcr_decodes_as_pillow_does(tmp_path: Path) -> None:
    y, x = np.mgrid[:48, :64]
    rgb = np.stack([2 * y + x, 3 * y, 255 - 3 * x], axis=-1).astype(np.uint8)
    Image.fromarray(rgb).save(tmp_path / "a.tif", compression="jpeg", quality=90)
    with Image.open(tmp_path / "a.tif") as opened:
        decoded = np.asarray(opened.convert("RGB"), np.float64)
    np.testing.assert_allclose(read_gray(tmp_path / "a.tif"), decoded @ (0.299, 0.587, 0.114), atol=1.5)


@pytest.mark.parametrize("fill", [1, 2])
def test_bit_order_in_bytes(tmp_path: Path, fill: int) -> None:
    image = RNG.integers(0, 2, (4, 16))
    bits = np.packbits(image.astype(np.uint8), axis=1, bitorder="big" if fill == 1 else "little")
    write_tiff(tmp_path / "a.tif", bits.tobytes(), 16, 4, BitsPerSample=1, PhotometricInterpretation=1, FillOrder=fill)
    np.testing.assert_array_equal(read_gray(tmp_path / "a.tif"), image)


@pytest.mark.parametrize("kind", ["pages", "imagej", "imagej-hyperstack", "shaped", "truncated", "ome", "bigtiff"])
def test_stacks_page_by_page(tmp_path: Path, kind: str) -> None:
    stack = RNG.integers(0, 60000, (2, 3, 20, 24), np.uint16)
    path = tmp_path / ("a.ome.tif" if kind == "ome" else "a.tif")
    flat = stack.reshape(6, 20, 24)
    if kind == "pages":
        with tifffile.TiffWriter(path) as writer:
            for page in flat:
                writer.write(page, metadata=None, contiguous=False)
    elif kind == "imagej":
        tifffile.imwrite(path, flat, imagej=True)
    elif kind == "imagej-hyperstack":
        tifffile.imwrite(path, stack, imagej=True, metadata={"axes": "TZYX"})
    else:
        options = {"shaped": {}, "truncated": {"truncate": True}}
        extra = {"ome": {"ome": True, "metadata": {"axes": "TZYX"}}, "bigtiff": {"bigtiff": True}}
        tifffile.imwrite(path, stack, photometric="minisblack", **{**options, **extra}[kind])
    info = probe(path)
    assert info.pages == 6
    assert info.mismatch == ""
    if kind in ("imagej-hyperstack", "shaped", "truncated", "bigtiff"):
        assert info.page_shape == (2, 3)
    for k, page in enumerate(flat):
        np.testing.assert_array_equal(read_gray(path, k), page)
        np.testing.assert_array_equal(read_window(path, k, "luminance", 4, 9, 5, 20), page[4:9, 5:20])
    with pytest.raises(InputError, match="no page 6"):
        read_gray(path, 6)


def test_one_header_for_many_images_is_read_by_offset(tmp_path: Path) -> None:
    """ImageJ writes large stacks as one page whose data go on: the file has a single header."""
    stack = RNG.integers(0, 255, (4, 16, 16), np.uint8)
    path = tmp_path / "a.tif"
    text = "ImageJ=1.53\nimages=4\nslices=4\n"
    tifffile.imwrite(path, stack[0], description=text, metadata=None)
    content = path.read_bytes()
    offset = tifffile.TiffFile(io.BytesIO(content)).pages[0].dataoffsets[0]
    assert offset + 256 == len(content)
    path.write_bytes(content + stack[1:].tobytes())
    assert probe(path).pages == 4
    for k in range(4):
        np.testing.assert_array_equal(read_gray(path, k), stack[k])


def test_thumbnails_are_no_pages_and_unequal_pages_are_reported(tmp_path: Path) -> None:
    image = RNG.integers(0, 255, (32, 48), np.uint8)
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as writer:
        writer.write(image, metadata=None)
        writer.write(image[::4, ::4], subfiletype=1, metadata=None)
    assert (probe(path).pages, probe(path).mismatch) == (1, "")
    with tifffile.TiffWriter(path) as writer:
        writer.write(image, metadata=None)
        writer.write(image[:16], metadata=None)
    assert "page 1 is 16 x 48" in probe(path).mismatch
    np.testing.assert_array_equal(read_gray(path, 1), image[:16])


def test_missing_file_folder_and_window_outside(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        probe(tmp_path / "none.tif")
    with pytest.raises(InputError, match="a folder, not a file"):
        probe(tmp_path)
    Image.new("L", (4, 4)).save(tmp_path / "a.tif")
    with pytest.raises(InputError, match="not inside 4 x 4"):
        read_window(tmp_path / "a.tif", 0, "luminance", 0, 5, 0, 4)


def test_log_lines_of_the_reader_do_not_reach_the_user(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A tag with an unknown value makes tifffile log; a host that uses tifffile itself still hears it."""
    image = bytes(24)
    common = {"BitsPerSample": (8, 8), "PhotometricInterpretation": 1, "SamplesPerPixel": 2, "ExtraSamples": 999}
    write_tiff(tmp_path / "a.tif", image, 4, 3, **common)
    with caplog.at_level(logging.DEBUG):
        read_gray(tmp_path / "a.tif", channel=0)
        assert caplog.records == []
        with tifffile.TiffFile(tmp_path / "a.tif") as tif:
            assert tif.pages[0].samplesperpixel == 2
    assert any("EXTRASAMPLE" in record.getMessage() for record in caplog.records)


def test_without_imagecodecs_the_extra_is_named(tmp_path: Path) -> None:
    image = RNG.integers(0, 255, (8, 8), np.uint8)
    tifffile.imwrite(tmp_path / "plain.tif", image)
    tifffile.imwrite(tmp_path / "zstd.tif", image, compression="zstd")
    Image.fromarray(image).save(tmp_path / "a.png")
    write_tiff(tmp_path / "packed.tif", bytes(48), 8, 4, BitsPerSample=12, PhotometricInterpretation=1)
    program = (
        "import sys; sys.modules['imagecodecs'] = None\n"
        "from pathlib import Path\n"
        "from leafflow_ti.capture.images import read_gray\n"
        "from leafflow_ti.errors import MissingExtra\n"
        "print(int(read_gray('plain.tif').sum()))\n"
        "for name in ('zstd.tif', 'a.png', 'packed.tif'):\n"
        "    try:\n"
        "        read_gray(name)\n"
        "    except MissingExtra as error:\n"
        "        print(error)\n"
    )
    result = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True)
    lines = result.stdout.splitlines()
    assert lines[0] == str(int(image.sum()))
    assert [line.split()[1] for line in lines[1:]] == ["zstd.tif", "a.png", "packed.tif"]
    assert all("pip install 'leafflow-ti[codecs]'" in line for line in lines[1:])
