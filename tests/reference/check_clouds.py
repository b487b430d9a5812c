#!/usr/bin/env python3
"""Checks that Open3D, plyfile and pypcd4 read the clouds that `complete --cloud-out` writes, and read the same from both formats.

    pip install -r tests/reference/requirements-files.txt
    cargo run --release --example complete -- --intrinsics 500,500,319.5,239.5 --cloud-out out/cloud.ply
    cargo run --release --example complete -- --intrinsics 500,500,319.5,239.5 --cloud-out out/cloud.pcd
    python tests/reference/check_clouds.py out
"""

import pathlib
import sys

import numpy as np
import open3d
import plyfile
import pypcd4

OUT = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else "out")


def by_open3d(path):
    cloud = open3d.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
    assert cloud.has_points() and cloud.has_normals() and cloud.has_colors(), path
    return [np.asarray(a) for a in (cloud.points, cloud.normals, np.asarray(cloud.colors) * 255)]


def by_plyfile(path):
    vertex = plyfile.PlyData.read(path)["vertex"]
    names = [("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue"), ("confidence",)]
    return [np.stack([vertex[n] for n in group], axis=1) for group in names]


def by_pypcd4(path):
    cloud = pypcd4.PointCloud.from_path(path)
    names = [("x", "y", "z"), ("normal_x", "normal_y", "normal_z"), ("confidence",)]
    points, normals, confidence = [cloud.numpy(group) for group in names]
    colours = pypcd4.PointCloud.decode_rgb(cloud.numpy(("rgb",)).ravel())
    return [points, normals, colours, confidence]


def main():
    truth = by_plyfile(OUT / "cloud.ply")
    points, normals, _, confidence = truth
    assert len(points) > 0 and np.isfinite(points).all() and (points[:, 2] > 0).all()
    known = np.isfinite(normals).all(axis=1)
    lengths = np.linalg.norm(normals[known], axis=1)
    assert np.allclose(lengths, 1, atol=1e-5) and ((normals * points).sum(axis=1)[known] < 0).all(), "normals face the camera"
    assert ((confidence >= 0) & (confidence <= 1)).all()
    for found in [by_open3d(OUT / "cloud.ply"), by_open3d(OUT / "cloud.pcd"), by_pypcd4(OUT / "cloud.pcd")]:
        for mine, theirs in zip(truth, found):
            assert np.allclose(mine, theirs, atol=1e-4, equal_nan=True), (mine, theirs)
    print(f"{len(points)} points, {known.sum()} of them with a normal: the same by Open3D, plyfile and pypcd4")


main()
