"""Commands ``run``, ``info`` and ``demo``: options to configuration, what is printed, how they end."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest
import tifffile
from test_cli import call

from leafflow_ti import config, config_sections
from leafflow_ti.cli import main as cli
from leafflow_ti.cli import options
from leafflow_ti.progress import Progress, RunSummary, Timings
from leafflow_ti.results import ResultStore
from leafflow_ti.status import ADVICE, Status


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Nine cameras, 1 frame, a random texture seen with a disparity of -3 px per step."""
    texture = np.random.default_rng(0).integers(0, 255, (48, 120), np.uint8)
    folder = tmp_path / "capture"
    folder.mkdir()
    for sx in range(9):
        left = 30 + 3 * (sx - 4)
        tifffile.imwrite(folder / f"cam_{sx:02d}.tif", texture[:, left : left + 64])
    (folder / "capture.toml").write_text(
        '[images]\npattern = "cam_{sx:02d}.tif"\n[camera]\nfocal_length_px = 600.0\n'
        "[grid]\nbaseline_mm = [5.0, 0.0]\n[time]\ninterval_s = 60.0\n",
        encoding="utf-8",
    )
    return folder


# --- run -------------------------------------------------------------------------------------------------------------


class FakeApi:
    """Stands where ``leafflow_ti.api`` does; remembers what it was asked."""

    def __init__(self) -> None:
        self.settings: config.RunConfig | None = None
        self.resume = self.overwrite = False
        self.error: BaseException | None = None

    def plan_run(self, capture: Any, settings: config.RunConfig) -> SimpleNamespace:
        self.settings = settings
        return SimpleNamespace(describe=lambda: f"plan for {capture.n_cols} cameras")

    def run(
        self,
        capture: Any,
        out: Path,
        settings: config.RunConfig,
        *,
        resume: bool = False,
        verify: bool = False,
        overwrite: bool = False,
        shard: tuple[int, int] | None = None,
        dask: str | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> RunSummary:
        self.settings, self.resume, self.overwrite = settings, resume, overwrite
        if self.error is not None:
            raise self.error
        if progress is not None:
            progress(Progress(1, 1, 48 * 64, 48 * 64, 2.0))
        if not out.exists():
            maps = {"depth": np.full((48, 64), 1000.0, np.float32)}
            shape = (1, 48, 64)
            store = ResultStore.create(
                out,
                frames=[0],
                y=np.arange(48),
                x=np.arange(64),
                names=list(maps),
                chunk=shape,
                attrs={"device": "cpu"},
            )
            store.write_unit(0, 0, slice(0, 48), maps, np.zeros((48, 64), np.uint8))
        return RunSummary(3.0, 1.5, "cpu", {"ok": 3000, "border": 72, "aperture": 0}, {"moments": 1.0}, str(out))


@pytest.fixture
def api(monkeypatch: pytest.MonkeyPatch) -> FakeApi:
    import leafflow_ti

    fake = FakeApi()
    for name in ("api", "runs"):
        monkeypatch.setitem(sys.modules, f"leafflow_ti.{name}", fake)
        monkeypatch.setattr(leafflow_ti, name, fake, raising=False)
    return fake


def test_options_become_the_configuration(api: FakeApi, capture: Path, tmp_path: Path) -> None:
    given = {
        "--preset": "fast", "--model": "depth", "--motion": "translation", "--rows": "2d+b5", "--brightness": "camera",
        "--estimator": "ols", "--solver": "jacobi", "--weighting": "ls", "--window": 33, "--sigma": 7.5, "--stride": 3,
        "--taps": "7", "--prefilter": "homomorphic", "--sigma-pre": 5.5, "--frames": "0:1", "--roi": "1,2,30,40",
        "--mask": "m.tif", "--preshift": "-3,0", "--precision": "f64", "--arch": "cpu", "--max-memory": "1G",
        "--threads": 2, "--deformation": "strain", "--refine": 4, "--refine-window": 41, "--thin": 2,
    }  # fmt: skip
    assert call("run", capture, "--dry-run", *[part for pair in given.items() for part in pair]) == 0
    expected = config.load_config(overrides={key.lstrip("-").replace("-", "_"): v for key, v in given.items()})
    assert api.settings == expected
    assert (expected.preshift, expected.window.stride, expected.plan.max_memory) == ((-3, 0), 3, 2**30)
    changed = expected.model_dump()
    defaults = config.RunConfig().model_dump()
    flat = {
        f"{s}.{n}"
        for s in changed
        if isinstance(changed[s], dict)
        for n in changed[s]
        if changed[s][n] != defaults[s][n]
    }
    flat |= {s for s in changed if not isinstance(changed[s], dict) and changed[s] != defaults[s]}
    assert flat == {config.KEYWORDS[key.lstrip("-").replace("-", "_")] for key in given}  # every option does something


def test_options_win_over_set_over_file(api: FakeApi, capture: Path, tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("[window]\nsize = 33\nstride = 2\nsigma = 5.0\n", encoding="utf-8")
    code = call(
        "run",
        capture,
        "--dry-run",
        "--config",
        file,
        "--set",
        "window.stride=4",
        "--set",
        "window.sigma=6",
        "--sigma",
        7,
    )
    assert code == 0
    assert api.settings is not None
    window = api.settings.window
    assert (window.size, window.stride, window.sigma) == (33, 4, 7.0)


def test_dry_run_prints_the_plan_and_writes_nothing(
    api: FakeApi, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("run", capture, "-o", tmp_path / "out.zarr", "--dry-run") == 0
    assert capsys.readouterr().out == "plan for 9 cameras\n"
    assert not (tmp_path / "out.zarr").exists()


def test_run_reports_and_draws(api: FakeApi, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    out = tmp_path / "out.zarr"
    assert call("run", capture, "-o", out) == 0
    said = capsys.readouterr()
    assert "done in 3 s on cpu (compiling: 1.5 s)" in said.out
    assert f"97.7%  ok             {ADVICE[Status.OK]}" in said.out
    assert f"results: {out}" in said.out
    assert "aperture" not in said.out
    assert said.err == "unit 1/1, 100%, 1.5 kpx/s, 0 s left\n"
    assert (tmp_path / "out-quicklook" / "overview.png").is_file()


def test_quiet_run_without_pictures(
    api: FakeApi, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("run", capture, "-o", tmp_path / "out.zarr", "--no-quicklook", "--quiet", "--overwrite") == 0
    assert capsys.readouterr() == ("", "")
    assert not (tmp_path / "out-quicklook").exists()
    assert (api.resume, api.overwrite) == (False, True)
    assert call("run", capture, "-o", tmp_path / "out.zarr", "--no-quicklook", "--resume") == 0
    assert (api.resume, api.overwrite) == (True, False)


def test_interrupted_run_says_how_to_go_on(
    api: FakeApi, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    api.error = KeyboardInterrupt()
    assert call("run", capture, "-o", tmp_path / "out.zarr") == 130
    assert "--resume" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "code", "part"),
    [
        ([], 2, "-o OUT.zarr"),
        (["-o", "o.zarr", "--resume", "--overwrite"], 2, "exclude each other"),
        (["-o", "o.zarr", "--window", "64"], 3, "window.size = '64'"),
        (["-o", "o.zarr", "--estimator", "best"], 3, "'tls-equilibrated', 'sampson'"),
        (["-o", "o.zarr", "--set", "window.sise=3"], 3, "window.size"),
    ],
)
def test_run_refuses_in_one_line(
    args: list[str], code: int, part: str, api: FakeApi, capture: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("run", capture, *args) == code
    text = capsys.readouterr().err
    assert text.startswith("error: ")
    assert part in text
    assert text.count("\n") == 1
    assert api.settings is None


def test_run_without_capture_exits_with_4_or_3(
    api: FakeApi, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("run", tmp_path / "absent", "-o", tmp_path / "o.zarr") in (3, 4)
    assert "absent" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name",
    [
        "Preset",
        "Motion",
        "Deformation",
        "Brightness",
        "Estimator",
        "Penalty",
        "Robust",
        "Solver",
        "Weighting",
        "Prefilter",
        "Precision",
        "Arch",
    ],
)
def test_choices_in_the_help_are_those_of_the_configuration(name: str) -> None:
    choices = getattr(config_sections, name, None) or getattr(config, name)
    assert get_args(getattr(options, name))[1].metavar == "|".join(get_args(choices))


# --- info ------------------------------------------------------------------------------------------------------------


def test_info_of_a_capture(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("info", capture) == 0
    text = capsys.readouterr().out
    assert "cameras      9 (1 row(s) x 9 column(s))" in text
    assert "frames       1, every 60 s" in text
    assert "9 file(s), 64 x 48 px, 8 bit in uint8" in text
    assert "focal length 600 px, principal point 31.5, 23.5 px" in text
    assert "preshift     -3, 0 px per step" in text
    assert "depth        1000 mm at this preshift; 1 px of disparity is 333.3 mm" in text
    assert "depth range  750 mm to 1500 mm within 1 px" in text


def test_info_of_a_capture_as_json(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("info", capture / "capture.toml", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["grid"] == {"rows": 1, "columns": 9}
    assert facts["working_distance"]["depth_mm"] == pytest.approx(1000.0)
    assert facts["bytes"] == 9 * 64 * 48


def test_info_without_clear_preshift_says_so(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in capture.glob("*.tif"):
        tifffile.imwrite(path, np.full((48, 64), 7, np.uint8))
    assert call("info", capture) == 0
    assert "distance     unknown: " in capsys.readouterr().out


def test_info_of_one_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for t in range(3):
        tifffile.imwrite(tmp_path / f"{t}.tif", np.full((8, 9), t, np.uint16))
    (tmp_path / "capture.toml").write_text('[images]\npattern = "{t}.tif"\n', encoding="utf-8")
    assert call("info", tmp_path) == 0
    assert "not calibrated: optical flow in pixels only" in capsys.readouterr().out


def test_info_of_results(api: FakeApi, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.zarr"
    assert call("run", capture, "-o", out, "--no-quicklook", "-q") == 0
    assert call("info", out) == 0
    text = capsys.readouterr().out
    assert "maps         48 x 64 (y, x), pixels x 0 to 63, y 0 to 47" in text
    assert "units        1 of 1 done" in text
    assert f"100.0%  ok             {ADVICE[Status.OK]}" in text
    assert "\ndevice\n  cpu" in text
    row = next(line for line in text.splitlines() if line.startswith("depth "))
    assert row.split() == ["depth", "mm", "1000", "1000", "1000"]
    assert call("info", out, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["maps"]["depth"] == {"units": "mm", "min": 1000.0, "median": 1000.0, "max": 1000.0}
    assert facts["status"] == {"ok": 48 * 64}


def test_info_tells_what_the_units_have_cost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = ResultStore.create(
        tmp_path / "o.zarr", frames=[0], y=[0, 1], x=[0, 1, 2], names=["depth"], chunk=(1, 1, 3), attrs={}
    )
    first = Timings(2.0, {"compile": 1.0, "solve": 0.5}, 1, 3, 0.5, 1, "cpu")
    second = Timings(4.0, {"solve": 0.25, "write": 2.0}, 1, 3, 0.5, 1, "vulkan")
    store.update_attrs({"timings": (first + second).to_json()})
    assert call("info", tmp_path / "o.zarr") == 0
    text = capsys.readouterr().out
    assert "time         6 s in 2 runs on vulkan: 2 units, 1 px/s" in text
    assert "stages       compile 1 s, solve 0.75 s, write 2 s (" in text
    assert "\ntimings\n" not in text
    assert call("info", tmp_path / "o.zarr", "--json") == 0
    stored = json.loads(capsys.readouterr().out)["attributes"]["timings"]
    assert stored["pixels_per_second"] == 1.0
    assert Timings.of(stored) == first + second


def test_info_of_unfinished_results_advises_to_resume(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ResultStore.create(
        tmp_path / "o.zarr", frames=[0], y=[0, 1], x=[0, 1, 2], names=["depth"], chunk=(1, 1, 3), attrs={}
    )
    assert call("info", tmp_path / "o.zarr") == 0
    text = capsys.readouterr().out
    assert "0 of 2 done: go on with run --resume" in text
    assert "not_computed" in text
    assert call("info", tmp_path / "o.zarr", "--json") == 0
    assert json.loads(capsys.readouterr().out)["maps"]["depth"]["min"] is None


def test_info_of_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("info", tmp_path / "absent") == 4
    assert "does not exist" in capsys.readouterr().err


# --- demo ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("flags", "size"), [([], "400x260"), (["--full"], "301x301")])
def test_demo_prints_what_it_does(
    flags: list[str], size: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    steps: list[list[str]] = []
    real = cli.invoke
    monkeypatch.setattr(cli, "invoke", steps.append)
    real(["demo", str(tmp_path / "d"), *flags])
    printed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("$ leafflow-ti ")]
    assert printed == [f"$ leafflow-ti {' '.join(step)}" for step in steps]
    assert [step[0] for step in steps] == ["simulate", "run", "growth", "evaluate", "export", "report"]
    assert size in steps[0]


def test_demo_spares_a_folder_with_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "precious.txt").write_text("x")
    assert call("demo", tmp_path) == 2
    assert "is not empty" in capsys.readouterr().err
