"""Folders and images of a capture that would do harm or spoil results: refused, named, or warned of."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import leafflow_ti as lf
from leafflow_ti.capture import Capture, Geometry, capture_doubts, capture_from_array, open_capture
from leafflow_ti.capture.changes import CHECKED_BYTES, changes, pack, parts, unpack
from leafflow_ti.capture.files import FileState
from leafflow_ti.capture.plausibility import depth_doubts, plausibility
from leafflow_ti.cli.main import main
from leafflow_ti.errors import InputError
from leafflow_ti.plan import make_plan
from leafflow_ti.provenance import differences, provenance
from perf.fuzz.descriptions import write_pgm

SHAPE = (40, 56)
TEXT = """[images]
pattern = "c{sx}/{t:02d}.pgm"
[camera]
focal_length_px = 100.0
[grid]
baseline_mm = 5.0
"""


def images(frames: int = 4, cameras: int = 5) -> np.ndarray:
    """Noise as texture, 4 px of disparity per step, and noise of its own in each image: [t, 1, sx, y, x] uint8."""
    rng = np.random.default_rng(5)
    texture = rng.integers(60, 180, (SHAPE[0], SHAPE[1] + 4 * cameras))
    seen = [texture[:, 4 * k : 4 * k + SHAPE[1]] for k in range(cameras)]
    return (np.array([[seen]] * frames) + rng.integers(0, 9, (frames, 1, cameras, *SHAPE))).astype(np.uint8)


def captured(values: np.ndarray, **options: object) -> Capture:
    geometry = Geometry(100.0, (SHAPE[1] / 2, SHAPE[0] / 2), (5.0, 0.0))
    return capture_from_array(values, geometry, **options)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of 3 cameras and 4 frames, with times a minute apart."""
    root = tmp_path / "capture"
    for (t, _, k), image in ((at, images(4, 3)[at]) for at in np.ndindex(4, 1, 3)):
        path = root / f"c{k}" / f"{t:02d}.pgm"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_pgm(path, image)
        os.utime(path, ns=(0, int((1000 + 60 * t) * 1e9)))
    (root / "capture.toml").write_text(TEXT)
    return root


def replaced(path: Path, make: Callable[[Path], object]) -> None:
    path.unlink()
    make(path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: path.symlink_to(path.name), r"01\.pgm: cannot be read \(Too many levels of symbolic links\)"),
        (lambda path: path.symlink_to("nothing"), r"01\.pgm: cannot be read \(No such file"),
        (
            lambda path: path.symlink_to("/dev/zero"),
            r"01\.pgm: leads out of the folder .*, to /dev/zero: copy it there",
        ),
        (os.mkfifo, r"01\.pgm: a pipe, not a file: remove it"),
        (Path.mkdir, r"01\.pgm: a folder, not a file: remove it"),
    ],
)
def test_only_regular_files_are_read(folder: Path, make: Callable[[Path], object], message: str) -> None:
    replaced(folder / "c1" / "01.pgm", make)
    with pytest.raises(InputError, match=message):
        open_capture(folder)


def test_a_description_that_is_a_pipe_does_not_hang(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "capture.toml")
    with pytest.raises(InputError, match=r"capture\.toml: a pipe, not a file"):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    "how", ["link to a file", "link to a folder", "dots", "absolute", "dead pixels", "calibration", "stamps"]
)
def test_files_elsewhere_must_be_allowed(folder: Path, tmp_path: Path, how: str) -> None:
    elsewhere, text = tmp_path / "elsewhere", TEXT
    shutil.copytree(folder, elsewhere)
    (elsewhere / "camera.yml").write_text("camera_matrix: [[100, 0, 28], [0, 100, 20], [0, 0, 1]]\n")
    (elsewhere / "times.txt").write_text("0\n60\n120\n180\n")
    if how == "link to a file":
        replaced(folder / "c1" / "01.pgm", lambda path: path.symlink_to(elsewhere / "c1" / "01.pgm"))
    elif how == "link to a folder":
        shutil.rmtree(folder / "c1")
        (folder / "c1").symlink_to(elsewhere / "c1")
    elif how in ("dots", "absolute"):
        text = TEXT.replace("c{sx}", ("../elsewhere" if how == "dots" else elsewhere.as_posix()) + "/c{sx}")
    elif how == "dead pixels":
        text = TEXT.replace("[camera]", 'dead = "../elsewhere/c0/00.pgm"\n[camera]')
    elif how == "calibration":
        text = TEXT.replace("focal_length_px = 100.0", 'calibration = "../elsewhere/camera.yml"')
    else:
        text += '[time]\nstamps = "../elsewhere/times.txt"\n'
    (folder / "capture.toml").write_text(text)
    with pytest.raises(InputError, match=r"leads out of the folder of its capture\.toml, to .*elsewhere.*--outside"):
        open_capture(folder)
    opened = open_capture(folder, outside=True)
    assert opened.outside
    assert opened.shape == (4, 1, 3, *SHAPE)


