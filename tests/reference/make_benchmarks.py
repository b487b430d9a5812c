#!/usr/bin/env python3
"""Writes tests/fixtures/benchmarks: made-up frames in the container formats of NYU Depth V2 (HDF5) and iBims-1 (MATLAB).

    pip install -r tests/reference/requirements.txt
    python tests/reference/make_benchmarks.py [DIRECTORY]

The containers are written by h5py and SciPy, the same libraries that read the published files. `nyu_expected.json` holds
what torchvision's Resize(240) and CenterCrop((228, 304)), the usual NYU protocol, make of the frame: the number of valid depths,
the sum of all colours, and [x, y, r, g, b, depth or null] of some pixels. Holes are NaN there, so that they spread as far as
the filter reaches.
"""

import json
import pathlib
import sys

import h5py
import numpy as np
import scipy.io
from PIL import Image
from torchvision import transforms

OUT = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else pathlib.Path(__file__).parents[1] / "fixtures/benchmarks")


def write_h5(path, compression, **arrays):
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            chunks = (1, *array.shape[1:]) if array.ndim == 4 else True
            level = 9 if compression == "gzip" else None
            options = {"compression": compression, "compression_opts": level, "shuffle": True}
            file.create_dataset(name, data=array, chunks=chunks, **options)


def nyu_frame():
    """One frame as sparse-to-dense distributes it."""
    y, x = np.mgrid[:480, :640]
    rgb = np.stack([(x * 5 + y) % 251, (x // 3 * 17) % 256, (y // 5 * 29 + x // 40) % 256]).astype(np.uint8)
    depth = (1.25 + (x // 16 * 3 + y // 12 * 5) % 64 / 11).astype(np.float32)
    depth[100:103, 200:300] = 0
    depth[300:340, 411:480] = 0
    write_h5(OUT / "nyu/val/official/00001.h5", "gzip", rgb=rgb, depth=depth)

    tail = transforms.Compose([transforms.Resize(240), transforms.CenterCrop((228, 304))])
    small = np.array(tail(Image.fromarray(rgb.transpose(1, 2, 0))))
    holes = np.where(depth > 0, depth, np.nan).astype(np.float32)
    near = np.array(tail(Image.fromarray(holes)))
    rng = np.random.default_rng(5)
    places = [(int(rng.integers(304)), int(rng.integers(228))) for _ in range(250)]
    # Along the edge of a hole as well.
    places += [(cx, 45) for cx in range(88, 146)] + [(0, 0), (303, 227), (303, 0), (0, 227)]
    pixels = []
    for cx, cy in places:
        d = float(near[cy, cx])
        pixels.append([cx, cy, *map(int, small[cy, cx]), None if np.isnan(d) else d])
    expected = {"valid": int(np.isfinite(near).sum()), "colours": int(small.astype(np.int64).sum()), "pixels": pixels}
    (OUT / "nyu_expected.json").write_text(json.dumps(expected).replace("], [", "],\n["))


def nyu_bundle():
    """Two frames as Conti et al. distribute them."""
    n, y, x = np.mgrid[:2, :228, :304]
    img = np.stack([x // 4, y // 16, n * 100 + 7], axis=-1).astype(np.uint8)
    gt = (2 + n + (x // 32) / 4)[..., None].astype(np.float32)
    hints = np.where(((x * 31 + y * 17 + n * 5) % 139 == 0)[..., None], gt, 0).astype(np.float32)
    write_h5(OUT / "nyu_bundle/nyu_img_gt.h5", "gzip", img=img, gt=gt)
    write_h5(OUT / "nyu_bundle/nyu_pred_with_500.h5", "lzf", hints=hints)


def ibims():
    """Two frames of 8 x 6 pixels, one compressed as MATLAB does, one not."""
    folder = OUT / "ibims/ibims1_core_mat"
    folder.mkdir(parents=True, exist_ok=True)
    y, x = np.mgrid[:6, :8]
    for k, name in enumerate(["office_02", "corridor_01"]):
        depth = 1.5 + x / 4 + y + k
        depth[0, 0] = 0
        invalid, transp = np.ones((2, 6, 8), np.uint8)
        invalid[1, 2] = 0
        transp[3, 4:6] = 0
        plane = np.zeros((6, 8), np.uint8)
        plane[5] = 2
        data = {
            "rgb": np.stack([x * 30, y * 40, x * 0 + 9 + k], axis=-1).astype(np.uint8),
            "depth": depth,
            "edges": (x == 3).astype(np.uint8),
            "calib": np.eye(3) * 500,
            "mask_invalid": invalid,
            "mask_transp": transp,
            "mask_wall": plane if k == 0 else np.zeros((0, 0)),
            "mask_wall_paras": np.array([[0.0, 0.0, 1.0, 2.0]]) if k == 0 else np.zeros((0, 0)),
            "name": name,
        }
        path = folder / f"{name}.mat"
        scipy.io.savemat(path, {"data": data}, do_compression=k == 0)
        # The header's text holds the date; the file is to be the same each time.
        whole = path.read_bytes()
        path.write_bytes(b"MATLAB 5.0 MAT-file, made up".ljust(116) + whole[116:])
    (OUT / "ibims/imagelist.txt").write_text("office_02\ncorridor_01\n")


nyu_frame()
nyu_bundle()
ibims()
