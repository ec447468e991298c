"""Images made to do harm, and files that change while they are read: one line, in the memory that they state."""

from __future__ import annotations

import os
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from test_images import write_tiff

from leafflow_ti.capture import stored as stored_files
from leafflow_ti.capture import tiff_structure
from leafflow_ti.capture.images import probe, read_gray, read_window
from leafflow_ti.capture.stored import OpenFile, look_at, one_line
from leafflow_ti.errors import InputError

imagecodecs = pytest.importorskip("imagecodecs", reason="the codecs extra is not installed")
pytest.importorskip("PIL.Image", reason="Pillow, the independent reader, is not installed")
from perf.fuzz import images as fuzzing  # noqa: E402
from perf.fuzz.image_seeds import bare_tiff, png_chunk, seeds  # noqa: E402
from perf.fuzz.trial import judge  # noqa: E402

RNG = np.random.default_rng(7)
GREY = RNG.integers(0, 255, (16, 16), np.uint8)
PNG = b"\x89PNG\r\n\x1a\n"
HEADER_16 = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 16, 16, 8, 0, 0, 0, 0))
ROWS = b"".join(b"\0" + row.tobytes() for row in GREY)
END = png_chunk(b"IEND", b"")
BIG = 2**24


def _refused(path: Path, content: bytes, message: str) -> None:
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"{path.name}.*{message}") as caught:
        read_gray(path)
    assert "\n" not in str(caught.value)


def test_damaged_files_give_what_other_readers_give_or_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LEAFFLOW_TI_DATA", str(tmp_path))
    trial = fuzzing.damaging(seeds(bomb=2**18))
    verdicts = []
    for number in range(300):
        folder = tmp_path / str(number)
        folder.mkdir()
        verdicts.append(judge(trial, (0, number), folder))
    assert [verdict.defect for verdict in verdicts if verdict.defect] == []
    outcomes = [verdict.outcome for verdict in verdicts]
    assert outcomes.count("values, alike") > 30
    assert outcomes.count("refused") > 100


