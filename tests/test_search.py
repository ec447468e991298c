"""Coarse search: the kernels against their twin, the pieces around them, and whole searches of scenes with a truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from PIL import Image
from reference.search import aggregated, costs

from leafflow_ti.errors import UsageError
from leafflow_ti.runtime import Device
from leafflow_ti.search import Extent, coarse_search, enlarged, noise_floor, reduced
from leafflow_ti.stages.candidates import proposals, tiled, votes
from leafflow_ti.stages.search import Costs, Labels, Views, box_mean, features, search
from leafflow_ti.synthetic.leaves import LeavesScene, render_image, truth
from perf import yosemite
from perf.inputs import absent, data_folder

ROWS, COLS, TILE = 13, 17, 6
RATING = Costs(most=0.9, small=0.11, large=0.7, support=2, alike=0.8, edge=0.6)
ARMS = {
    "line": [[(-1.0, 0.0), (-2.0, 0.0)], [(1.0, 0.0)]],
    "cross": [[(-1.0, 0.0)], [(1.0, 0.0)], [(0.0, -1.0)], [(0.0, 1.0), (0.0, 2.0)]],
    "one side": [[(1.0, 1.0)]],
}


def some_labels(random: np.random.Generator, step: float) -> Labels:
    """Lists of different lengths and contents, neighbours and strangers among them."""
    tiles_y, tiles_x = -(-ROWS // TILE), -(-COLS // TILE)
    count = random.integers(3, 9, tiles_y * tiles_x).astype(np.int32)
    values = np.zeros((len(count), 8, 2))
    grid = np.array([(i, j) for i in range(-2, 3) for j in range(-1, 2)])
    for here, n in enumerate(count):
        values[here, :n] = step * random.permutation(grid)[:n]
    return Labels(TILE, tiles_x, count, values, step)


def assert_search_equals_twin(device: Device, arms_name: str, step: float, limit: float) -> None:
    """Costs and displacements of the chosen labels, with a mask and lists of labels that differ from tile to tile."""
    random = np.random.default_rng(5)
    arms = ARMS[arms_name]
    stack = random.normal(size=(1 + sum(map(len, arms)), 2, ROWS, COLS)).astype(np.float32)
    guide, mask = random.normal(size=(ROWS, COLS)).astype(np.float32), random.random((ROWS, COLS)) > 0.1
    labels = some_labels(random, step)
    found = search(device, stack, guide, mask, Views.of(arms), labels, RATING)

    def of_pixel(y: int, x: int) -> list[tuple[float, float]]:
        here = (y // TILE) * labels.tiles_x + x // TILE
        return [(float(i), float(j)) for i, j in labels.values[here, : labels.count[here]]]

    wide = [stack[k].astype(np.float64) for k in range(len(stack))]
    cost = costs(wide, guide.astype(np.float64), mask, arms, of_pixel, RATING.most, RATING.support, RATING.alike)
    total = aggregated(cost, guide.astype(np.float64), step, RATING.small, RATING.large, RATING.edge)
    for (y, x), sums in total.items():
        chosen = of_pixel(y, x)[found.slot[y, x]]
        best = min(sums.values())
        assert sums[chosen] == pytest.approx(best, abs=limit)
        assert found.cost[y, x] == pytest.approx(cost[y, x][chosen], abs=limit)
        if sorted(sums.values())[1] - best > 10 * limit:
            assert found.displacement[:, y, x] == pytest.approx(refined(chosen, sums, step), abs=100 * limit)


def refined(label: tuple[float, float], sums: dict[tuple[float, float], float], step: float) -> list[float]:
    """Vertices of the parabolas through a label and those beside it."""
    result = list(label)
    for axis, (i, j) in enumerate(((step, 0.0), (0.0, step))):
        ends = [sums.get((label[0] + sign * i, label[1] + sign * j)) for sign in (-1, 1)]
        if None not in ends:
            low, high = ends
            bend = low - 2 * sums[label] + high
            result[axis] += step * float(np.clip((low - high) / (2 * bend), -0.5, 0.5)) if bend > 0 else 0.0
    return result


@pytest.mark.parametrize("arms_name", list(ARMS))
def test_search_equals_twin(device: Callable[[str], Device], arms_name: str, precision: str) -> None:
    # Results are stored as float32 in both precisions.
    assert_search_equals_twin(device(precision), arms_name, 0.5, 1e-6 if precision == "f64" else 1e-5)


def test_labels_in_a_line_are_refined_along_it(device: Callable[[str], Device]) -> None:
    """One list for all pixels: the reference is a bump, the other view the same bump moved by a fraction."""
    x = np.arange(40.0)
    planes = [np.tile(np.exp(-0.5 * ((x - at) / 4.0) ** 2), (20, 1)) for at in (20.0, 17.7)]
    stack = np.stack([np.stack([p, np.zeros_like(p)]) for p in planes]).astype(np.float32)
    values = np.stack([np.arange(-4.0, 3.0), np.zeros(7)], axis=1)
    labels = Labels(40, 1, np.array([7], np.int32), values[None], 1.0, line=True)
    found = search(
        device("f64"), stack, np.zeros((20, 40), np.float32), np.ones((20, 40), np.bool_),
        Views.of([[(1.0, 0.0)]]), labels, replace(RATING, small=0.001, large=1.0),
    )  # fmt: skip
    # Truncated differences are no parabola: its vertex is right to a fifth of a step.
    np.testing.assert_allclose(found.displacement[0, 8:12, 14:27], -2.3, atol=0.2)


def test_features_do_not_see_gain_and_offset() -> None:
    image = np.random.default_rng(2).normal(100.0, 20.0, (40, 50)).astype(np.float32)
    np.testing.assert_allclose(features(image, 6, 1.0), features(3.0 * image + 50.0, 6, 3.0), atol=1e-4)


def test_features_of_noise_are_half_as_strong_as_noise_allows() -> None:
    noise = np.random.default_rng(3).normal(0.0, 2.0, (200, 200)).astype(np.float32)
    assert noise_floor(noise) == pytest.approx(2.0, rel=0.03)
    assert np.mean(features(noise, 12, 2.0)[:, 5:-5, 5:-5] ** 2) == pytest.approx(0.5, rel=0.03)
    assert not features(np.full((20, 20), 7.0, np.float32), 5, 1.0).any()


def test_box_mean_is_the_mean_of_what_lies_inside() -> None:
    image = np.random.default_rng(4).normal(size=(9, 14))
    mean = box_mean(image, 3)
    for y, x in np.ndindex(image.shape):
        expected = image[max(y - 3, 0) : y + 4, max(x - 3, 0) : x + 4].mean()
        assert mean[y, x] == pytest.approx(expected, abs=1e-12)


def test_reduced_and_enlarged_stay_in_place() -> None:
    image = np.arange(7 * 11, dtype=np.float32).reshape(7, 11)
    small = reduced(image, 3)
    assert small.shape == (2, 3)
    assert small[1, 2] == image[3:6, 6:9].mean()
    large = enlarged(small, 3, (7, 11))
    assert large.shape == (7, 11)
    assert (large[3:7, 6:11] == small[1, 2]).all()


def test_proposals_hold_the_motions_of_both_surfaces() -> None:
    random = np.random.default_rng(6)
    texture = random.normal(size=(2, 2, 160, 160)).astype(np.float32)
    left = np.arange(128) < 64

    def view(shift: int) -> np.ndarray:
        still = texture[0][:, 16:144, 16:144]
        moving = np.roll(texture[1], (2 * shift, 5 * shift), (1, 2))[:, 16:144, 16:144]
        return np.where(left, still, moving)

    stack = np.stack([view(0), view(1), view(-1)])
    found = proposals(stack, [1, -1], 8)
    middle = found[1 * 4 + 2]  # the tile right of the boundary, whose window sees both
    assert [5, 2] in middle.tolist()
    assert [0, 0] in middle.tolist()


def test_tiles_gather_votes_of_their_neighbours() -> None:
    displacement = np.zeros((2, 8, 12), np.float32)
    displacement[0, :, 4:8] = 3.0
    displacement[1, :4, 8:] = -2.2
    won = votes(displacement, 4)
    assert [v.tolist() for v in won] == [[[0, 0]], [[3, 0]], [[0, -2]], [[0, 0]], [[3, 0]], [[0, 0]]]
    labels = tiled(won, 4, (8, 12), 3, 0.5)
    here = labels.values[2, : labels.count[2]]
    assert here[0].tolist() == [0.0, -1.0]
    for own in ([1.5, 0.0], [0.0, 0.0], [0.5, -0.5]):
        assert own in here.tolist()
    assert len(np.unique(here, axis=0)) == len(here)
    assert np.abs(here).max() <= 3.0


SCENE = LeavesScene(
    size=(161, 121), n_cols=5, n_frames=3, leaves=2, disparity_px=(2.0, 9.0), motion_px=5.0, supersampling=1, noise=1.0
)


def searched(device: Device, scene: LeavesScene, **options: object) -> tuple[dict, np.ndarray, object]:
    """Truth, true disparity [H, W] and the coarse maps of a scene."""
    extent = Extent(scene.n_frames, scene.n_rows, scene.n_cols, scene.size[1], scene.size[0], scene.baseline_mm)
    reference = (scene.n_rows // 2, scene.n_cols // 2)
    found = coarse_search(
        device, lambda t, sy, sx: render_image(scene, t, sy, sx).astype(np.float32), extent, reference=reference,
        frame=scene.reference_frame, **options,
    )  # fmt: skip
    maps = truth(scene)
    return maps, -scene.f_px * scene.baseline_mm[extent.axis] / maps["depth"], found


def test_leaves_are_found(device: Callable[[str], Device]) -> None:
    """Disparity and motion, limits found by the search itself, in light that changes from frame to frame."""
    maps, disparity, found = searched(device("f32"), SCENE)
    near = np.abs(found.disparity - disparity) < 0.75
    still = np.abs(found.motion - np.moveaxis(maps["flow"], -1, 0)).max(axis=0) < 1.0
    leaf = maps["face"] > 0
    assert leaf.mean() > 0.15
    # What fails lies at the outlines: in a band of 2 px they hold 10 % of the pixels of leaves this small.
    assert near[leaf].mean() > 0.95
    assert still[leaf].mean() > 0.95
    assert (near & still)[~leaf].mean() > 0.9
    assert (near & still)[found.known].mean() > 0.95
    assert found.known.mean() > 0.9


def test_threads_do_not_change_the_result(device: Callable[[str], Device]) -> None:
    one = searched(replace(device("f32"), threads=1), SCENE)[2]
    many = searched(replace(device("f32"), threads=3), SCENE)[2]
    np.testing.assert_array_equal(one.disparity, many.disparity)
    np.testing.assert_array_equal(one.motion, many.motion)
    np.testing.assert_array_equal(one.known, many.known)


@pytest.mark.parametrize(("cols", "rows"), [(1, 5), (3, 3)])
def test_grids_along_y_and_in_both_directions(device: Callable[[str], Device], cols: int, rows: int) -> None:
    scene = replace(SCENE, n_cols=cols, n_rows=rows, n_frames=1, baseline_mm=(5.0, 4.0))
    _, disparity, found = searched(device("f32"), scene)
    assert (np.abs(found.disparity - disparity) < 0.75).mean() > 0.93
    assert not found.motion.any()


def test_sheared_light_fields_count_their_offset(device: Callable[[str], Device]) -> None:
    """The images of each camera moved by whole pixels: the same depths behind another disparity."""
    scene = replace(SCENE, n_frames=1, size=(181, 121))
    extent = Extent(1, 1, 5, 121, 161, scene.baseline_mm, (-5.0, 0.0))

    def image(t: int, sy: int, sx: int) -> np.ndarray:
        left = 10 - 5 * (sx - 2)  # moves it to the right, so that the disparity seen is 5 more
        return render_image(scene, t, sy, sx)[:, left : left + 161].astype(np.float32)

    found = coarse_search(device("f32"), image, extent, reference=(0, 2), frame=0)
    disparity = 5.0 - scene.f_px * 5.0 / truth(scene)["depth"][:, 10:171]
    assert (np.abs(found.disparity - disparity) < 0.75).mean() > 0.93


def test_nothing_is_known_without_texture_and_outside_the_mask(device: Callable[[str], Device]) -> None:
    images = np.random.default_rng(7).normal(100.0, 20.0, (3, 60, 80)).astype(np.float32)
    images[:] = images[0]
    images[:, :, 45:] = 100.0
    images[1, 10, 10] = np.nan
    mask = np.ones((60, 80), np.bool_)
    mask[:, :8] = False
    found = coarse_search(
        device("f32"), lambda t, sy, sx: images[t], Extent(3, 1, 1, 60, 80), reference=(0, 0), frame=1, mask=mask
    )
    assert not found.known[:, 65:].any()
    assert not found.known[:, :8].any()
    assert not found.known[10, 10]
    assert found.known[:, 12:38].mean() > 0.97
    assert np.abs(found.motion[:, found.known]).max() < 0.1
    assert not found.disparity.any()


@pytest.mark.parametrize(
    ("options", "says"), [({"disparity_range": (3.0, -3.0)}, "lowest"), ({"motion_range": -1.0}, "negative")]
)
def test_ranges_are_checked(device: Callable[[str], Device], options: dict, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        searched(device("f32"), SCENE, **options)


def needs(name: str) -> pytest.MarkDecorator:
    reason = absent(name)
    return pytest.mark.skipif(reason is not None, reason=reason or "")


@needs("tsukuba_row")
def test_disparities_of_the_head_and_lamp(device: Callable[[str], Device]) -> None:
    """Real images; the limits, 5 to 14 px per step, are found."""
    folder = data_folder("tsukuba_row")
    images = [np.asarray(Image.open(folder / f"scene1.row3.col{k}.ppm").convert("L"), np.float32) for k in range(1, 6)]
    counted = np.asarray(Image.open(folder / "truedisp.row3.col3.pgm"), np.float32)
    found = coarse_search(
        device("f32"), lambda t, sy, sx: images[sx], Extent(1, 1, 5, *counted.shape), reference=(0, 2), frame=0
    )
    error = np.abs(found.disparity + counted / 16.0)[counted > 0]
    # The truth is given in whole pixels: half a pixel is its own rounding.
    assert (error <= 0.5).mean() > 0.9
    assert (error <= 1.0).mean() > 0.95


@needs(yosemite.NAME)
def test_motions_of_yosemite(device: Callable[[str], Device]) -> None:
    folder, true = data_folder(yosemite.NAME), yosemite.Truth.read()
    images = [tifffile.imread(folder / f"yos{k}.tif").astype(np.float32) for k in (8, 9, 10)]
    found = coarse_search(
        device("f32"), lambda t, sy, sx: images[t], Extent(3, 1, 1, *true.sky.shape), reference=(0, 0), frame=1
    )
    error = np.abs(np.moveaxis(found.motion, 0, -1) - true.flow).max(axis=-1)[~true.sky]
    assert (error < 1.0).mean() > 0.97
    assert np.median(error) < 0.15