def test_links_inside_the_folder_are_followed(folder: Path) -> None:
    shutil.move(folder / "c1" / "01.pgm", folder / "kept.pgm")
    (folder / "c1" / "01.pgm").symlink_to("../kept.pgm")
    (folder.parent / "link").symlink_to(folder)
    assert open_capture(folder.parent / "link").shape == (4, 1, 3, *SHAPE)


def test_links_to_folders_above_are_no_further_cameras(folder: Path) -> None:
    for k in range(3, 9):
        (folder / f"c{k}").symlink_to(folder / "c0")
    with pytest.raises(InputError, match=r"c\d and .*c\d are one folder: remove the link"):
        open_capture(folder)


def test_frames_that_one_camera_has_alone_are_named(folder: Path) -> None:
    shutil.copy(folder / "c2" / "03.pgm", folder / "c2" / "04.pgm")
    with pytest.raises(
        InputError, match=r"1 image\(s\) of frames that most cameras do not have: .*c2/04\.pgm: remove them"
    ):
        open_capture(folder)
    (folder / "c2" / "notes.txt").touch()
    (folder / "c2" / "04.pgm").rename(folder / "c2" / "x.pgm")
    assert open_capture(folder).n_frames == 4


@pytest.mark.parametrize("bytes_more", [0, 1])
def test_an_image_that_changes_while_a_capture_is_open(folder: Path, bytes_more: int) -> None:
    capture, path = open_capture(folder), folder / "c1" / "02.pgm"
    capture.read(2, 0, 1, 0, 9, 0, 9)
    path.write_bytes(path.read_bytes() + b"\n" * bytes_more)
    with pytest.raises(InputError, match=r"02\.pgm: changed while the capture was in use"):
        capture.read(2, 0, 1, 0, 9, 0, 9)
    path.unlink()
    with pytest.raises(InputError, match=r"02\.pgm: cannot be read"):
        capture.read(2, 0, 1, 0, 9, 0, 9)
    capture.read(1, 0, 1, 0, 9, 0, 9)


def test_times_that_a_file_system_cuts_off_are_no_change() -> None:
    exact = FileState(5, 1_700_000_001_234_567_890)
    for cut in (1_700_000_001_230_000_000, 1_700_000_001_000_000_000, 1_700_000_000_000_000_000):
        assert exact.same(FileState(5, cut))
        assert FileState(5, cut).same(exact)
    for other in (
        FileState(5, 1_700_000_001_234_000_000),
        FileState(5, 1_700_000_003_000_000_000),
        FileState(6, exact.mtime_ns),
    ):
        assert not exact.same(other)


def test_listings_say_which_files_changed() -> None:
    before = {f"c{k}/{t}.tif": FileState(100, (t + 1) * 10**9 + k) for k in range(2) for t in range(3)}
    old = pack(before.items())
    assert list(unpack(old)) == list(before)
    assert changes(old, old) == {}
    copy = {name: FileState(state.size, state.mtime_ns + 10**12) for name, state in before.items()}
    assert changes(old, pack(copy.items())) == {}
    now = dict(before)
    now["c0/1.tif"] = FileState(101, 5)
    now["c1/2.tif"] = FileState(100, 10**15)
    now["new.tif"] = now.pop("c0/0.tif")
    assert changes(old, pack(now.items())) == {
        "c0/0.tif": "is missing", "new.tif": "is new",
        "c0/1.tif": "had 100 bytes, has 101", "c1/2.tif": "was written anew",
    }  # fmt: skip
    for text in ("", "x", "AAAA", old[:-8], pack([])):
        with pytest.raises(ValueError, match="no listing of files"):
            changes(old, text)


