"""The compute device: the one place that starts the engine, and the arrays that live on the device.

Importing this module starts nothing; ``start()`` does, once per process. A host program that has already
initialised the engine keeps its settings: they are adopted, never replaced.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import os
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti import kernel_cache
from leafflow_ti.errors import DeviceError
from leafflow_ti.memory import share_one_arena

if TYPE_CHECKING:
    from leafflow_ti.kernels.spec import KernelSpec

ARCHES = ("cuda", "metal", "vulkan", "cpu")
PLANE_LANES = 64
DENSE_LANES = {"f32": 16, "f64": 16}
MOMENT_LANES = 16
ALIGNMENT = 256
"""Bytes: whole vectors are loaded from aligned addresses."""
_lock = threading.Lock()


@dataclass(frozen=True)
class Device:
    """Where kernels run, and in which precision.

    ``storage`` is the type of images and moments, ``algebra`` that of the small dense matrices.
    """

    arch: str
    threads: int
    storage: str = "f32"
    algebra: str = "f64"

    @property
    def gpu(self) -> bool:
        """Whether arrays live in device memory."""
        return self.arch != "cpu"

    def __str__(self) -> str:
        where = f"cpu ({self.threads} threads)" if self.arch == "cpu" else self.arch
        return f"{where}, images {self.storage}, algebra {self.algebra}"

    @cached_property
    def planes(self) -> KernelSpec:
        """What plane kernels are compiled for."""
        from leafflow_ti.kernels.spec import KernelSpec

        return KernelSpec(self.storage, self.algebra, 1 if self.gpu else PLANE_LANES, self.gpu)

    @cached_property
    def moments(self) -> KernelSpec:
        """What the kernels from frames to structure tensors are compiled for."""
        from leafflow_ti.kernels.spec import KernelSpec

        return KernelSpec(self.storage, self.algebra, 1 if self.gpu else MOMENT_LANES, self.gpu)

    @cached_property
    def dense(self) -> KernelSpec:
        """What per-pixel kernels are compiled for."""
        from leafflow_ti.kernels.spec import KernelSpec

        return KernelSpec(self.storage, self.algebra, 1 if self.gpu else DENSE_LANES[self.algebra], self.gpu)

    def vectors(self, array: Any, lanes: int) -> Any:
        """A flat array as kernels on ``lane_type`` values take it: [size // lanes, lanes]; as it is with one lane."""
        return array if lanes == 1 else array.reshape(-1, lanes)

    def tasks(self, n_groups: int) -> int:
        """Into how many tasks the groups of a launch are cut on the CPU."""
        return max(1, min(n_groups, 8 * self.threads))

    def real(self, kind: str) -> type[np.floating[Any]]:
        """NumPy type of "storage" or "algebra"."""
        return np.float32 if getattr(self, kind) == "f32" else np.float64

    def empty(self, size: int, kind: str = "storage") -> Any:
        """A flat array of the device, contents undefined; ``kind`` is "storage", "algebra" or "int"."""
        dtype = np.int32 if kind == "int" else self.real(kind)
        if not self.gpu:
            return _aligned(size, dtype)
        from leafflow_ti.kernels.engine import ti

        return ti.ndarray({np.int32: ti.i32, np.float32: ti.f32, np.float64: ti.f64}[dtype], (size,))

    def zeros(self, size: int, kind: str = "storage") -> Any:
        """A flat array of the device, all 0."""
        array = self.empty(size, kind)
        array.fill(0)
        return array

    def array(self, values: Any, kind: str = "storage") -> Any:
        """A flat array of the device with these values."""
        host = np.ascontiguousarray(values, np.int32 if kind == "int" else self.real(kind)).ravel()
        if not self.gpu:
            if host.ctypes.data % ALIGNMENT:
                host, values = _aligned(host.size, host.dtype), host
                host[:] = values
            return host
        result = self.empty(host.size, kind)
        result.from_numpy(host)
        return result

    def write(self, array: Any, start: int, values: Any) -> None:
        """Put host values (storage type) into a flat array of the device, from element ``start`` on."""
        if not self.gpu:
            array[start : start + values.size] = values.ravel()
            return
        from leafflow_ti.kernels.planes import copy_kernel

        copy_kernel(self.planes)(values.size, start, self.array(values), array)

    def host(self, array: Any) -> Any:
        """The values as a NumPy array; on the CPU the array itself."""
        return array.to_numpy() if self.gpu else array

    def synchronize(self) -> None:
        """Wait until every launched kernel has finished."""
        if self.gpu:
            from leafflow_ti.kernels.engine import ti

            ti.sync()


def _aligned(size: int, dtype: Any) -> NDArray[Any]:
    """A flat array that begins at a multiple of ``ALIGNMENT``, contents undefined."""
    itemsize = np.dtype(dtype).itemsize
    raw = np.empty(size * itemsize + ALIGNMENT, np.uint8)
    first = -raw.ctypes.data % ALIGNMENT
    return raw[first : first + size * itemsize].view(dtype)


def _running() -> str | None:
    """Arch of an engine that is already initialised."""
    from leafflow_ti.kernels.engine import running, ti

    if not running():
        return None
    name = str(ti.lang.impl.current_cfg().arch).rsplit(".", 1)[-1]
    return "cpu" if name in ("x64", "arm64") else name


def _initialise(arch: str, threads: int, cache: Path | None) -> bool:
    from leafflow_ti.kernels.engine import ti

    settings = {"offline_cache": cache is not None, "cpu_max_num_threads": threads, "log_level": ti.ERROR}
    if cache is not None:
        settings["offline_cache_file_path"] = str(cache)
    # The engine announces its arch on standard output, which belongs to the program's results.
    with contextlib.redirect_stdout(io.StringIO()), _hidden(*settings, "arch"), _existing_folder():
        try:
            ti.init(arch=getattr(ti, arch), enable_fallback=False, **settings)
        except (RuntimeError, OSError):
            return False
    if cache is not None:
        atexit.register(_keep_kernels, cache)
    ti.lang.impl.get_runtime().materialize()  # only this thread may; afterwards all may launch kernels
    return True


def _keep_kernels(cache: Path) -> None:
    """At the end of the process: the engine writes what it has compiled when it is reset."""
    from leafflow_ti.kernels.engine import forked, ti

    if not forked():
        kernel_cache.write(cache, ti.reset)


@contextlib.contextmanager
def _hidden(*settings: str) -> Iterator[None]:
    """Without the engine's own variables for these settings: TI_ARCH would overrule the device that is asked for."""
    names = [f"{prefix}_{setting.upper()}" for prefix in ("TI", "QD") for setting in settings]
    hidden = {name: os.environ.pop(name) for name in names if name in os.environ}
    try:
        yield
    finally:
        os.environ.update(hidden)


@contextlib.contextmanager
def _existing_folder() -> Iterator[None]:
    """The engine asks for the current folder when it starts, which may have been removed."""
    try:
        Path.cwd()
    except FileNotFoundError:
        removed = os.open(".", os.O_RDONLY)
    else:
        yield
        return
    os.chdir("/")
    try:
        yield
    finally:
        os.fchdir(removed)
        os.close(removed)


def usable_threads() -> int:
    """Threads of the CPU that this process may use."""
    with contextlib.suppress(AttributeError):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def start(arch: str = "auto", precision: str = "f32", threads: int | None = None) -> Device:
    """Start the engine, or adopt the one that runs, and say on what it computes.

    ``arch``: "auto" (``LEAFFLOW_TI_ARCH`` if set, else the first of cuda, metal, vulkan, cpu that starts; a
    software Vulkan driver counts as none) or one of them. ``precision``: "f32" or "f64", of images and moments; the
    small dense matrices are always solved in double precision where the device has it.

    Raises DeviceError if the device cannot be started, or another one already runs in this process.
    """
    if arch == "auto":
        arch = os.environ.get("LEAFFLOW_TI_ARCH", "auto")
    if arch != "auto" and arch not in ARCHES:
        raise DeviceError(f"arch '{arch}' does not exist; choose auto, {', '.join(ARCHES)}")
    from leafflow_ti.kernels.engine import check_not_forked

    check_not_forked()
    n_threads = threads or usable_threads()
    with _lock:
        running = _running()
        if running is None:
            share_one_arena()
            running = _started(ARCHES if arch == "auto" else (arch,), n_threads, choosing=arch == "auto")
        else:
            n_threads = min(n_threads, _adopt())
    if running is None:
        raise DeviceError(f"device '{arch}' could not be started; use --arch cpu or --arch auto")
    if arch not in ("auto", running):
        raise DeviceError(f"device '{arch}' was asked for, but this process already computes on '{running}'")
    has_double = running in ("cpu", "cuda", "vulkan")
    if precision == "f64" and not has_double:
        raise DeviceError(f"precision f64 does not exist on '{running}'; use f32 or --arch cpu")
    return Device(running, n_threads, precision, "f64" if has_double else "f32")


def _started(candidates: Sequence[str], threads: int, choosing: bool) -> str | None:
    """The first arch that starts; while ``choosing``, a software Vulkan driver counts as none."""
    cache = kernel_cache.cache_folder()
    if cache is not None:
        kernel_cache.remove_stale_lock(cache)
        kernel_cache.remove_damaged(cache)
    for candidate in candidates:
        if choosing and candidate == "vulkan" and _vulkan_is_software():
            continue
        if _initialise(candidate, threads, cache):
            return candidate
    return None


def _adopt() -> int:
    """Threads of the engine that runs. Raises DeviceError where a host has initialised
    it in another thread, and not used it yet."""
    from leafflow_ti.kernels.engine import ti

    try:
        ti.lang.impl.get_runtime().materialize()
    except RuntimeError as error:
        raise DeviceError(
            f"this process's engine takes no kernels ({' '.join(str(error).split())}): let the thread that has "
            "initialised it launch the first one"
        ) from None
    return int(ti.lang.impl.current_cfg().cpu_max_num_threads)


def _vulkan_is_software() -> bool:
    """Whether no hardware Vulkan driver is installed: then the CPU back end is the faster choice."""
    roots = [Path("/etc/vulkan/icd.d"), Path("/usr/share/vulkan/icd.d")]
    chosen = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    files = [Path(p) for p in chosen.split(os.pathsep)] if chosen else [f for r in roots for f in r.glob("*.json")]
    hardware = [f for f in files if not f.name.startswith("lvp_")]
    has_card = any(Path("/dev/dri").glob("render*")) or Path("/dev/nvidia0").exists() or os.name == "nt"
    return not (hardware and has_card)
