"""Writes tests/fixtures/scipy.safetensors: ten random cases of SciPy's nearest and linear interpolation.

    python tests/reference/make_scipy.py

Only points whose Delaunay triangulation is unique are kept (no four of them on one empty circle, judged in integers), and
pixels at equal distance of two nearest points are NaN in `nearest`, so that each value written has one right answer. Outside
the hull `linear` is NaN, as SciPy gives it.
"""

from pathlib import Path

import numpy as np
from safetensors.numpy import save_file
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import Delaunay

CASES = [(32, 24, 3), (32, 24, 4), (24, 32, 6), (32, 24, 8), (40, 18, 10), (32, 24, 14), (32, 24, 18), (18, 40, 20), (32, 24, 24), (36, 28, 28)]


def in_circle(a, b, c, d):
    """Above 0 with d inside the circle through a, b, c (counter-clockwise), 0 on it; exact for Python integers."""
    rows = [(p[0] - d[0], p[1] - d[1], (p[0] - d[0]) ** 2 + (p[1] - d[1]) ** 2) for p in (a, b, c)]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = rows
    return ax * (by * cz - bz * cy) - ay * (bx * cz - bz * cx) + az * (bx * cy - by * cx)


def unique(points):
    """Whether all other points lie strictly outside the circle of every triangle, and none is flat."""
    p = [tuple(int(v) for v in q) for q in points]
    try:
        mesh = Delaunay(points)
    except Exception:
        return False
    for a, b, c in mesh.simplices:
        area = (p[b][0] - p[a][0]) * (p[c][1] - p[a][1]) - (p[c][0] - p[a][0]) * (p[b][1] - p[a][1])
        if area == 0:
            return False
        order = (a, b, c) if area > 0 else (a, c, b)
        if any(in_circle(*(p[i] for i in order), p[d]) >= 0 for d in range(len(p)) if d not in (a, b, c)):
            return False
    return True


def case(rng, width, height, count):
    while True:
        chosen = rng.choice(width * height, count, replace=False)
        points = np.stack([chosen % width, chosen // width], axis=1)
        if unique(points):
            break
    depth = rng.uniform(0.5, 9.0, count).astype(np.float32)
    sparse = np.full((height, width), np.nan, np.float32)
    sparse[points[:, 1], points[:, 0]] = depth
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    linear = LinearNDInterpolator(points, depth)(x, y).astype(np.float32)
    nearest = NearestNDInterpolator(points, depth)(x, y).astype(np.float32)
    squared = (x[..., None] - points[:, 0]) ** 2 + (y[..., None] - points[:, 1]) ** 2
    ties = (squared == squared.min(axis=-1, keepdims=True)).sum(axis=-1) > 1
    nearest[ties] = np.nan
    return {"sparse": sparse, "linear": linear, "nearest": nearest}


def main():
    rng = np.random.default_rng(20)
    tensors = {}
    for index, (width, height, count) in enumerate(CASES):
        for name, values in case(rng, width, height, count).items():
            tensors[f"{index}.{name}"] = values
    path = Path(__file__).parent.parent / "fixtures" / "scipy.safetensors"
    save_file(tensors, path)
    for index in range(len(CASES)):
        inside, clear = (int(np.isfinite(tensors[f"{index}.{n}"]).sum()) for n in ("linear", "nearest"))
        print(f"case {index}: {inside} pixels inside the hull, {clear} with one nearest point")
    print(path, path.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
