"""The Python interface: a capture and options in, a ``Field`` or a results store out."""

from __future__ import annotations

import platform
import time
import tomllib
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti import __version__
from leafflow_ti.background import Behind
from leafflow_ti.bands import WRITE_BEHIND
from leafflow_ti.capture import Capture, open_capture
from leafflow_ti.config import RunConfig, load_config
from leafflow_ti.correlation import stated_correlation
from leafflow_ti.errors import RunError
from leafflow_ti.field import Field, empty_map, status_counts
from leafflow_ti.pipeline import Pipeline
from leafflow_ti.plan import Plan, Unit, make_plan
from leafflow_ti.progress import Progress, RunSummary, Timings
from leafflow_ti.results import ResultStore
from leafflow_ti.runtime import Device, start
from leafflow_ti.stays import Maps
from leafflow_ti.trace import active, span


def plan_run(capture: Capture, config: RunConfig) -> Plan:
    """What ``run`` would do; ``plan.describe()`` says it in words."""
    return make_plan(capture, config)


def estimate(capture: Capture | str | Path, frame: int | None = None, **options: Any) -> Field:
    """Measure one frame.

    ``capture``: an open capture, or the path of one. ``frame``: index of the reference frame (default: the middle
    of those that can be measured). ``options``: those of ``run`` as keywords, e.g. ``model="affine-4d",
    motion="rotation", preshift=(-14, 0), window=65, sigma=19, stride=4, roi=(x0, y0, x1, y1)``.

    Arrays of up to 512 MiB are kept for the next call with the same options and region; ``release`` gives them back.

    Returns a Field of float32 maps [y, x]. Raises ConfigError, InputError, DeviceError.
    """
    if not isinstance(capture, Capture):
        capture = open_capture(capture)
    if frame is not None:
        options["frames"] = f"{frame}:{frame + 1}"
    config = load_config(overrides=options)
    plan = make_plan(capture, config)
    if frame is None and len(plan.frames) > 1:
        middle = plan.frames[len(plan.frames) // 2]
        return estimate(capture, middle, **options)
    from leafflow_ti.kernels.engine import quick_front_end

    began = time.perf_counter()
    device = start_device(config)
    pipeline = Pipeline(plan, capture, device)
    shape = (len(plan.y), len(plan.x))
    maps: Maps = {name: empty_map(name, shape) for name in plan.names}
    status = np.zeros(shape, np.uint8)

    def deliver(unit: Unit, found: Maps, codes: NDArray[np.uint8]) -> None:
        for name, values in found.items():
            maps[name][unit.rows] = values
        status[unit.rows] = codes

    with quick_front_end():
        pipeline.run(set(), deliver)
    pipeline.keep()
    n, pixels = plan.n_units, status.size
    timings = Timings(time.perf_counter() - began, pipeline.trace.seconds, n, pixels, 1.0, 1, str(device))
    attrs = {**_provenance(plan, capture, device, contents=False), "timings": timings.to_json()}
    return Field(maps, status, np.array(plan.y), np.array(plan.x), plan.frames[0], attrs)


def run(
    capture: Capture | str | Path,
    out: str | Path,
    config: RunConfig | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> RunSummary:
    """Measure every frame of a capture into a results store.

    ``resume`` goes on with an interrupted run of the same configuration and input; ``progress`` is called after every
    unit, by the thread that writes. Raises ConfigError, InputError, DeviceError, RunError; UsageError if ``out`` exists
    and neither option is given.
    """
    began = time.perf_counter()
    if not isinstance(capture, Capture):
        capture = open_capture(capture)
    config = config or RunConfig()
    plan = make_plan(capture, config)
    device = start_device(config)
    provenance = _provenance(plan, capture, device)
    store = _open_store(Path(out), plan, capture, provenance, resume, overwrite)
    before = Timings.of(store.attrs.get("timings"))
    done = store.done()
    capture.keep_decoded(plan.cache_bytes)
    pipeline = Pipeline(plan, capture, device)
    compile_seconds = pipeline.warm_up() if len(done) < plan.n_units else 0.0
    todo = {u.index: (u.rows.stop - u.rows.start) * len(plan.x) for u in plan.units() if u.index not in done}
    total, finished, pixels = sum(todo.values()), 0, 0
    computing = time.perf_counter()

    def timings() -> Timings:
        seconds, stages = time.perf_counter() - began, pipeline.trace.seconds
        return Timings(seconds, stages, finished, pixels, finished / plan.bands, 1, str(device))

    def write(result: tuple[Unit, Maps, NDArray[np.uint8]]) -> None:
        nonlocal finished, pixels
        unit, maps, status = result
        with span("write", f"unit {unit.index}"):
            store.write_unit(unit.index, unit.t_index, unit.rows, maps, status)
            finished, pixels = finished + 1, pixels + todo[unit.index]
            store.update_attrs({"timings": (before + timings()).to_json()})
        if progress:
            progress(Progress(finished, len(todo), pixels, total, time.perf_counter() - computing))

    with active(pipeline.trace), Behind(write, WRITE_BEHIND) as writer:
        pipeline.run(done, lambda *result: writer.put(result))
    now = timings()
    store.finish({"timings": (before + now).to_json()})
    counts: dict[str, int] = {}
    for t in range(len(plan.frames)):
        for name, n in status_counts(store.read("status", t)).items():
            counts[name] = counts.get(name, 0) + n
    return RunSummary(now.seconds, compile_seconds, str(device), counts, now.stages, str(out))


def start_device(config: RunConfig) -> Device:
    """The device that a configuration asks for; raises DeviceError."""
    threads = config.plan.threads
    return start(config.arch, config.precision, None if threads == "auto" else int(threads))


def _open_store(
    out: Path, plan: Plan, capture: Capture, provenance: dict[str, Any], resume: bool, overwrite: bool
) -> ResultStore:
    if resume and out.exists():
        store = ResultStore.open(out)
        for key in ("config", "plan", "input", "leafflow_ti_version"):
            if _decisive(store.attrs.get(key)) != _decisive(provenance[key]):
                raise RunError(
                    f"{out} cannot be resumed: its {key} differs from this run's; use --overwrite, or another output"
                )
        return store
    return create_store(out, plan, provenance, capture, overwrite)


def create_store(
    out: Path, plan: Plan, attrs: dict[str, Any], capture: Capture, overwrite: bool = False
) -> ResultStore:
    """An empty results store for a plan; errors as of ``ResultStore.create``."""
    stamps, times = capture.stamps_s, None
    if stamps is not None:
        end = len(stamps) - 1
        times = [stamps[t] + plan.time_offset * (stamps[min(t + 1, end)] - stamps[t]) for t in plan.frames]
    return ResultStore.create(
        out, frames=plan.frames, y=np.array(plan.y), x=np.array(plan.x), names=plan.names,
        chunk=(1, plan.band_rows, len(plan.x)), attrs=attrs, interval_s=capture.frame_interval_s,
        time_offset=plan.time_offset, times_s=times, overwrite=overwrite,
    )  # fmt: skip


def _decisive(value: Any) -> Any:
    """What of a provenance entry decides the results: of the configuration all but the resources of the machine."""
    if not isinstance(value, str) or "[plan]" not in value:
        return value
    return {key: section for key, section in tomllib.loads(value).items() if key != "plan"}


def _provenance(plan: Plan, capture: Capture, device: Device, contents: bool = True) -> dict[str, Any]:
    """What a result's reader must know: configuration, plan, versions, device, input.

    ``contents``: with checksums of the grey values, by which a run that is resumed knows its input again.
    """

    def installed(package: str) -> str:
        try:
            return version(package)
        except PackageNotFoundError:
            return "absent"

    g = plan.geometry
    return {
        "config": plan.config.to_toml(),
        "plan": {
            "model": plan.model, "bands": plan.bands,
            "preshift_px": "adaptive" if plan.adaptive else list(plan.preshift),
            "f_px": g.f_px, "principal_px": list(g.principal_px), "baseline_mm": list(g.baseline_mm),
            "disparity_offset_px": list(g.disparity_offset_px), "time_offset": plan.time_offset,
            "image_px": [capture.width, capture.height],
            "noise_correlation": stated_correlation(plan),
        },
        "leafflow_ti_version": __version__,
        "versions": {"python": platform.python_version()} | {p: installed(p) for p in ("taichi", "numpy", "zarr")},
        "device": str(device),
        "input": capture.fingerprint(contents)
        | (plan.ranges.given.fingerprint() if plan.ranges and plan.ranges.given else {}),
    }  # fmt: skip
