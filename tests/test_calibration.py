"""Calibration files and rectified images: formats, OpenCV's numbers, sub-pixel accuracy, tiles, refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

import leafflow_ti as lf
from leafflow_ti.capture import Capture, Geometry, capture_from_array, open_capture
from leafflow_ti.capture.calibration import Calibration, read_calibration
from leafflow_ti.capture.lens import Lens
from leafflow_ti.errors import ConfigError, InputError, LeafflowError
from leafflow_ti.synthetic.plane import PlaneScene
from leafflow_ti.synthetic.plane import truth as plane_truth

MATRIX = [[820.0, 0.0, 322.5], [0.0, 815.0, 241.25], [0.0, 0.0, 1.0]]
COEFFICIENTS = [-.31, .12, .0012, -.0009, -.02, .05, .03, -.01, .002, -.001, .0015, .0005, .01, -.02]  # fmt: skip
TURN = [  # rotation vector (.02, -.03, .01), as OpenCV writes it
    [0.99950005833061117, -0.010297631831627843, -0.029893012156105903],
    [0.0096977018283612697, 0.99975002916530564, -0.020145316160805754],
    [0.030092988823861425, 0.019845351159172471, 0.99935007582979452],
]
PROJECTION = [[800.0, 0.0, 319.5, 0.0], [0.0, 800.0, 239.5, 0.0], [0.0, 0.0, 1.0, 0.0]]
PLACES = ((0, 0), (639, 0), (100, 400), (320, 240), (639, 479))
OPENCV = {
    # What projectPoints of OpenCV 5.0.0 gives for the rays of PLACES in the rectified image, by number of coefficients.
    4: [(40.204775285, 33.885118634), (647.714834209, 26.4047908), (130.654617706, 417.03654746),
        (347.698816017, 257.933507283), (653.954741847, 481.840997622)],
    5: [(40.257930397, 33.924223917), (647.582852848, 26.492033899), (130.659568124, 417.032012267),
        (347.698816016, 257.933507282), (653.765586769, 481.703953165)],
    8: [(43.477195468, 36.292580787), (642.700713182, 29.719254704), (131.749643582, 416.033368766),
        (347.697095367, 257.93236822), (648.149878567, 477.635324992)],
    12: [(43.781481734, 36.56303769), (643.078536508, 30.072798541), (131.916820651, 416.169812888),
         (347.699331738, 257.934037168), (648.564597242, 478.034314621)],
    14: [(46.297406709, 38.386221922), (644.828182962, 29.016160424), (132.354611727, 415.704028481),
         (347.725043093, 257.953569107), (652.210369867, 480.711454989)],
}  # fmt: skip

YAML = """%YAML:1.0
---
calibration_time: "Tue 01 Jan"
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 820., 0., 322.5, 0., 815., 241.25, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.31, 1.2e-01, 0.0012, -9e-04, -0.02 ]
"""
XML = """<?xml version="1.0"?>
<opencv_storage>
<!-- made by hand -->
<calibration_time>"Tue 01 Jan"</calibration_time>
<image_width>640</image_width>
<image_height>480</image_height>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
  <data>
    820. 0. 322.5 0. 815. 241.25 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>5</rows><cols>1</cols><dt>d</dt>
  <data>-0.31 0.12 0.0012
    -9e-04 -0.02</data></distortion_coefficients>