def test_the_fuzzer_sees_wrong_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a reader that is off by one in one pixel."""

    def wrong(*arguments: object) -> np.ndarray:
        values = read_gray(*arguments)  # type: ignore[arg-type]
        values[3, 4] += 1
        return values

    monkeypatch.setattr(fuzzing, "read_gray", wrong)
    monkeypatch.setattr(fuzzing, "_check_values", lambda *_: None)
    tifffile.imwrite(tmp_path / "a.tif", GREY)
    with pytest.raises(fuzzing.Defect, match="tifffile reads other values"):
        fuzzing.check(RNG, tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("compression", "segment", "codecs"),
    [
        (8, lambda: zlib.compress(bytes(BIG), 9), True),
        (8, lambda: zlib.compress(bytes(BIG), 9), False),  # as tifffile decodes without the package of codecs
        (32773, lambda: b"\x81\x00" * (BIG // 128), True),
        (50000, lambda: imagecodecs.zstd_encode(bytes(BIG)), True),
        (7, lambda: imagecodecs.jpeg_encode(np.zeros((4096, 4096), np.uint8)), True),
        (34712, lambda: imagecodecs.jpeg2k_encode(np.zeros((4096, 4096), np.uint8), level=0), True),
        (34933, lambda: imagecodecs.png_encode(np.zeros((4096, 4096), np.uint8)), True),
        (34887, lambda: imagecodecs.lerc_encode(np.zeros((4096, 4096), np.uint8)), True),
    ],
)
def test_segments_that_decode_to_more_than_stated_are_refused_unseen(
    tmp_path: Path, compression: int, segment: Callable[[], bytes], codecs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """16 x 16 pixels stated, 16 MiB in the data."""
    content = bare_tiff(segment(), 16, 16, compression)
    monkeypatch.setattr("leafflow_ti.capture.tiff_segments.has_imagecodecs", lambda: codecs)
    tracemalloc.start()
    try:
        _refused(tmp_path / "bomb.tif", content, "")
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2 * len(content) + 2**20


def test_png_bombs_in_texts_are_left_alone_and_surplus_pixels_refused(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    bomb = zlib.compress(bytes(BIG), 9)
    extras = png_chunk(b"iCCP", b"name\0\0" + bomb) + png_chunk(b"zTXt", b"Comment\0\0" + bomb) * 20
    pixels = png_chunk(b"IDAT", zlib.compress(ROWS))
    path = tmp_path / "a.png"
    path.write_bytes(PNG + HEADER_16 + extras + pixels + END)
    np.testing.assert_array_equal(read_gray(path), GREY)
    assert capfd.readouterr() == ("", "")
    _refused(path, PNG + HEADER_16 + png_chunk(b"IDAT", RNG.bytes(2**18)) + END, "262144 bytes for 16 x 16 pixels")
    _refused(path, PNG + HEADER_16 + pixels, "truncated")
    _refused(path, PNG + HEADER_16 + png_chunk(b"ABCD", b"") + pixels + END, "chunk b'ABCD' is unknown")
    wide = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 40000, 40000, 8, 0, 0, 0, 0))
    _refused(path, PNG + wide + pixels + END, "too many for a PNG of")


@pytest.mark.parametrize("compression", [1, 5, 7, 8, 32773, 34925, 50000])
def test_more_pixels_than_the_bytes_can_hold_are_refused_from_the_header(tmp_path: Path, compression: int) -> None:
    (tmp_path / "a.tif").write_bytes(bare_tiff(bytes(100), 40000, 40000, compression))
    message = "truncated" if compression == 1 else "100 bytes for 40000 x 40000 pixels cannot be"
    with pytest.raises(InputError, match=message):
        probe(tmp_path / "a.tif")


JPEG = imagecodecs.jpeg_encode(GREY)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (bare_tiff(JPEG[:-20], 16, 16, 7), "JPEG data end before the picture does"),
        (bare_tiff(JPEG, 8, 32, 7), "16 x 16 with 1 samples, not 8 x 32"),
        (bare_tiff(JPEG, 16, 16, 7, bits=1), "the header states 1 bit"),
        (bare_tiff(b"\x26\xa1" * 400, 16, 16, 4, bits=12), "cannot be decoded"),
        (bare_tiff(bytes(256), 15, 16, 1), "256 bytes for 15 rows of 16"),
        (bare_tiff(bytes(256), 17, 16, 1) + bytes(99), "256 bytes for 17 rows of 16"),
        (bare_tiff(bytes(256), 16, 16, 1, bits=4), "256 bytes for 16 x 16 pixels cannot be"),
        (bare_tiff(bytes(256), 2**32 - 1, 2**32 - 1, 1), "more than 2147483648"),
        (bare_tiff(bytes(256), 0, 16, 1), "empty image"),
    ],
)
def test_contradictory_pages_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    _refused(tmp_path / "a.tif", content, message)


def _entries(*entries: tuple[int, int, int, int], following: int = 0, data: bytes = GREY.tobytes()) -> bytes:
    """TIFF with the given entries (tag, type, count, value); the data begin at byte 8."""
    packed = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    header = struct.pack("<2sHI", b"II", 42, 8 + len(data))
    return header + data + struct.pack("<H", len(entries)) + packed + struct.pack("<I", following)


def _with(*changes: tuple[int, int, int, int]) -> bytes:
    """The sound page of GREY with entries replaced or added."""
    sound = {256: 16, 257: 16, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 278: 16, 279: 256}
    entries = {tag: (tag, 4, 1, value) for tag, value in sound.items()} | {entry[0]: entry for entry in changes}
    return _entries(*(entries[tag] for tag in sorted(entries) if entries[tag][1]))


def test_the_hostile_headers_below_are_otherwise_sound(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(_with())
    np.testing.assert_array_equal(read_gray(tmp_path / "a.tif"), GREY)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (_with((259, 5, 1, 4_000_000)), "entry 259 of the header is damaged"),  # compression outside the file
        (_with((317, 77, 1, 2)), "entry 317 of the header is damaged"),  # predictor of no type
        (_with((278, 11, 1, 16)), "entry 278 of the header is damaged"),  # rows per strip as float
        (_with((257, 4, 40, 8)), "entry 257 of the header is damaged"),  # forty heights
        (_with((273, 4, 2**31, 8)), "entry 273 of the header is damaged"),  # strips beyond the file
        (_with((317, 4, 1, 2)), "predictor 2 for samples of format 1 with compression 1 has no meaning"),
        (_with((317, 4, 1, 3), (259, 4, 1, 5)), "predictor 3 for samples of format 1 with compression 5"),
        (_with((277, 4, 1, 0)), "0 samples per pixel"),
        (_with((262, 0, 0, 0)), "whether black or white is zero"),
        (_with((324, 4, 1, 8)), "strips as well as tiles"),
        (_with((322, 4, 1, 0), (323, 4, 1, 16)), "strips or tiles of 0 x 16"),
        (_with((322, 4, 1, 2**31), (323, 4, 1, 2**31)), "strips or tiles of"),
        (_with((278, 4, 1, 0)), "strips or tiles of 0 x 16"),
        (_with((273, 4, 1, 0)), "without data"),
        (_with((273, 4, 2, 8), (279, 4, 2, 8)), "2 strips or tiles listed, 1 needed"),
        (_with((277, 4, 1, 65535)), "bit samples|truncated|samples is not supported"),
        (_entries((256, 4, 1, 16), (256, 4, 1, 16)), "entry 256 stands twice"),
        (_entries(), "a header of 0 entries"),
        (struct.pack("<2sHI", b"II", 42, 0), "without an image"),
        (struct.pack("<2sHHHQ", b"II", 43, 8, 0, 2**63), "page 0 has its header at byte 9223372036854775808"),
        (struct.pack("<2sHHHQQ", b"II", 43, 8, 0, 16, 2**63), "a header of 9223372036854775808 entries"),
        (struct.pack("<2sHHHQQHHQQ", b"II", 43, 8, 0, 16, 1, 273, 16, 2**63, 2**63) + bytes(8), "entry 273"),
    ],
)
def test_hostile_headers_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    _refused(tmp_path / "a.tif", content, message)


def test_entries_that_share_their_bytes_are_bounded(tmp_path: Path) -> None:
    """Private entries of 250 bytes each, all the same ones: parsed, they would be many times the file."""
    _refused(tmp_path / "a.tif", _entries(*((40000 + k, 1, 250, 8) for k in range(40))), "twice the file")


def test_endless_chains_of_pages_and_stacks_of_nothing_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as writer:
        for _ in range(5):
            writer.write(GREY, metadata=None)
    assert probe(path).pages == 5
    monkeypatch.setattr(tiff_structure, "MAX_PAGES", 4)
    _refused(path, path.read_bytes() + b"\0", "more than 4 pages")


@pytest.mark.parametrize("count", [4, 10**15])
def test_a_stack_behind_one_header_that_was_cut_off_is_refused(tmp_path: Path, count: int) -> None:
    text = f"ImageJ=1.53\nimages={count}\nslices={count}\n"
    tifffile.imwrite(tmp_path / "a.tif", GREY, description=text, metadata=None)
    with pytest.raises(InputError, match=rf"a\.tif: header states {count} images, the file ends before"):
        probe(tmp_path / "a.tif")
    content = _shaped(tmp_path / "b.tif")
    _refused(tmp_path / "b.tif", content[: len(content) // 2], "")


def _shaped(path: Path) -> bytes:
    tifffile.imwrite(path, np.stack([GREY] * 8), truncate=True, photometric="minisblack")
    assert probe(path).pages == 8
    return path.read_bytes()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"P5 " + b"9" * 5000 + b" 2 255\n", "PNM header is not"),
        (b"P2 2 2 255\n" + b"# no end " * 9000, "bytes for 4 PNM values cannot be"),
        (b"P5 #" + b" " * 10**6, "PNM header is not"),
        (b"P2 2 2 255\n1 2 3 " + b" " * 10**5, "bytes for 4 PNM values cannot be"),
        (b"P2 40000 40000 255\n1 2 3", "5 bytes for 1600000000 PNM values cannot be"),
        (b"P2 2 2 255\n1 2 3 " + b"9" * 400, "above the stated maximum"),
        (b"P2 2 2 255\n1 2 3 1e2", "no numbers"),
    ],
)
def test_hostile_portable_maps_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    _refused(tmp_path / "a.pgm", content, message)


def _cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def _replace(path: Path) -> None:
    other = path.with_suffix(".new")
    other.write_bytes(path.read_bytes() + b"\0")
    other.replace(path)


def _rewrite(path: Path) -> None:
    path.write_bytes(path.read_bytes())
    os.utime(path, ns=(0, 0))


@pytest.mark.parametrize("change", [_cut, _replace, _rewrite])
@pytest.mark.parametrize("name", ["plain.tif", "strips.tif", "a.png", "a.pgm"])
def test_a_file_that_changes_between_header_and_data_is_named(
    tmp_path: Path, name: str, change: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _whole(tmp_path / name)
    stored = look_at(path)
    probe(path)  # the header is known
    change(path)
    monkeypatch.setattr("leafflow_ti.capture.images.look_at", lambda _: stored)
    with pytest.raises(InputError, match=rf"{name}: changed while it was read \(from \d+ to \d+ bytes\)"):
        read_window(path, 0, "luminance", 100, 120, 0, 90)


@pytest.mark.parametrize("change", [_cut, _rewrite])
@pytest.mark.parametrize("name", ["plain.tif", "strips.tif", "a.png", "a.pgm"])
def test_a_file_that_changes_under_the_read_is_named(
    tmp_path: Path, name: str, change: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one that is cut short just before its rows are read, which would end a process that maps it."""
    path = _whole(tmp_path / name)
    probe(path)
    read = OpenFile.read_rows if path.suffix == ".pgm" or path.stem == "plain" else OpenFile.read

    def changed(self: OpenFile, *arguments: int) -> object:
        change(path)
        return read(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(OpenFile, read.__name__, changed)
    with pytest.raises(InputError, match=f"{name}: changed while it was read"):
        read_gray(path)


def _whole(path: Path) -> Path:
    """A sound image of 150 x 100 pixels; by its name plain, in strips, or of another format."""
    image = RNG.integers(0, 255, (150, 100), np.uint8)
    if path.suffix == ".png":
        path.write_bytes(imagecodecs.png_encode(image))
    elif path.suffix == ".pgm":
        path.write_bytes(b"P5 100 150 255\n" + image.tobytes())
    else:
        options = {"compression": "zlib", "rowsperstrip": 20} if path.stem == "strips" else {}
        tifffile.imwrite(path, image, **options)
    np.testing.assert_array_equal(read_gray(path), image)
    return path


def test_texts_of_decoders_are_printed_only_if_they_can_be_read() -> None:
    assert one_line(ValueError("two\nlines")) == "two lines"
    assert len(one_line(ValueError("long " * 1000))) < 210
    assert one_line(ValueError("0\x7f")) == one_line(ValueError("")) == "ValueError"


def test_what_is_no_regular_file_is_not_opened(tmp_path: Path) -> None:
    """Opening a pipe would wait for ever."""
    os.mkfifo(tmp_path / "pipe.tif")
    for path in (tmp_path / "pipe.tif", Path(os.devnull), tmp_path):
        with pytest.raises(InputError, match="not a file"):
            probe(path)
    with pytest.raises(InputError, match="cannot be read"):
        probe(Path("a\0b.tif"))


def test_too_little_memory_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _whole(tmp_path / "plain.tif")

    def none_left(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(OpenFile, "read_rows", none_left)
    with pytest.raises(InputError, match=r"plain\.tif: 150 x 100 pixels need more memory than there is"):
        read_gray(path)


def test_values_that_are_not_finite_stay_as_they_are(tmp_path: Path) -> None:
    image = RNG.normal(size=(9, 7))
    image[2, 3], image[4, 5], image[6, 1], image[7, 0] = np.nan, np.inf, -np.inf, 1e300
    for name, options in (("plain", {}), ("zlib", {"compression": "zlib", "predictor": 3})):
        tifffile.imwrite(tmp_path / f"{name}.tif", image, **options)
        np.testing.assert_array_equal(read_gray(tmp_path / f"{name}.tif", dtype=np.float64), image)
    single = read_gray(tmp_path / "plain.tif")
    assert single[7, 0] == np.inf  # too large for single precision


@pytest.mark.parametrize("separate", [False, True])
@pytest.mark.parametrize("columns", [(0, 300), (40, 45)])
@pytest.mark.parametrize(("block", "skipped"), [(2**20, 2**16), (5000, 2**16), (2**20, 100)])
def test_narrow_and_wide_windows_of_plain_data(
    tmp_path: Path, separate: bool, columns: tuple[int, int], block: int, skipped: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Read in one go, in blocks of some rows, and piece by piece."""
    monkeypatch.setattr(stored_files, "BLOCK", block)
    monkeypatch.setattr(stored_files, "_SKIPPED", skipped)
    image = RNG.integers(0, 60000, (3, 20, 300), np.uint16)
    options = {"planarconfig": "separate"} if separate else {}
    data = image if separate else np.moveaxis(image, 0, -1)
    tifffile.imwrite(tmp_path / "a.tif", data, photometric="rgb", byteorder=">", **options)
    for channel in range(3):
        window = read_window(tmp_path / "a.tif", 0, channel, 3, 17, *columns)
        np.testing.assert_array_equal(window, image[channel, 3:17, slice(*columns)])


def test_overlapping_strips_are_refused(tmp_path: Path) -> None:
    write_tiff(tmp_path / "a.tif", bytes(4096), 64, 64, BitsPerSample=8, PhotometricInterpretation=1, Compression=5)
    content = (tmp_path / "a.tif").read_bytes()
    strips = 4096 // 64
    offsets, counts = struct.pack(f"<{strips}I", *[8] * strips), struct.pack(f"<{strips}I", *[4096] * strips)
    place = len(content)
    entries = [
        (256, 4, 1, 64), (257, 4, 1, 64), (258, 4, 1, 8), (259, 4, 1, 5), (262, 4, 1, 1),
        (273, 4, strips, place), (277, 4, 1, 1), (278, 4, 1, 1), (279, 4, strips, place + len(offsets)),
    ]  # fmt: skip
    header = place + len(offsets) + len(counts)
    packed = struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4)
    _refused(
        tmp_path / "a.tif", content[:4] + struct.pack("<I", header) + content[8:] + offsets + counts + packed, "overlap"
    )