@pytest.mark.parametrize(
    "sizes", [[10, 20], [CHECKED_BYTES], [2**34], [2**24] * 300, [2**34, 1, 2**30], [3 * 10**5] * 1000]
)
def test_a_checksum_reads_parts_inside_the_files(sizes: list[int]) -> None:
    found = parts((Path(str(k)), size) for k, size in enumerate(sizes))
    assert sum(count for _, _, count in found) <= CHECKED_BYTES
    assert all(at >= 0 and n > 0 and at + n <= sizes[int(path.name)] for path, at, n in found)
    assert {found[0][0].name, found[-1][0].name} == {"0", str(len(sizes) - 1)}
    if sum(sizes) <= CHECKED_BYTES:
        assert [count for _, _, count in found] == sizes


def test_what_a_resumed_run_says_of_files_that_changed(folder: Path, tmp_path: Path) -> None:
    config = lf.load_config(overrides={"model": "depth", "window": 9, "preshift": (-4, 0)})

    def seen(where: Path) -> dict[str, object]:
        capture = open_capture(where)
        return json.loads(json.dumps(provenance(make_plan(capture, config), capture)))

    before = seen(folder)
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy, copy_function=shutil.copy)  # other times
    assert differences(before, seen(copy)) == []
    write_pgm(folder / "c0" / "02.pgm", images()[0, 0, 1])
    assert differences(before, seen(folder)) == ["c0/02.pgm was written anew"]
    write_pgm(copy / "c0" / "02.pgm", images()[0, 0, 1])
    assert differences(before, seen(copy))[0].startswith("input.contents_sha256 was ")


def changed(values: np.ndarray, what: str) -> np.ndarray:
    values = values.copy()
    match what:
        case "a black frame":
            values[1] = 0
        case "a darker frame":
            values[1] = values[1] // 2
        case "a dark camera":
            values[:, :, 1] = values[:, :, 1] // 4
        case "a copied camera":
            values[:, :, 1] = values[:, :, 2]
        case "a copied frame":
            values[1] = values[0]
        case "saturated":
            values[:] = np.minimum(values * 4.0, 255).astype(np.uint8)
        case "constant":
            values[:] = 7
        case "exchanged":
            values[:, :, [1, 2]] = values[:, :, [2, 1]]
        case "another scene":
            values[:, :, 4] = values[:, :, 4, ::-1]
        case "not finite":
            values = values.astype(np.float32)
            values[1] = np.nan
    return values


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("a black frame", "frame 1, camera row 0, column 2: every pixel is 0 (black): nothing is measured there"),
        ("a black frame", "light changes abruptly: frame 1 has 0 times the grey values of frame 0, frame 1 is black"),
        ("a darker frame", "frame 1 has 0.5 times the grey values of frame 0, frame 2 has 2 times the grey values"),
        ("a dark camera", "camera (row 0, column 1) shows 0.25 times the grey values of the others in frame 2"),
        ("a copied camera", "frame 0, camera row 0, column 1 and frame 0, camera row 0, column 2 are identical (and 2"),
        ("a copied frame", "frame 0, camera row 0, column 2 and frame 1, camera row 0, column 2 are identical, which"),
        ("saturated", "% of the pixels are saturated: lower the exposure"),
        ("constant", "column 2 and others: every pixel is 7: nothing"),
        ("exchanged", "cameras 1 and 2 of row 0 do not show the disparity of about "),
        ("another scene", "cameras 3 and 4 of row 0 do not show the disparity of about -4 px that most do in frame 2"),
        ("not finite", "frame 1, camera row 0, column 2: more than half of the grey values are no numbers"),
    ],
)  # fmt: skip
def test_images_that_spoil_results_are_named(what: str, message: str) -> None:
    sound, spoilt = images(), changed(images(), what)
    assert capture_doubts(captured(sound)) == ()
    found = capture_doubts(captured(spoilt))
    assert any(message in line for line in found), found
    assert all("\n" not in line for line in found)


def test_long_sequences_are_looked_at_in_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("leafflow_ti.capture.doubts.MOST_FRAMES", 4)
    values = images(9, 1)
    values[8] //= 3
    assert "frame 8 has 0.3" in capture_doubts(capture_from_array(values))[0]


