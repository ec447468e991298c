"""PNG and PNM: every depth, grey and colour, as written by hand or by others."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from test_images import pack

from leafflow_ti.capture.images import probe, read_gray, read_window

imagecodecs = pytest.importorskip("imagecodecs", reason="the codecs extra is not installed")
RNG = np.random.default_rng(7)


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
def test_png_grey_keeps_its_scale(tmp_path: Path, bits: int) -> None:
    image = RNG.integers(0, 2**bits, (7, 10))
    path = tmp_path / "a.png"
    rows = pack(image, bits) if bits != 16 else image.astype(">u2").tobytes()
    _write_png(path, rows, 10, 7, bits)
    info = probe(path)
    assert (info.bits, info.dtype) == (bits, np.dtype(np.uint16 if bits == 16 else np.uint8))
    np.testing.assert_array_equal(read_gray(path), image)


def _write_png(path: Path, rows: bytes, width: int, height: int, bits: int) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    stride = len(rows) // height
    raw = b"".join(b"\0" + rows[k * stride : (k + 1) * stride] for k in range(height))
    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    content = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + content)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("samples", [1, 2, 3, 4])
def test_png_colour_and_alpha(tmp_path: Path, dtype: type, samples: int) -> None:
    image = RNG.integers(0, np.iinfo(dtype).max, (7, 10, samples), dtype)
    path = tmp_path / "a.png"
    path.write_bytes(imagecodecs.png_encode(image if samples > 1 else image[..., 0]))
    expected = image[..., 0] if samples < 3 else image[..., :3] @ np.array([0.299, 0.587, 0.114])
    np.testing.assert_allclose(read_gray(path), expected, rtol=1e-6)
    assert probe(path).samples == samples


@pytest.mark.parametrize("maximum", [1, 100, 255, 256, 4095, 65535])
@pytest.mark.parametrize("kind", ["P2", "P3", "P5", "P6"])
def test_pnm(tmp_path: Path, maximum: int, kind: str) -> None:
    samples = 3 if kind in ("P3", "P6") else 1
    image = RNG.integers(0, maximum, (5, 6, samples), endpoint=True)
    header = f"{kind}\n# made here\n6 5\n{maximum}\n".encode()
    if kind in ("P2", "P3"):
        data = "\n".join(" ".join(map(str, row.ravel())) for row in image).encode()
    else:
        data = image.astype(">u1" if maximum < 256 else ">u2").tobytes()
    path = tmp_path / "a.pnm"
    path.write_bytes(header + data)
    info = probe(path)
    assert (info.bits, info.samples) == (maximum.bit_length(), samples)
    expected = image[..., 0] if samples == 1 else image @ np.array([0.299, 0.587, 0.114])
    np.testing.assert_allclose(read_gray(path), expected, rtol=1e-6)
    np.testing.assert_allclose(read_window(path, 0, "mean", 1, 4, 2, 6), image.mean(axis=-1)[1:4, 2:6], rtol=1e-6)