</opencv_storage>
"""
CAMERA_INFO = """image_width: 640
image_height: 480
camera_name: left
camera_matrix: {rows: 3, cols: 3, data: [820, 0, 322.5, 0, 815, 241.25, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.31, 0.12, 0.0012, -0.0009, -0.02]}
"""


def _json(**changes: object) -> str:
    values = {"image_width": 640, "image_height": 480, "camera_matrix": MATRIX,
              "distortion_coefficients": COEFFICIENTS[:5]}  # fmt: skip
    values |= changes
    return json.dumps({key: value for key, value in values.items() if value is not None})


def _calibration(folder: Path, text: str) -> Calibration:
    (folder / "camera.txt").write_text(text, encoding="utf-8")
    return read_calibration(folder / "camera.txt")


@pytest.mark.parametrize("text", [YAML, YAML.replace("%YAML:1.0", "%YAML 1.2"), XML, CAMERA_INFO, _json()])
def test_every_notation(tmp_path: Path, text: str) -> None:
    found = _calibration(tmp_path, text)
    np.testing.assert_array_equal(found.matrix, MATRIX)
    np.testing.assert_array_equal(found.distortion, [*COEFFICIENTS[:5], *[0.0] * 9])
    np.testing.assert_array_equal(found.rotation, np.eye(3))
    assert found.size == (640, 480)
    assert found.pinhole == (817.5, 322.5, 241.25)


@pytest.mark.parametrize("count", OPENCV)
def test_places_are_those_of_opencv(tmp_path: Path, count: int) -> None:
    text = _json(distortion_coefficients=COEFFICIENTS[:count], rectification_matrix=TURN, projection_matrix=PROJECTION)
    calibration = _calibration(tmp_path, text)
    assert calibration.pinhole == (800.0, 319.5, 239.5)
    u, v = np.array(PLACES, float).T
    found = np.stack(Lens(calibration, 800.0, (319.5, 239.5)).source(u, v), axis=1)
    np.testing.assert_allclose(found, OPENCV[count], atol=1e-8)  # printed with nine digits behind the point


def _lens(distortion: list[float], f: float = 300.0, size: tuple[int, int] = (160, 120), **changes: object) -> Lens:
    centre = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    matrix = np.array([[1.01 * f, 0, centre[0] + 1.3], [0, 0.99 * f, centre[1] - 0.7], [0, 0, 1]])
    found = Calibration(
        Path("none"), matrix, np.array([*distortion, *[0.0] * (14 - len(distortion))]), np.eye(3), None, None
    )
    return Lens(replace(found, **changes), f, centre)


def _undistorted(lens: Lens, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Rectified places [H, W] of the pixels of the stored image, by fixed-point iteration."""
    x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    u, v = x.copy(), y.copy()
    for _ in range(60):
        xs, ys = lens.source(u, v)
        u, v = u + (x - xs), v + (y - ys)
    np.testing.assert_allclose(np.stack(lens.source(u, v)), [x, y], atol=1e-9)
    return u, v


def _stored(image: np.ndarray) -> object:
    return lambda y0, y1, x0, x1: image[y0:y1, x0:x1]


BARREL = [-0.25, 0.08, 0.001, -0.0015, 0.01]


@pytest.mark.parametrize(("wavelength", "error"), [(4.0, 3e-3), (6.0, 2e-4), (8.0, 4e-5), (16.0, 1e-6)])
def test_a_texture_is_moved_to_a_ten_thousandth_of_a_pixel(wavelength: float, error: float) -> None:
    """Errors of a quintic spline, ``2 (λ - 1)^-6`` of the amplitude in each direction; linear interpolation has
    1 - cos(π/λ), .3 to .02."""
    size = (160, 120)
    lens = _lens(BARREL, size=size)

    def texture(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        k = 2 * np.pi / wavelength
        return 100 + 50 * np.sin(k * (0.8 * u + 0.6 * v)) * np.cos(0.3 * k * v)

    image = texture(*_undistorted(lens, size))
    out = np.zeros((size[1], size[0]))
    lens.rectify(out, 0, 0, (size[1], size[0]), _stored(image))
    inner = out[16:-16, 16:-16]  # mirroring at the border disturbs the spline some pixels around it
    wanted = texture(*np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float)))[16:-16, 16:-16]
    assert np.isfinite(inner).all()
    assert np.abs(inner - wanted).max() / 50 < error


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("holes", [False, True])
def test_windows_equal_the_whole(dtype: type, holes: bool) -> None:
    size = (160, 120)
    lens = _lens(COEFFICIENTS, size=size, rotation=np.array(TURN))
    image = np.random.default_rng(0).normal(100, 20, (size[1], size[0]))
    if holes:
        image[np.random.default_rng(1).random(image.shape) < 0.002] = np.nan
    whole = np.zeros(image.shape, dtype)
    lens.rectify(whole, 0, 0, image.shape, _stored(image))
    assert 0 < np.isnan(whole).mean() < 0.9
    for top, left, rows, cols in ((0, 0, 17, 160), (40, 90, 31, 70), (119, 0, 1, 160), (7, 3, 1, 1), (0, 159, 120, 1)):
        out = np.zeros((rows, cols), dtype)
        lens.rectify(out, top, left, image.shape, _stored(image))
        np.testing.assert_array_equal(out, whole[top : top + rows, left : left + cols])


def test_a_lens_without_distortion_gives_the_image_back() -> None:
    image = np.random.default_rng(0).normal(100, 20, (50, 60))
    lens = _lens([], size=(60, 50))
    lens = replace(
        lens, calibration=replace(lens.calibration, matrix=np.array([[300, 0, 29.5], [0, 300, 24.5], [0, 0, 1.0]]))
    )
    out = np.zeros(image.shape)
    lens.rectify(out, 0, 0, image.shape, _stored(image))
    np.testing.assert_allclose(out, image, atol=1e-3)  # taps below 1e-7 of the first are left out


