#!/usr/bin/env python3
"""Writes tests/fixtures/benchmarks/{hypersim,virtual_kitti}: made-up frames in the formats of the two rendered data sets.

    pip install -r tests/reference/requirements-rendered.txt
    python tests/reference/make_rendered.py [DIRECTORY]

Sizes, names, types and compression are the published ones: of Hypersim those that its own
`code/python/tools/generate_hdf5_from_vrimg.py` writes (`dataset`, float16, gzip 9, 768 x 1024), of Virtual KITTI 2 JPEG and 16-bit
PNG of 1242 x 375. `rendered_expected.json` holds Z of some pixels, by NumPy and the formula of Hypersim's authors (issue 9 of their
repository) from what h5py reads back.
"""

import json
import pathlib
import sys

import h5py
import numpy as np
from PIL import Image

OUT = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else pathlib.Path(__file__).parents[1] / "fixtures/benchmarks")


def jpeg(path, height, width, shade):
    path.parent.mkdir(parents=True, exist_ok=True)
    y, x = np.mgrid[:height, :width]
    picture = np.stack([x * 255 // width, y * 255 // height, np.full_like(x, shade)], -1).astype(np.uint8)
    Image.fromarray(picture).save(path, quality=30)


def planar(distance):
    """Hypersim's distances to Z."""
    height, width, focal = 768, 1024, 886.81
    x = np.linspace(-0.5 * width + 0.5, 0.5 * width - 0.5, width)[None]
    y = np.linspace(-0.5 * height + 0.5, 0.5 * height - 0.5, height)[:, None]
    return distance.astype(np.float64) / np.sqrt(x**2 + y**2 + focal**2) * focal


def hypersim():
    expected = {}
    frames = [("ai_001_001", "cam_00", "0000", 2.5), ("ai_001_001", "cam_01", "0007", 40.0), ("ai_002_003", "cam_00", "0012", 1.0)]
    for scene, camera, number, metres in frames:
        images = OUT / f"hypersim/{scene}/images"
        distance = np.full((768, 1024), metres, np.float32)
        distance[384:] = 2 * metres
        # No surface, and what lies beyond what 16 bits can hold.
        distance[:64, :256], distance[:64, 256:320] = np.nan, 1e6
        path = images / f"scene_{camera}_geometry_hdf5/frame.{number}.depth_meters.hdf5"
        path.parent.mkdir(parents=True, exist_ok=True)
        with np.errstate(over="ignore"), h5py.File(path, "w") as file:
            file.create_dataset("dataset", data=distance.astype(np.float16), compression="gzip", compression_opts=9)
        kind = "color" if camera == "cam_01" else "tonemap"
        jpeg(images / f"scene_{camera}_final_preview/frame.{number}.{kind}.jpg", 768, 1024, int(metres))
        with h5py.File(path) as file:
            z = planar(file["dataset"][:])
        rng = np.random.default_rng(int(number))
        places = [(0, 100), (1023, 767), (511, 383), (512, 384), (10, 10), (300, 10), (256, 63), (0, 767)]
        places += [(int(rng.integers(1024)), int(rng.integers(768))) for _ in range(40)]
        expected[f"{scene}-{camera}-{number}"] = [[x, y, float(z[y, x]) if np.isfinite(z[y, x]) else None] for x, y in places]
    (OUT / "rendered_expected.json").write_text(json.dumps(expected).replace("], [", "],\n["))
    # Another file of the same frame, which is not read.
    other = OUT / "hypersim/ai_001_001/images/scene_cam_00_geometry_hdf5/frame.0000.render_entity_id.hdf5"
    with h5py.File(other, "w") as file:
        file.create_dataset("dataset", data=np.full((768, 1024), 3, np.int16), compression="gzip", compression_opts=9)


def virtual_kitti():
    for scene, variation, camera, number in [
        ("Scene01", "15-deg-left", "Camera_0", "00000"),
        ("Scene01", "15-deg-left", "Camera_1", "00000"),
        ("Scene20", "fog", "Camera_0", "00003"),
    ]:
        frames = OUT / f"virtual_kitti/{scene}/{variation}/frames"
        jpeg(frames / f"rgb/{camera}/rgb_{number}.jpg", 375, 1242, 20)
        centimetres = np.full((375, 1242), 1234, np.uint16)
        # The sky, what is nearly as far, and a car.
        centimetres[:100], centimetres[100:110], centimetres[200:300, 500:700] = 65535, 65534, 705
        path = frames / f"depth/{camera}/depth_{number}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(centimetres).save(path)


if __name__ == "__main__":
    hypersim()
    virtual_kitti()
