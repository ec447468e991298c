"""The Python interface: a capture and options in, a ``Field`` or a results store out."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Capture, open_capture
from leafflow_ti.config import RunConfig, load_config
from leafflow_ti.field import Field, empty_map
from leafflow_ti.pipeline import Pipeline
from leafflow_ti.plan import Plan, Unit, make_plan
from leafflow_ti.progress import Timings
from leafflow_ti.provenance import provenance
from leafflow_ti.stays import Maps
from leafflow_ti.worker import start_device


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
        pipeline.run(deliver)
    pipeline.keep()
    n, pixels = plan.n_units, status.size
    timings = Timings(time.perf_counter() - began, pipeline.trace.seconds, n, pixels, 1.0, 1, str(device))
    attrs = {**provenance(plan, capture, contents=False), "device": str(device), "timings": timings.to_json()}
    return Field(maps, status, np.array(plan.y), np.array(plan.x), plan.frames[0], attrs)
