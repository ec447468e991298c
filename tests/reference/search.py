"""Naive float64 twin of the search among labels: costs, supports and semi-global aggregation, pixel by pixel."""

import numpy as np


def sample(plane, x, y):
    """Bilinear value; None outside the image."""
    rows, cols = plane.shape
    if not (0 <= x <= cols - 1 and 0 <= y <= rows - 1):
        return None
    x0, y0 = min(int(x), cols - 2), min(int(y), rows - 2)
    wx, wy = x - x0, y - y0
    corners = plane[y0 : y0 + 2, x0 : x0 + 2]
    return float(np.array([1 - wy, wy]) @ corners @ np.array([1 - wx, wx]))


def arm_costs(stack, x, y, label, arms, most):
    """Truncated difference of the reference at a pixel from the views of each arm, ``arms`` lists of factors."""
    values, view = [], 0
    for arm in arms:
        seen = []
        for factor in arm:
            view += 1
            channels = [sample(plane, x + label[0] * factor[0], y + label[1] * factor[1]) for plane in stack[view]]
            if None not in channels:
                seen.append(np.mean([min(abs(v - stack[0][c][y, x]), most) for c, v in enumerate(channels)]))
        values.append(np.mean(seen) if seen else most)
    return values


def costs(stack, guide, mask, arms, labels, most, radius, alike):
    """{(y, x): {label: cost}}; ``labels(y, x)`` lists the labels (x, y) of a pixel."""
    rows, cols = guide.shape
    raw = {
        (y, x): {label: arm_costs(stack, x, y, label, arms, most) for label in labels(y, x)}
        for y in range(rows)
        for x in range(cols)
    }
    result = {}
    for (y, x), own in raw.items():
        result[y, x] = {}
        for label in own:
            weights, values = [], []
            for j in range(max(y - radius, 0), min(y + radius + 1, rows)):
                for i in range(max(x - radius, 0), min(x + radius + 1, cols)):
                    if mask[j, i] and label in raw[j, i]:
                        weights.append(np.exp(-abs(guide[j, i] - guide[y, x]) / alike))
                        values.append(raw[j, i][label])
            better = np.sort(np.average(values, axis=0, weights=weights))[: max(1, len(arms) // 2)] if values else [0]
            result[y, x][label] = float(np.mean(better)) if mask[y, x] else 0.0
    return result


def aggregated(cost, guide, step, small, large, edge):
    """{(y, x): {label: sum over eight paths}}; ``step`` distance of neighbouring labels."""
    total = {pixel: dict.fromkeys(own, 0.0) for pixel, own in cost.items()}
    for dy, dx in [(j, i) for j in (-1, 0, 1) for i in (-1, 0, 1) if (j, i) != (0, 0)]:
        path = {}
        order = sorted(cost, key=lambda p: (dy * p[0], dx * p[1]))
        for y, x in order:
            before = path.get((y - dy, x - dx))
            path[y, x] = {}
            for label, value in cost[y, x].items():
                extra = 0.0
                if before is not None:
                    least = min(before.values())
                    jump = max(large / (1 + abs(guide[y, x] - guide[y - dy, x - dx]) / edge), small)
                    ways = [least + jump]
                    for other, sum_other in before.items():
                        gap = max(abs(label[0] - other[0]), abs(label[1] - other[1]))
                        if gap < 1.01 * step:
                            ways.append(sum_other + (small if gap > 0.01 * step else 0.0))
                    extra = min(ways) - least
                path[y, x][label] = value + extra
                total[y, x][label] += value + extra
    return total