def test_doubts_are_warnings_of_a_run_and_problems_of_a_check(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(3):
        write_pgm(folder / f"c{k}" / "01.pgm", np.zeros(SHAPE, np.uint8))
    config = lf.load_config(overrides={"model": "depth", "window": 9, "stride": 8, "preshift": (-4, 0)})
    out = tmp_path / "out.zarr"
    lf.run(folder, out, config)
    with pytest.raises(SystemExit) as end:
        main(["info", str(folder)])
    assert not end.value.code
    shown = capsys.readouterr().out
    said = lf.ResultStore.open(out).attrs["warnings"]
    assert any("01.pgm: every pixel is 0 (black)" in line for line in said)
    assert all(f"warning      {line}" in shown for line in said)
    problems = [one.text for one in lf.check(folder).advice if one.kind == "problem"]
    assert set(said) <= set(problems)


def stated(folder: Path, **keys: str) -> Capture:
    """The capture with other values in its description."""
    text = TEXT
    for key, value in keys.items():
        line = next((line for line in TEXT.splitlines() if line.startswith(key)), "")
        text = text.replace(line, f"{key} = {value}") if line else text + f"\n{key} = {value}"
    (folder / "capture.toml").write_text(text)
    return open_capture(folder)


def test_what_is_plausible_raises_no_doubt(folder: Path) -> None:
    assert plausibility(stated(folder)) == []
    (folder / "capture.toml").write_text(TEXT + "[time]\ninterval_s = 60.0\n")
    assert plausibility(open_capture(folder)) == []


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("focal_length_px = 100.0", "focal_length_px = 3.0", "a focal length of 3 px sees 168° with 56 px"),
        ("focal_length_px = 100.0", "focal_length_px = 1e6", "a focal length of 1e+06 px sees 0.00321° with 56 px"),
        ("focal_length_px = 100.0", "focal_length_mm = 12.0\npixel_pitch_mm = 3.45", "is it in µm? then 0.00345"),
        ("focal_length_px = 100.0", "focal_length_mm = 12.0\npixel_pitch_mm = 3.45e-6", "is it in m? then 0.00345"),
        ("[grid]", "principal_point_px = [1000.0, 20.0]\n[grid]", "is at x = 1000 px, beside an image of 56 px"),
        ("baseline_mm = 5.0", "baseline_mm = 0.002", "baseline_mm = 0.002 along x: with the focal length of 100 px"),
        ("baseline_mm = 5.0", "baseline_mm = 5e6", "depths from 8.93e+03 m"),
        ("baseline_mm = 5.0", "baseline_mm = 5.0\ndisparity_offset_px = 9.0", "towards each other it is -9"),
        ("[grid]", "[time]\ninterval_s = 1.0\n[grid]", "every 60 s: is it in minutes? then interval_s = 60"),
        ("[grid]", "[time]\ninterval_s = 1e7\n[grid]", "the interval is 1e+07 s; 1e-07 to 604800 s are plausible"),
    ],
)  # fmt: skip
def test_values_that_are_hardly_meant(folder: Path, old: str, new: str, message: str) -> None:
    (folder / "capture.toml").write_text(TEXT.replace(old, new))
    found = plausibility(open_capture(folder))
    assert len(found) == 1
    assert message in found[0]


def test_calibrations_of_other_images_and_depths_beyond_reach(folder: Path) -> None:
    (folder / "camera.yml").write_text(
        "camera_matrix: [[100, 0, 28], [0, 60, 20], [0, 0, 1]]\ndistortion_coefficients: [40.0, 0, 0, 0]\n"
    )
    (folder / "capture.toml").write_text(TEXT.replace("focal_length_px = 100.0", 'calibration = "camera.yml"'))
    first, second = plausibility(open_capture(folder))
    assert "camera.yml: focal lengths of 100 and 60 px: pixels are mostly square" in first
    assert "camera.yml: its distortion or rotation moves a corner of the image by" in second
    capture = captured(images())
    assert depth_doubts(capture, (-4.0, 0.0)) == []
    assert "which is 1 mm of depth" in depth_doubts(capture, (-500.0, 0.0))[0]


def test_differences_of_a_store_without_a_listing_are_still_seen() -> None:
    old, new = (
        {"input": {"files": 3, "contents_sha256": "a"}},
        {"input": {"files": 3, "contents_sha256": "b"}, "input_files": "x"},
    )
    assert differences(old, new) == ["input.contents_sha256 was a, is b"]


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_images_without_numbers_are_looked_at_without_complaints() -> None:
    values = images(3, 3).astype(np.float32)
    values[..., :20] = np.nan
    values[..., 30, :] = np.inf
    values[0, 0, 1] = -np.inf
    found = lf.check(captured(values))
    assert any("frame 0, camera row 0, column 1: more than half" in one.text for one in found.advice)
    assert set(found.frame_gains) == {1, 2}
    config = lf.load_config(overrides={"model": "depth", "window": 9, "preshift": (-4, 0), "frames": "2:3"})
    assert 0 < make_plan(captured(values), config).problem.noise < 50
