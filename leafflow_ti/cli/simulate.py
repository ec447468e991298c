"""``simulate``: synthetic captures with their exact truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from leafflow_ti.cli.progress import counted
from leafflow_ti.cli.scene_fields import FIELDS, numbers

if TYPE_CHECKING:
    from leafflow_ti.synthetic.scene import Scene

app = typer.Typer(
    name="simulate",
    help="Write a synthetic capture (capture.toml, TIFF images) with its exact truth (truth.npz).",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)


def _option(name: str, metavar: str, help: str) -> Any:
    return typer.Option(f"--{name}", metavar=metavar, help=help, show_default=False)


Folder = Annotated[Path, typer.Argument(metavar="OUTDIR", help="Folder to create.")]
Cameras = Annotated[int | None, _option("cameras", "N", "Cameras along x [9].")]
Rows = Annotated[int | None, _option("rows", "N", "Rows of cameras, along y [1].")]
Frames = Annotated[int | None, _option("frames", "N", "Frames [9].")]
Size = Annotated[str, _option("size", "WxH", "Image size in pixels [301x301].")]
Noise = Annotated[float | None, _option("noise", "GREY", "Standard deviation of noise, in grey values of 8 bits [0].")]
Seed = Annotated[int | None, _option("seed", "N", "Seed of the noise [0].")]
Bits = Annotated[str, _option("bits", "8|10|12|14|16|float", "Depth of the images; grey values scale with it [8].")]
Interval = Annotated[float | None, _option("interval-s", "SECONDS", "Time between frames [not stated].")]
Focal = Annotated[float | None, _option("focal-px", "PX", "Focal length in pixels [plane 2727.27, cube 2800].")]
Principal = Annotated[str | None, _option("principal-px", "X,Y", "Principal point in pixels [image centre].")]
Baseline = Annotated[str | None, _option("baseline-mm", "X[,Y]", "Camera step in mm [plane 0.5, cube 5].")]
Centre = Annotated[
    str | None, _option("centre-mm", "X,Y", "Centre of the object at the middle frame, mm [plane 0,0, cube 18.3,0].")
]
Depth = Annotated[float | None, _option("depth-mm", "Z", "Depth of that centre, mm [plane 100, cube 1038.3].")]
Velocity = Annotated[
    str | None,
    _option("velocity", "X,Y,Z", "Velocity of the rotation centre, mm/frame [plane .0073,-.0037,.06, cube -.2,0,-1]."),
]
Omega = Annotated[
    str | None,
    _option("omega-deg", "X,Y,Z", "Rotation, axis times degrees per frame [plane .003 about (2,3,2), cube 0,.4,0]."),
]
Pivot = Annotated[str | None, _option("rotation-centre-mm", "X,Y,Z", "Rotation centre, mm [centre of the object].")]
Acceleration = Annotated[str | None, _option("acceleration", "X,Y,Z", "Acceleration of that point, mm/frame² [0,0,0].")]
TextureSeed = Annotated[int | None, _option("texture-seed", "N", "Seed of a noise texture [1].")]
Brightness = Annotated[
    list[str] | None,
    _option(
        "brightness",
        "AXIS,POWER,G[,GX,GY]",
        "Term (G + GX X + GY Y) AXIS^POWER of the logarithm of the brightness: AXIS is t (frames), sx or sy (mm); "
        "X, Y are mm from the centre. May be repeated.",
    ),
]
Offset = Annotated[float | None, _option("offset", "GREY", "Mean grey value, of 8 bits [plane 100, cube 120].")]


@app.command("plane", short_help="A moving plane with a cosine or noise texture.", no_args_is_help=False)
def plane(
    context: typer.Context,
    folder: Folder,
    cameras: Cameras = None,
    rows: Rows = None,
    frames: Frames = None,
    size: Size = "301x301",
    noise: Noise = None,
    seed: Seed = None,
    bits: Bits = "8",
    interval_s: Interval = None,
    focal_px: Focal = None,
    principal_px: Principal = None,
    baseline_mm: Baseline = None,
    centre_mm: Centre = None,
    depth_mm: Depth = None,
    slope_x: Annotated[float | None, _option("slope-x", "ZX", "Slope dZ/dX [0.6].")] = None,
    slope_y: Annotated[float | None, _option("slope-y", "ZY", "Slope dZ/dY [-0.5].")] = None,
    velocity: Velocity = None,
    omega_deg: Omega = None,
    rotation_centre_mm: Pivot = None,
    acceleration: Acceleration = None,
    offset: Offset = None,
    texture: Annotated[
        str | None,
        _option("texture", "waves|noise", "A product of two cosines, or noise that does not repeat [waves]."),
    ] = None,
    texture_seed: TextureSeed = None,
    supersampling: Annotated[
        int | None, _option("supersampling", "N", "Rays per pixel: N x N [waves 1, noise 4].")
    ] = None,
    amplitude: Annotated[
        float | None, _option("amplitude", "GREY", "Amplitude of waves [50], standard deviation of noise [25].")
    ] = None,
    wavelength_mm: Annotated[
        str | None,
        _option("wavelength-mm", "L1[,L2]", "Wavelengths of both cosines [0.3], or range of the noise [0.25,1], mm."),
    ] = None,
    alpha_deg: Annotated[
        float | None, _option("alpha-deg", "DEG", "Turns the texture, or its first cosine, in the plane [0].")
    ] = None,
    beta_deg: Annotated[float | None, _option("beta-deg", "DEG", "Turns the second cosine [as --alpha-deg].")] = None,
    brightness: Brightness = None,
    growth: Annotated[
        float | None, _option("growth", "PERCENT", "Growth of its area about the centre, %/frame [0].")
    ] = None,
    strain: Annotated[
        str | None,
        _option(
            "strain",
            "11,22,12",
            "Strain rates of its lengths about the centre, %/frame, beside --growth; axis 1 lies in the plane above X "
            "[0,0,0].",
        ),
    ] = None,
) -> None:
    """A moving plane with a cosine or noise texture; by default the sinusoid of Schuchert 2010, section 5.3."""
    from leafflow_ti.synthetic.plane import noise_scene, sinusoid_scene

    _write(noise_scene() if texture == "noise" else sinusoid_scene(), context)


@app.command("cube", short_help="A textured box that turns and moves.", no_args_is_help=False)
def cube(
    context: typer.Context,
    folder: Folder,
    cameras: Cameras = None,
    rows: Rows = None,
    frames: Frames = None,
    size: Size = "301x301",
    noise: Noise = None,
    seed: Seed = None,
    bits: Bits = "8",
    interval_s: Interval = None,
    focal_px: Focal = None,
    principal_px: Principal = None,
    baseline_mm: Baseline = None,
    centre_mm: Centre = None,
    depth_mm: Depth = None,
    edges_mm: Annotated[str | None, _option("edges-mm", "X,Y,Z", "Edges of the box, mm [100,100,100].")] = None,
    orientation_deg: Annotated[
        str | None,
        _option("orientation-deg", "X,Y,Z", "Turn of the box at the middle frame, axis times deg [0,-30,0]."),
    ] = None,
    velocity: Velocity = None,
    omega_deg: Omega = None,
    rotation_centre_mm: Pivot = None,
    acceleration: Acceleration = None,
    offset: Offset = None,
    contrast: Annotated[float | None, _option("contrast", "GREY", "Standard deviation of the texture [27].")] = None,
    background: Annotated[float | None, _option("background", "GREY", "Grey value beside the box [20].")] = None,
    wavelength_mm: Annotated[
        str | None, _option("wavelength-mm", "MIN,MAX", "Wavelengths of the texture, mm [2.2,8].")
    ] = None,
    texture_seed: TextureSeed = None,
    supersampling: Annotated[int | None, _option("supersampling", "N", "Rays per pixel: N x N [4].")] = None,
    light: Annotated[
        str | None,
        _option("light", "ambient|spot|spot-camera", "None but ambient, a fixed spot, one on the camera [ambient]."),
    ] = None,
    light_mm: Annotated[
        str | None, _option("light-mm", "X,Y,Z", "Place of the spot (spot-camera: from the camera), mm [-150,-100,0].")
    ] = None,
    light_target_mm: Annotated[
        str | None, _option("light-target-mm", "X,Y,Z", "What the spot is aimed at, likewise, mm [0,0,1000].")
    ] = None,
    light_cone_deg: Annotated[
        float | None, _option("light-cone-deg", "DEG", "Standard deviation of the Gaussian cone of light [4].")
    ] = None,
    ambient_share: Annotated[
        float | None, _option("ambient-share", "0..1", "Share of the light that has no direction [0.2].")
    ] = None,
) -> None:
    """A textured box seen on an edge, turning; by default the cube of Schuchert 2010, section 5.3.2.

    truth.npz labels its faces: 1 left, 2 right, 0 beside the box.
    """
    from leafflow_ti.synthetic.cube import CubeScene

    _write(CubeScene(), context)


@app.command("leaf", short_help="A curved leaf that grows, moves and tilts.", no_args_is_help=False)
def leaf(
    context: typer.Context,
    folder: Folder,
    cameras: Cameras = None,
    rows: Rows = None,
    frames: Frames = None,
    size: Annotated[str, _option("size", "WxH", "Image size in pixels [481x321].")] = "481x321",
    noise: Noise = None,
    seed: Seed = None,
    bits: Bits = "8",
    interval_s: Interval = None,
    focal_px: Annotated[float | None, _option("focal-px", "PX", "Focal length in pixels [5681.8].")] = None,
    principal_px: Principal = None,
    baseline_mm: Annotated[str | None, _option("baseline-mm", "X[,Y]", "Camera step in mm [1].")] = None,
    centre_mm: Annotated[
        str | None, _option("centre-mm", "X,Y", "Centre of the leaf at the middle frame, mm [0,0].")
    ] = None,
    depth_mm: Annotated[float | None, _option("depth-mm", "Z", "Depth of that centre, mm [250].")] = None,
    slope_x: Annotated[float | None, _option("slope-x", "ZX", "Slope dZ/dX at the centre [0.3].")] = None,
    slope_y: Annotated[float | None, _option("slope-y", "ZY", "Slope dZ/dY at the centre [-0.2].")] = None,
    turn_deg: Annotated[
        float | None, _option("turn-deg", "DEG", "Direction of the long axis in the leaf, from above X [23].")
    ] = None,
    curvature: Annotated[
        str | None,
        _option("curvature", "ALONG,ACROSS[,TWIST]", "Curvatures along both axes and between, 1/mm [-.012,.025,.006]."),
    ] = None,
    half_mm: Annotated[str | None, _option("half-mm", "L[,W]", "Half the length and the width, mm [5.6,4].")] = None,
    pointed: Annotated[
        bool | None, _option("pointed/--ellipse", "", "Outline with tips at both ends, or without [ellipse].")
    ] = None,
    velocity: Annotated[
        str | None, _option("velocity", "X,Y,Z", "Velocity of the rotation centre, mm/frame [.04,-.03,.05].")
    ] = None,
    omega_deg: Annotated[
        str | None, _option("omega-deg", "X,Y,Z", "Rotation, axis times degrees per frame [.14,.22,.14].")
    ] = None,
    rotation_centre_mm: Pivot = None,
    acceleration: Acceleration = None,
    leaf_growth: Annotated[
        str | None,
        _option(
            "growth",
            "AREA|ALONG,ACROSS",
            "Growth of the area, alike in all directions, or of lengths along the long axis and across, %/frame [.1].",
        ),
    ] = None,
    brightness: Brightness = None,
    offset: Annotated[float | None, _option("offset", "GREY", "Mean grey value, of 8 bits [120].")] = None,
    contrast: Annotated[float | None, _option("contrast", "GREY", "Standard deviation of the texture [27].")] = None,
    background: Annotated[float | None, _option("background", "GREY", "Grey value beside the leaf [20].")] = None,
    wavelength_mm: Annotated[
        str | None, _option("wavelength-mm", "MIN,MAX", "Wavelengths of the texture, mm [.3,1.2].")
    ] = None,
    texture_seed: TextureSeed = None,
    supersampling: Annotated[int | None, _option("supersampling", "N", "Rays per pixel: N x N [4].")] = None,
) -> None:
    """A curved leaf that grows while it moves, tilts and changes its brightness.

    truth.npz labels it as region 1; labels.tif is the same as an image.
    """
    from leafflow_ti.synthetic.leaf import LeafScene

    _write(LeafScene(), context)


@app.command("leaves", short_help="Leaves at several depths over a ground, each moving.", no_args_is_help=False)
def leaves(
    context: typer.Context,
    folder: Folder,
    cameras: Cameras = None,
    rows: Rows = None,
    frames: Frames = None,
    size: Annotated[str, _option("size", "WxH", "Image size in pixels [401x301].")] = "401x301",
    noise: Noise = None,
    seed: Seed = None,
    bits: Bits = "8",
    interval_s: Interval = None,
    focal_px: Annotated[float | None, _option("focal-px", "PX", "Focal length in pixels [1200].")] = None,
    principal_px: Principal = None,
    baseline_mm: Annotated[str | None, _option("baseline-mm", "X[,Y]", "Camera step in mm [5].")] = None,
    leaves: Annotated[int | None, _option("leaves", "N", "Leaves, 1 to 20 [5].")] = None,
    disparity_px: Annotated[
        str | None,
        _option(
            "disparity-px", "MIN,MAX", "Size of the disparity of the ground and of the nearest leaf, px/step [3,30]."
        ),
    ] = None,
    motion_px: Annotated[
        float | None, _option("motion-px", "PX", "Motion of the fastest leaf's centre, px/frame [8].")
    ] = None,
    light_change: Annotated[
        str | None,
        _option(
            "light-change",
            "G,GX,GY",
            "Growth of the logarithm of the light, G + GX X/Z + GY Y/Z per frame [.01,.06,-.03].",
        ),
    ] = None,
    offset: Annotated[float | None, _option("offset", "GREY", "Mean grey value, of 8 bits [110].")] = None,
    contrast: Annotated[float | None, _option("contrast", "GREY", "Standard deviation of the textures [26].")] = None,
    wavelength_px: Annotated[
        str | None, _option("wavelength-px", "MIN,MAX", "Wavelengths of the textures in the middle image, px [5,24].")
    ] = None,
    layout_seed: Annotated[
        int | None, _option("layout-seed", "N", "Seed of the leaves and their textures [1].")
    ] = None,
    supersampling: Annotated[int | None, _option("supersampling", "N", "Rays per pixel: N x N [2].")] = None,
) -> None:
    """Tilted leaves at several depths that hide each other and the ground, each with its own motion, in changing light.

    truth.npz labels them: 0 the ground, leaves from 1, farthest first.
    """
    from leafflow_ti.synthetic.leaves import LeavesScene

    _write(LeavesScene(), context)


def _write(default: Scene, context: typer.Context) -> None:
    """Write the scene ``default``, changed by the options that were given."""
    from leafflow_ti.synthetic.write import write_scene

    flags = {str(option.name): option.opts[0] for option in context.command.params}
    given = {name: value for name, value in context.params.items() if value not in (None, [], ())}
    changes = {FIELDS[name][0]: FIELDS[name][1](flags[name], given[name]) for name in given if name in FIELDS}
    if "centre_mm" in given or "depth_mm" in given:
        changes["centre"] = _centre(default, given)
    scene = replace(default, **changes)
    folder: Path = given["folder"]
    write_scene(scene, folder, given.get("interval_s"), counted("image"))
    typer.echo(
        f"{folder}: {scene.n_frames} frames of {scene.n_rows} x {scene.n_cols} cameras (rows x columns), "
        f"{scene.size[0]} x {scene.size[1]} px, {scene.bits or 'float'}{' bits' if scene.bits else ''}; "
        f"capture.toml, truth.npz (frame {scene.reference_frame})"
    )
    shift = _whole_disparity(scene)
    if any(shift):
        # Periodic textures hide it from a search.
        typer.echo(f"disparity at the centre in whole pixels: --preshift {shift[0]},{shift[1]}")


def _centre(default: Scene, given: Mapping[str, Any]) -> tuple[float, float, float]:
    """The centre of the scene's one object, changed by the options that were given."""
    x, y, z = default.centre  # type: ignore[union-attr]  # scenes without have no such options
    if "centre_mm" in given:
        x, y = numbers(2)("--centre-mm", given["centre_mm"])
    return x, y, given.get("depth_mm", z)


def _whole_disparity(scene: Scene) -> tuple[int, int]:
    """Disparity (x, y) [px/step] of the centre of the scene's one object; 0 if it has several."""
    centre = getattr(scene, "centre", None)
    if centre is None:
        return 0, 0
    counts = (scene.n_cols, scene.n_rows)
    nx, ny = (round(-scene.f_px * b / centre[2]) * (n > 1) for b, n in zip(scene.baseline_mm, counts, strict=True))
    return nx, ny
