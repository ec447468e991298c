"""muDIC and pyvale on three images of a specimen: a script of its own, for any interpreter that has them.

    python perf/strain_programs.py PROGRAM SETTINGS IMAGES.npz OUT.npz

``IMAGES``: ``images`` [3, y, x], 8 bit. ``SETTINGS``: a JSON object, see ``mudic`` and ``pyvale``. ``OUT``: ``x``,
``y`` [n] px of the measured points in the second image; ``displacement`` [n, 2] px (x, y) and ``rate`` [n, 2, 2] its
gradient (rows: component, columns: derivative), half of what changes from the first image to the third, the second one
being the reference; ``total`` [m, 2, 2]: the gradient from the first image, as the reference, to the third;
``seconds``: of the first of these two analyses, without imports. Exit code 3: the program is not installed.
"""

from __future__ import annotations

import json
import logging
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

PAD = 12
"""Pixels between muDIC's mesh and the border of the image: it cuts out elements with 10 more on each side."""


def mudic(images: Any, element: int, sigma: float = 0.0) -> dict[str, Any]:
    """Bilinear elements of ``element`` px, as many as there is room for, images smoothed with ``sigma`` px (0: as they
    are), the rest at its defaults. Gradients and displacements in the middles of the elements."""
    import muDIC as dic

    logging.disable(logging.INFO)
    height, width = images.shape[1:]
    across, down = ((n - 2 * PAD) // element for n in (width, height))
    left, top = ((n - count * element) // 2 for n, count in ((width, across), (height, down)))

    def analysed(order: list[int]) -> tuple[Any, Any]:
        """Gradients [2, 2, across, down, images] and coordinates [2, ...] of elements; the first image is
        the reference."""
        stack = dic.image_stack_from_list([images[k].astype(float) for k in order])
        if sigma:
            stack.set_filter(dic.filtering.lowpass_gaussian, sigma=sigma)
        mesh = dic.Mesher(type="q4").mesh(
            stack, Xc1=float(left), Xc2=float(left + across * element), Yc1=float(top),
            Yc2=float(top + down * element), n_elx=across, n_ely=down, GUI=False,
        )  # fmt: skip
        fields = dic.Fields(dic.solver.DICAnalysis(dic.DICInput(mesh, stack)).run())
        return fields.F()[0], fields.coords()[0]

    began = time.perf_counter()
    gradient, place = analysed([1, 0, 2])
    seconds = time.perf_counter() - began
    rate, moved = ((part[..., 2] - part[..., 1]) / 2 for part in (gradient, place))
    total, _ = analysed([0, 2])
    return {
        "x": place[0, ..., 0].ravel(), "y": place[1, ..., 0].ravel(), "displacement": moved.reshape(2, -1).T,
        "rate": matrices(rate), "total": matrices(total[..., 1]) - np.eye(2), "seconds": seconds,
    }  # fmt: skip


def pyvale(images: Any, subset: int, step: int, window: int) -> dict[str, Any]:
    """Subsets of ``subset`` px every ``step`` px, gradients from ``window`` by ``window`` of them (bilinear), the rest
    at its defaults: affine subsets, images smoothed by 1 px. Displacements at the middles of the strain windows."""
    from pyvale import dic, strain  # type: ignore[import-not-found]

    height, width = images.shape[1:]

    def analysed(folder: Path, reference: int, others: list[int]) -> tuple[Any, Any]:
        common = {"output_basepath": folder, "print_level": 0}
        dic.calculate_2d(
            reference=images[reference], deformed=images[others], roi_mask=np.ones((height, width), np.bool_),
            seed=[width // 2, height // 2], subset_size=subset, subset_step=step, max_displacement=10, **common,
        )  # fmt: skip
        strain.calculate_2d(
            data=folder / "dic_results_*.csv", window_size=window, window_element=4, partial_window=1.0, **common
        )
        return (
            dic.import_2d(data=folder / "dic_results_*.csv", delimiter=",", print_level=0),
            strain.import_2d(data=folder / "strain_*.csv", delimiter=","),
        )

    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as second:
        began = time.perf_counter()
        moved, found = analysed(Path(first), 1, [0, 2])
        seconds = time.perf_counter() - began
        whole = gradients(analysed(Path(second), 0, [2])[1])[:, :, 0]
    both = gradients(found)
    rate = matrices((both[:, :, 1] - both[:, :, 0]) / 2)
    x, y = np.asarray(found.window_x, int), np.asarray(found.window_y, int)
    cols, rows = (np.searchsorted(at, n) for at, n in ((moved.ss_x[0], x), (moved.ss_y[:, 0], y)))
    displacement = np.stack([(part[1] - part[0])[rows, cols].ravel() / 2 for part in (moved.u_px, moved.v_px)], axis=-1)
    known = np.isfinite(rate).all(axis=(1, 2)) & np.isfinite(displacement).all(axis=1)
    total = matrices(whole)
    return {
        "x": x.ravel()[known], "y": y.ravel()[known], "displacement": displacement[known], "rate": rate[known],
        "total": total[np.isfinite(total).all(axis=(1, 2))] - np.eye(2), "seconds": seconds,
    }  # fmt: skip


def gradients(found: Any) -> Any:
    """Deformation gradients [2, 2, images, y, x]."""
    return np.array([[found.def_00, found.def_01], [found.def_10, found.def_11]])


def matrices(components: Any) -> Any:
    """[2, 2, ...] as [n, 2, 2]."""
    return np.moveaxis(components.reshape(2, 2, -1), -1, 0)


def main(program: str, settings: str, images: str, out: str) -> int:
    """Run the command line; the exit code: 0, or 3 where the program is not installed."""
    run = {"muDIC": mudic, "pyvale": pyvale}[program]
    with np.load(images) as file:
        shown = file["images"]
    try:
        found = run(shown, **json.loads(settings))
    except ModuleNotFoundError as missing:
        print(f"{missing.name} is not installed", file=sys.stderr)
        return 3
    np.savez(out, **found)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
