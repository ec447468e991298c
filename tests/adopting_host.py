"""``python tests/adopting_host.py CAPTURE``: a host that has initialised the engine as it likes; the checksum of what
its guest measures, and whether the host finds its settings again, as JSON."""

import importlib
import json
import os
import sys

import numpy as np

ti = importlib.import_module(os.environ.get("LEAFFLOW_TI_ENGINE", "taichi"))

ti.init(
    arch=ti.cpu, debug=True, default_fp=ti.f64, default_ip=ti.i64, fast_math=False, cpu_max_num_threads=1,
    offline_cache_file_path=sys.argv[2], log_level=ti.ERROR,
)  # fmt: skip


@ti.kernel
def third() -> ti.f64:
    value = 1.0 / 3.0  # in the host's own precision
    return value


if __name__ == "__main__":
    from guest import measured

    from leafflow_ti.runtime import start

    before = third()
    checksum = measured(sys.argv[1])
    values = ti.ndarray(float, (1,))
    kept = (ti.cfg.debug, ti.cfg.fast_math, values.to_numpy().dtype == np.float64, before == third() == 1.0 / 3.0)
    print(json.dumps({"main": checksum, "threads": start().threads, "kept": [bool(k) for k in kept]}))
