"""Block sums of the frames of a window as planes in the order of the image, for windows that are weighted anew."""

import functools

from leafflow_ti.kernels.engine import lane_kernel, lane_type, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec


@functools.cache
def sources_kernel(spec: KernelSpec):
    """Weighted sums over frames of maps [frame, map, segment, pitch] of row vectors, to planes [plane, row, pitch]."""
    V = lane_type(spec.real, spec.lanes)
    lanes = spec.lanes

    @ti.func
    def put(
        item: ti.i32, segment: ti.i32, rows: ti.i32, cols: ti.i32, pitch: ti.i32, oldest: ti.i32, n_slots: ti.i32,
        slot_size: ti.i32, to: ti.i32, plane: ti.i32, target_pitch: ti.i32, first: ti.template(), offset: ti.template(),
        ring: ti.template(), weight: ti.template(), maps: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """The rows of a plane that lie in the lanes of one row of vectors."""
        source = item // segment
        j = item - source * segment
        for c in range(cols):
            total = V(0.0)
            for term in range(first[source], first[source + 1]):
                slot = (oldest + ring[term]) % n_slots
                total = total + maps[slot * slot_size + offset[term] + j * pitch + c] * weight[term]
            begin = to + source * plane + c
            if ti.static(lanes == 1):
                out[begin + j * target_pitch] = total
            else:
                for lane in ti.static(range(lanes)):
                    row = lane * segment + j
                    if row < rows:
                        out[begin + row * target_pitch] = total[lane]

    @lane_kernel(lanes)
    def sources(
        n_planes: ti.i32,
        n_tasks: ti.i32,
        segment: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        pitch: ti.i32,
        oldest: ti.i32,
        n_slots: ti.i32,
        slot_size: ti.i32,
        to: ti.i32,
        plane: ti.i32,
        target_pitch: ti.i32,
        first_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_planes + 1]
        offset_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        ring_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        weight_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_terms]
        maps_in: ti.types.ndarray(dtype=V, ndim=1),  # [frames, maps, segment, pitch]
        planes_out: ti.types.ndarray(dtype=spec.real, ndim=1),  # [any]
    ):
        if ti.static(spec.gpu):
            for item in range(n_planes * segment):
                put(
                    item, segment, rows, cols, pitch, oldest, n_slots, slot_size, to, plane, target_pitch,
                    first_in, offset_in, ring_in, weight_in, maps_in, planes_out,
                )  # fmt: skip
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    n = n_planes * segment
                    for item in range(task * n // n_tasks, (task + 1) * n // n_tasks):
                        put(
                            item, segment, rows, cols, pitch, oldest, n_slots, slot_size, to, plane, target_pitch,
                            first_in, offset_in, ring_in, weight_in, maps_in, planes_out,
                        )  # fmt: skip

    return sources