def test_one_pixel_that_is_not_finite_costs_its_neighbourhood_only() -> None:
    image = np.random.default_rng(0).normal(100, 20, (120, 160))
    lens, out, other = _lens(BARREL), np.zeros((2, 120, 160)), image.copy()
    other[60, 80] = np.inf
    lens.rectify(out[0], 0, 0, image.shape, _stored(image))
    lens.rectify(out[1], 0, 0, image.shape, _stored(other))
    lost = np.isnan(out[1]) & ~np.isnan(out[0])
    assert 100 < lost.sum() < 150  # 11 x 11
    # White noise of 20: its neighbours' mean is off by 20, of which the spline hands on .43^6 five pixels away.
    assert np.nanmax(np.abs(out[1] - out[0])) < 1.0


def test_rays_beyond_the_model_are_not_seen() -> None:
    """Where a polynomial bends back, it would show the middle of the image once more, at its edge."""
    lens = _lens([-0.5], f=60.0)
    u = np.arange(80.0, 400.0)
    x, _ = lens.source(u, np.full_like(u, 59.5))
    seen = np.isfinite(x)
    assert seen[0]
    assert not seen[-1]
    assert (np.diff(x[seen]) > 0).all()
    turned = replace(lens, calibration=replace(lens.calibration, rotation=np.diag([-1.0, 1.0, -1.0])))
    assert np.isnan(turned.source(u, np.full_like(u, 59.5))[0]).all()


def _distorted_row(scene: PlaneScene, lenses: list[Lens]) -> np.ndarray:
    """Images [1, 1, sx, y, x] of a row of real cameras before a plane."""
    images = []
    for k, lens in enumerate(lenses):
        u, v = _undistorted(lens, scene.size)
        rays = np.stack(
            [(u - lens.principal_px[0]) / lens.f_px, (v - lens.principal_px[1]) / lens.f_px, np.ones_like(u)], -1
        )
        points = scene.intersect(rays, scene.camera_position(0, k), 0.0)
        images.append(scene.albedo(scene.material(points, 0.0)))
    return np.array(images)[None, None]


def test_depth_from_distorted_cameras() -> None:
    """Five lenses that differ by some pixels: depth as from ideal cameras; without the calibration it is off."""
    scene = PlaneScene(
        f_px=300.0, baseline_mm=(0.5, 0.5), n_cols=5, n_frames=1, size=(160, 120), centre=(0.0, 0.0, 100.0), zx=0.2,
        zy=-0.1, wavelengths_mm=(2.7, 3.3),
    )  # fmt: skip
    lenses = [_lens([-0.25 + 0.05 * k, 0.08 - 0.02 * k, 0.001 * k, -0.0015]) for k in range(5)]
    plain = capture_from_array(_distorted_row(scene, lenses), Geometry(300.0, scene.principal, (0.5, 0.0)))
    rectified = replace(plain, lenses=(tuple(lenses),))
    wanted = plane_truth(scene)["depth"]
    errors = {}
    for name, capture in (("plain", plain), ("rectified", rectified)):
        field = lf.estimate(capture, model="depth", window=33, preshift=(-1, 0), stride=4)
        error = field["depth"] - wanted[np.ix_(field.y, field.x)]
        errors[name] = float(np.sqrt(np.nanmean(error**2)))
        assert np.isfinite(error).sum() > 100
    assert errors["rectified"] < 0.02  # of 100 mm: the model's own error on the tilted plane
    assert errors["plain"] > 1.0


CAPTURE = '[images]\npattern = "cam{sx}.tif"\n[camera]\ncalibration = "%s"\n%s[grid]\nbaseline_mm = 1.0\n'


def _capture(folder: Path, name: str, extra: str = "") -> Capture:
    for sx in (3, 4, 5):
        tifffile.imwrite(folder / f"cam{sx}.tif", np.random.default_rng(sx).integers(0, 255, (480, 640), np.uint8))
    (folder / "capture.toml").write_text(CAPTURE % (name, extra), encoding="utf-8")
    return open_capture(folder)


def test_a_capture_with_one_file(tmp_path: Path) -> None:
    (tmp_path / "camera.yml").write_text(YAML)
    capture = _capture(tmp_path, "camera.yml", "focal_length_px = 817.5\n")
    assert capture.geometry is not None
    assert (capture.geometry.f_px, capture.geometry.principal_px) == (817.5, (322.5, 241.25))
    assert not capture.finite
    whole = capture.read(0, 0, 1, 0, 480, 0, 640)
    part = capture.read(0, 0, 1, -5, 40, 600, 650)
    np.testing.assert_array_equal(part[5:, :40], whole[:40, 600:])
    assert (part[:5] == 0).all()
    before = capture.fingerprint()
    (tmp_path / "camera.yml").write_text(YAML.replace("-0.31", "-0.30"))
    assert open_capture(tmp_path).fingerprint() != before


