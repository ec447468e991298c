"""Images that are cut off, damaged, hostile or of a kind that is not read: always an InputError of one line."""

from __future__ import annotations

import io
import itertools
import struct
from pathlib import Path

import numpy as np
import pytest
import tifffile
from test_images import write_tiff

from leafflow_ti.capture.channels import MAX_PIXELS
from leafflow_ti.capture.images import probe, read_gray
from leafflow_ti.errors import InputError

imagecodecs = pytest.importorskip("imagecodecs", reason="the codecs extra is not installed")
Image = pytest.importorskip("PIL.Image", reason="Pillow, the independent writer, is not installed")
RNG = np.random.default_rng(7)


@pytest.mark.parametrize(
    ("tags", "message"),
    [
        ({"BitsPerSample": 64, "PhotometricInterpretation": 1}, "64-bit samples"),
        ({"BitsPerSample": 64, "PhotometricInterpretation": 1, "SampleFormat": 6}, "samples of format"),
        ({"BitsPerSample": 8, "PhotometricInterpretation": 5}, "CMYK"),
        ({"BitsPerSample": 8, "PhotometricInterpretation": 6}, "YCbCr without JPEG"),
        ({"BitsPerSample": 8, "PhotometricInterpretation": 32803}, "raw colour mosaic"),
        ({"BitsPerSample": 8, "PhotometricInterpretation": 3}, "colour map"),
        ({"BitsPerSample": 8, "PhotometricInterpretation": 0, "SampleFormat": 2}, "white-is-zero"),
        ({"BitsPerSample": 8, "PhotometricInterpretation": 1, "Compression": 65535}, "compression 65535 is not read"),
    ],
)
def test_kinds_that_are_not_read_are_refused_by_name(tmp_path: Path, tags: dict[str, int], message: str) -> None:
    write_tiff(tmp_path / "odd.tif", bytes(4 * 5 * 8), 5, 4, **tags)
    with pytest.raises(InputError, match=rf"odd\.tif.*{message}") as caught:
        read_gray(tmp_path / "odd.tif")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["plain.tif", "tiled.tif", "zlib.tif", "a.png", "a.pgm", "a.ppm"])
def test_truncated_files_are_errors_never_zeros(tmp_path: Path, name: str) -> None:
    image = RNG.integers(0, 255, (64, 64), np.uint8)
    path = tmp_path / name
    if path.suffix == ".tif":
        options = {"plain": {}, "tiled": {"tile": (16, 16)}, "zlib": {"compression": "zlib"}}[path.stem]
        tifffile.imwrite(path, image, **options)
    elif path.suffix == ".ppm":
        Image.fromarray(np.dstack([image] * 3)).save(path)
    else:
        Image.fromarray(image).save(path)
    np.testing.assert_allclose(read_gray(path), image, rtol=1e-6)
    content = path.read_bytes()
    for length in (0, 1, 7, 9, 60, len(content) // 2, len(content) - 20):
        path.write_bytes(content[:length])
        with pytest.raises(InputError, match=name) as caught:
            read_gray(path)
        assert "\n" not in str(caught.value)


def test_damaged_bytes_never_escape_as_other_errors(tmp_path: Path) -> None:
    """Whatever single byte is wrong: values of the stated size, or an InputError; nothing else, and no hang."""
    image = RNG.integers(0, 255, (16, 16), np.uint8)
    readable, refusals = 0, []
    for compression in (None, "zlib", "lzw"):
        path = tmp_path / f"{compression}.tif"
        tifffile.imwrite(path, image, compression=compression, metadata=None)
        content = path.read_bytes()
        for position, value in itertools.product(range(4, min(len(content), 300), 3), (0, 255)):
            path.write_bytes(content[:position] + bytes([value]) + content[position + 1 :])
            try:
                readable += read_gray(path).ndim == 2
            except InputError as error:
                refusals.append(str(error))
    assert readable > 0
    assert len(refusals) > 0
    assert all(str(tmp_path) in line and "\n" not in line for line in refusals)


def test_strips_that_decode_short_are_errors(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    short = imagecodecs.zlib_encode(bytes(30))
    write_tiff(path, short, 8, 8, BitsPerSample=8, PhotometricInterpretation=1, Compression=8)
    with pytest.raises(InputError, match=r"a\.tif: page 0 cannot be decoded"):
        read_gray(path)


def test_hostile_sizes_are_refused_before_memory_is_asked_for(tmp_path: Path) -> None:
    side = 70000
    assert side * side > MAX_PIXELS
    write_tiff(tmp_path / "a.tif", b"\0" * 64, side, side, BitsPerSample=8, PhotometricInterpretation=1)
    (tmp_path / "a.pgm").write_bytes(b"P5 %d %d 255\n" % (side, side))
    png = io.BytesIO()
    Image.new("L", (4, 4)).save(png, "PNG")
    content = bytearray(png.getvalue())
    content[16:24] = struct.pack(">II", side, side)
    (tmp_path / "a.png").write_bytes(content)
    for name in ("a.tif", "a.pgm", "a.png"):
        with pytest.raises(InputError, match=f"70000 x 70000 pixels, more than {MAX_PIXELS}"):
            probe(tmp_path / name)


def test_pages_that_form_a_circle_or_leave_the_file_are_errors(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    image = RNG.integers(0, 255, (8, 8), np.uint8)
    write_tiff(path, image.tobytes(), 8, 8, BitsPerSample=8, PhotometricInterpretation=1)
    content = path.read_bytes()
    assert probe(path).pages == 1
    for following in (content[4:8], struct.pack("<I", 10**6)):
        path.write_bytes(content[:-4] + following)
        with pytest.raises(InputError, match="page 1 has its header at byte"):
            probe(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"P5 4 4 255\n" + bytes(15), "truncated"),
        (b"P5 4 4 255\n" + bytes(17), "several images"),
        (b"P5 2 2 70000\n" + bytes(8), "maximum value 70000"),
        (b"P5 2 2 100\n" + bytes([101] * 4), "above the stated maximum"),
        (b"P2 2 2 100\n11 22 33", "3 PNM values, 4 expected"),
        (b"P2 2 2 100\n1 2 3 x", "no numbers"),
        (b"P2 2 2 100\n1 2 3 -4", "no numbers"),
        (b"P2 2 2 100\n1 2 3 101", "above the stated maximum"),
        (b"P5 two 2 100\n", "PNM header"),
        (b"P1 2 2\n0 1 1 0", "another format"),
        (b"GIF89a", "another format"),
        (b"", "an empty file"),
    ],
)
def test_bad_pnm_and_foreign_files(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "bad.pgm").write_bytes(content)
    with pytest.raises(InputError, match=rf"bad\.pgm.*{message}"):
        read_gray(tmp_path / "bad.pgm")
