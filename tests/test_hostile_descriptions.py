"""Descriptions, calibrations and patterns made to do harm: one line of error, in little time and memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from leafflow_ti.capture import open_capture
from leafflow_ti.capture.calibration import read_calibration
from leafflow_ti.capture.description import LARGEST_FILE, read_description
from leafflow_ti.capture.files import Reach
from leafflow_ti.capture.pattern import Pattern
from leafflow_ti.errors import ConfigError, InputError
from perf.fuzz.commands import called, command_lines
from perf.fuzz.commands import prepare as prepare_commands
from perf.fuzz.descriptions import texts, use, write_pgm, write_sound
from perf.fuzz.trees import prepare as prepare_trees

IMAGES = '[images]\npath = "a.pgm"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "[" * 100_000, "not valid TOML: maximum recursion"),
        ("a = " + "{a=" * 50_000, "not valid TOML: maximum recursion"),
        ("[images]\n" + ".".join(["a"] * 100_000) + " = 1", r"a key of 32 parts and more \(at line 2\)"),
        ('"a\\"b" . ' * 20_000 + "a = 1", "a key of 32 parts and more"),
        (IMAGES + "shape = { t = " + "9" * 5000 + " }", r"not valid TOML: Exceeds the limit \(4300 digits\)"),
        (IMAGES + "shape = { t = 0x" + "f" * 9000 + " }", r"shape.t = \(int too long to show\): .*less than or equal"),
        (IMAGES + f'channel = "{"x" * 9000}"', r"channel = 'x{70,80} \.\.\.: use one of"),
        (IMAGES + '"a\\nb" = 1', r"\[images\] a b: unknown key"),
        ('[images]\npath = "a\\u0000b"', r"the name holds the character '\\x00': rename"),
        ('[images]\npattern = "a\\nb{t}"', r"the name holds the character '\\n'"),
        (IMAGES + '[time]\nstamps = "a\\u2028"', r"stamps.*the name holds the character '\\u2028'"),
        (f'[images]\npath = "{"a" * 5000}"', "a name of 5000 characters, paths have at most 500"),
        ('[images]\npattern = "{t.__class__}"', r"field '\{t.__class__\}' is unknown"),
        ('[images]\npattern = "{0}"', r"field '\{0\}' is unknown"),
        ('[images]\npattern = "{t:01000000000d}"', "format '01000000000d' of field t must be d or 0Nd with N up to 18"),
        ('[images]\npattern = "{t}{sx}"', "field t is followed by a digit or a field"),
        ('[images]\npattern = "{t}0.tif"', "field t is followed by a digit or a field"),
        (IMAGES + "[camera]\nfocal_length_px = 1e300", "= 1e[+]300: .*less than or equal to 1000000000"),
        (IMAGES + "[camera]\nfocal_length_px = 1e-300", "= 1e-300: .*at least 1e-09"),
    ],
)  # fmt: skip
def test_harmful_descriptions(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "capture.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message) as caught:
        open_capture(tmp_path)
    line = str(caught.value)
    assert line.startswith(f"{tmp_path / 'capture.toml'}: ")
    assert len(line.splitlines()) == 1
    assert len(line) < 500


def test_a_description_has_a_largest_size_and_may_have_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "capture.toml"
    path.write_text("\ufeff" + IMAGES, encoding="utf-8")
    assert read_description(path).images.path == "a.pgm"
    with path.open("ab") as file:
        file.truncate(100 * LARGEST_FILE)
    with pytest.raises(InputError, match="more than 1 MiB, which is too much"):
        read_description(path)


def test_names_match_in_one_way_only(tmp_path: Path) -> None:
    """Whatever the fields, no name is tried with all the ways in which its digits could be shared out."""
    for name in ("1" * 200, "0102003", "12-3", "-5_7", "1_" * 100):
        (tmp_path / name).touch()

    def found(text: str) -> dict[str, dict[str, int]]:
        return {path.name: values for values, path in Pattern.parse(text).discover(Reach(tmp_path))}

    assert found("{sx:02d}{sy:02d}{t:03d}") == {"0102003": {"sx": 1, "sy": 2, "t": 3}}
    assert found("{t}{{x") == {}
    assert found("{t}") == {"0102003": {"t": 102003}}
    assert found("{sx}-{t}") == {"12-3": {"sx": 12, "t": 3}}
    assert found("{sx}_{t}") == {"-5_7": {"sx": -5, "t": 7}}
    assert found("_".join(["{t}"] * 100) + "_x") == {}


def test_two_files_with_far_numbers_cost_nothing(tmp_path: Path) -> None:
    write_pgm(tmp_path / "0_0.pgm", np.zeros((8, 9), np.uint8))
    write_pgm(tmp_path / "3_999999999999999999.pgm", np.zeros((8, 9), np.uint8))
    (tmp_path / "capture.toml").write_text('[images]\npattern = "{sx}_{t}.pgm"\n')
    with pytest.raises(InputError, match=r"2 of 4 images are missing: .*0_999999999999999999\.pgm"):
        open_capture(tmp_path)
    write_pgm(tmp_path / "0_1.pgm", np.zeros((8, 9), np.uint8))
    with pytest.raises(InputError, match=r"1999999999999999997 of 2000000000000000000 images are missing: .*0_2\.pgm"):
        open_capture(tmp_path)


MATRIX = "camera_matrix: [[800, 0, 300], [0, 800, 200], [0, 0, 1]]\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &a [1, 1]\nb: &b [*a, *a]\ncamera_matrix: *b", r"aliases \(\*name\) are not used in calibrations"),
        ("a: " + "[" * 5000, "maximum recursion"),
        ('{"camera_matrix": ' + "[" * 100_000, "maximum recursion"),
        (MATRIX + "image_width: .inf\nimage_height: 2", "image_width or image_height is no whole number"),
        ("camera_matrix: {rows: .inf, cols: 3, data: [1]}", "camera_matrix is no matrix .*infinity"),
        (MATRIX + "distortion_coefficients: [1e300, 0, 0, 0]", r"holds values beyond 1e\+09"),
        ("!!python/object/apply:os.getcwd []", "could not determine a constructor"),
        (MATRIX.replace("800", "0.0"), "focal lengths 0, 0 px: both must be positive"),
        (MATRIX.replace("800", "-800.0"), "focal lengths -800, -800 px: both must be positive"),
        (MATRIX.replace("800", ".nan"), "not finite"),
        ("a: 1\n" * 60_000, r"more than 0\.25 MiB"),
    ],
)  # fmt: skip
def test_harmful_calibrations(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "camera.yml").write_text(text, encoding="utf-8")
    with pytest.raises((InputError, ConfigError), match=message) as caught:
        read_calibration(tmp_path / "camera.yml")
    assert len(str(caught.value).splitlines()) == 1


@settings(max_examples=60, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
@given(content=texts())
def test_any_description(content: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.getbasetemp() / "descriptions"
    if not folder.exists():
        folder.mkdir()
        write_sound(folder)
    (folder / "capture.toml").write_bytes(content)
    assert use(folder, str(folder)) in ("values", "refused")


def test_any_folder(tmp_path: Path) -> None:
    """Also: nothing outside is read, which the trial looks for."""
    (tmp_path / "sound").mkdir()
    trial, outcomes = prepare_trees(tmp_path / "sound"), set()
    for number in range(60):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        outcomes.add(trial(np.random.default_rng(number), folder))
    assert outcomes == {"values", "refused"}


@settings(max_examples=40, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
@given(line=command_lines())
def test_any_command_line(
    line: list[str], tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line of error and an exit code of the contract: the trial sees to it."""
    folder = tmp_path_factory.getbasetemp() / "commands"
    if not folder.exists():
        folder.mkdir()
        prepare_commands(folder)
    monkeypatch.chdir(folder)
    assert called(line).startswith("exit ")