def test_a_capture_with_a_file_for_each_camera(tmp_path: Path) -> None:
    for sx in (3, 4, 5):
        matrix = [[810.0 + sx, 0, 320.0], [0, 810.0 + sx, 240.0 + sx], [0, 0, 1]]
        (tmp_path / f"lens_{sx:02d}.json").write_text(_json(camera_matrix=matrix))
    capture = _capture(tmp_path, "lens_{sx:02d}.json")
    assert capture.geometry is not None
    assert (capture.geometry.f_px, capture.geometry.principal_px) == (814.0, (320.0, 244.0))
    assert capture.lenses is not None
    assert [lens.calibration.matrix[1, 2] for lens in capture.lenses[0]] == [243.0, 244.0, 245.0]


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("{", InputError, "not a calibration in YAML, XML or JSON"),
        ("camera_matrix: [1, 2", InputError, "not a calibration"),
        ("<opencv_storage><camera_matrix>", InputError, "not a calibration"),
        ('<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', InputError, "document type or entities"),
        ("just words", InputError, "holds no keys"),
        (_json(camera_matrix=None), ConfigError, "camera_matrix is missing, found image_width"),
        (_json(camera_matrix=[[1, 2], [3, 4]]), ConfigError, "camera_matrix is 2 x 2, it must be 3 x 3"),
        (_json(camera_matrix={"rows": 3, "cols": 3, "data": [1.0]}), ConfigError, "camera_matrix is no matrix"),
        (_json(camera_matrix="none"), ConfigError, "camera_matrix is no matrix"),
        (_json(camera_matrix=[[0, 0, 1], [0, 5, 1], [0, 0, 1]]), ConfigError, "singular or mirrored"),
        (_json(camera_matrix=[[5, 1, 1], [0, 5, 1], [0, 0, 1]]), ConfigError, "skewed pixels are not supported"),
        (_json(distortion_coefficients=[0.1] * 6), ConfigError, "are 6, OpenCV's are 4, 5, 8, 12 or 14"),
        (_json(distortion_coefficients=[0.1, 0.2, 0.3, float("nan")]), ConfigError, "not finite"),
        (_json(fisheye_model=1), ConfigError, "lens model 'fisheye' is not supported"),
        (_json(distortion_model="equidistant"), ConfigError, "lens model 'equidistant' is not supported"),
        (_json(rectification_matrix=[[1, 0, 0], [0, 2, 0], [0, 0, 1]]), ConfigError, "is no rotation"),
        (
            _json(projection_matrix=[[800, 0, 1], [0, 801, 1], [0, 0, 1]]),
            ConfigError,
            "rectified pixels must be square",
        ),
        (_json(image_width=641), ConfigError, "made for images of 641 x 480 px, these have 640 x 480"),
        (_json(image_width="wide"), ConfigError, "is no whole number"),
    ],
)
def test_bad_files_are_one_clear_line(tmp_path: Path, text: str, kind: type[LeafflowError], message: str) -> None:
    (tmp_path / "camera.txt").write_text(text)
    with pytest.raises(kind, match=message) as caught:
        _capture(tmp_path, "camera.txt")
    assert "camera.txt" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_contradictions_and_absent_files(tmp_path: Path) -> None:
    (tmp_path / "camera.yml").write_text(YAML)
    with pytest.raises(ConfigError, match=r"focal length is 820 px, the calibration says 817\.5: leave it out"):
        _capture(tmp_path, "camera.yml", "focal_length_px = 820.0\n")
    with pytest.raises(ConfigError, match="principal point along y is 240 px"):
        _capture(tmp_path, "camera.yml", "principal_point_px = [322.5, 240.0]\n")
    with pytest.raises(InputError, match=r"camera_3\.yml: cannot be read .*: check \[camera\] calibration"):
        _capture(tmp_path, "camera_{sx}.yml")
    with pytest.raises(ConfigError, match=r"field '\{t\}': one file for all cameras, or the fields sx and sy"):
        _capture(tmp_path, "camera_{t}.yml")
    for sx in (3, 4, 5):
        (tmp_path / f"p{sx}.json").write_text(_json(projection_matrix=[[800 + sx, 0, 1], [0, 800 + sx, 1], [0, 0, 1]]))
    with pytest.raises(ConfigError, match=r"p4\.json: projection_matrix is not that of .*p3\.json"):
        _capture(tmp_path, "p{sx}.json")
