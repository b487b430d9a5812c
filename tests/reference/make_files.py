#!/usr/bin/env python3
"""Writes tests/fixtures/files: depth images, pictures, clouds and calibrations as the field's own tools write them.

    pip install -r tests/reference/requirements-files.txt
    python tests/reference/make_files.py [DIRECTORY]

`expected.json` holds what each of them says, computed by NumPy.
"""

import json
import pathlib
import sys

import numpy as np
import OpenEXR
import open3d
import plyfile
import png
import pypcd4
import tifffile
import yaml
from PIL import Image

OUT = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else pathlib.Path(__file__).parents[1] / "fixtures/files")


def depth_files(expected):
    """A map of 5 x 4 pixels in every container; 0 is missing. Integers are millimetres."""
    metres = np.linspace(0.5, 10.0, 20, dtype=np.float32).reshape(4, 5)
    metres[1, 2] = 0.0
    millimetres = np.round(metres.astype(np.float64) * 1000).astype(np.int64)
    expected["metres"] = metres.ravel().tolist()
    expected["millimetres"] = millimetres.ravel().tolist()

    (OUT / "depth").mkdir(parents=True, exist_ok=True)
    for name in ["f2", "f4", "f8"]:
        np.save(OUT / f"depth/{name}.npy", metres.astype(f"<{name}"))
    for name in ["i2", "i4", "i8", "u2", "u4", "u8"]:
        np.save(OUT / f"depth/{name}.npy", millimetres.astype(f"<{name}"))
    np.save(OUT / "depth/big_f4.npy", metres.astype(">f4"))
    np.save(OUT / "depth/big_u2.npy", millimetres.astype(">u2"))
    np.save(OUT / "depth/fortran_f4.npy", np.asfortranarray(metres))
    np.save(OUT / "depth/first_axis_f4.npy", metres[None])
    np.save(OUT / "depth/last_axis_f4.npy", metres[..., None])
    for version in [(2, 0), (3, 0)]:
        with open(OUT / f"depth/version_{version[0]}_f4.npy", "wb") as file:
            np.lib.format.write_array(file, metres, version)
    np.savez(OUT / "depth/stored_two_f4.npz", depth=metres, other=metres * 2)
    np.savez_compressed(OUT / "depth/deflated_one_f4.npz", depth=metres)
    np.savez_compressed(OUT / "depth/deflated_one_u2.npz", depth=millimetres.astype(np.uint16))

    rows = np.stack([millimetres, np.full_like(millimetres, 65535)], axis=-1).reshape(4, 10)
    with open(OUT / "depth/alpha_u2.png", "wb") as file:
        png.Writer(5, 4, greyscale=True, alpha=True, bitdepth=16).write(file, rows.tolist())
    short = Image.fromarray(millimetres.astype(np.uint16))
    for compression in ["raw", "tiff_lzw", "tiff_adobe_deflate"]:
        short.save(OUT / f"depth/pillow_{compression}_u2.tif", compression=compression)
    Image.fromarray(metres).save(OUT / "depth/pillow_f4.tif")
    tifffile.imwrite(OUT / "depth/tiles_big_f4.tif", metres, byteorder=">", tile=(16, 16))
    tifffile.imwrite(OUT / "depth/plain_f8.tiff", metres.astype(np.float64))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Z": metres}) as file:
        file.write(str(OUT / "depth/zip_f4.exr"))
    with OpenEXR.File(header | {"compression": OpenEXR.PIZ_COMPRESSION}, {"Y": metres.astype(np.float16)}) as file:
        file.write(str(OUT / "depth/piz_f2.exr"))
    with OpenEXR.File(header, {"RGB": np.stack([metres * 3] * 3, axis=-1), "Z": metres}) as file:
        file.write(str(OUT / "depth/colours_f4.exr"))


def pictures(expected):
    y, x = np.mgrid[:6, :7]
    rgb = np.stack([x * 36, y * 50, (x + y) * 20], axis=-1).astype(np.uint8)
    expected["picture"] = {"width": 7, "height": 6, "rgb": rgb.ravel().tolist()}
    (OUT / "pictures").mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(rgb)
    image.save(OUT / "pictures/picture.webp", lossless=True)
    image.save(OUT / "pictures/picture.bmp")
    image.save(OUT / "pictures/picture.tif", compression="tiff_lzw")


def clouds(expected):
    rng = np.random.default_rng(14)
    points = rng.uniform(-20, 20, (30, 3)).astype(np.float32)
    normals = rng.normal(size=(30, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    colours = rng.integers(0, 256, (30, 3)).astype(np.uint8)
    expected["cloud"] = {"points": points.tolist(), "normals": normals.tolist(), "colours": colours.tolist()}
    folder = OUT / "clouds"
    folder.mkdir(parents=True, exist_ok=True)

    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(points.astype(np.float64))
    cloud.normals = open3d.utility.Vector3dVector(normals.astype(np.float64))
    cloud.colors = open3d.utility.Vector3dVector(colours / 255.0)
    for name, options in {
        "open3d_ascii.pcd": {"write_ascii": True},
        "open3d_binary.pcd": {},
        "open3d_compressed.pcd": {"compressed": True},
        "open3d_ascii.ply": {"write_ascii": True},
        "open3d_binary.ply": {},
    }.items():
        assert open3d.io.write_point_cloud(str(folder / name), cloud, **options)

    fields = ("intensity", "z", "y", "x")
    data = [np.arange(30, dtype=np.uint16), *points.T[::-1].astype(np.float64)]
    types = (np.uint16, np.float64, np.float64, np.float64)
    mixed = pypcd4.PointCloud.from_points(data, fields, types)
    for encoding in [pypcd4.Encoding.ASCII, pypcd4.Encoding.BINARY, pypcd4.Encoding.BINARY_COMPRESSED]:
        mixed.save(folder / f"pypcd4_{encoding.value.lower()}.pcd", encoding=encoding)

    vertex = np.empty(30, dtype=[("red", "u1"), ("x", "f8"), ("green", "u1"), ("y", "f4"), ("blue", "u1"), ("z", "f4")])
    vertex["x"], vertex["y"], vertex["z"] = points.T
    vertex["red"], vertex["green"], vertex["blue"] = colours.T
    faces = np.empty(2, dtype=[("vertex_indices", "i4", (3,)), ("flags", "u2")])
    faces["vertex_indices"], faces["flags"] = [[0, 1, 2], [1, 2, 3]], 7
    elements = [plyfile.PlyElement.describe(faces, "face"), plyfile.PlyElement.describe(vertex, "vertex")]
    for name, text, order in [("ascii", True, "="), ("little", False, "<"), ("big", False, ">")]:
        plyfile.PlyData(elements, text=text, byte_order=order).write(folder / f"plyfile_{name}.ply")

    np.concatenate([points, rng.uniform(size=(30, 1)).astype(np.float32)], axis=1).tofile(folder / "velodyne.bin")


def calibrations(expected):
    """Rectified cameras 0 to 3 of a made-up KITTI car, and where camera 2 sees points of the Velodyne."""
    folder = OUT / "calibrations"
    folder.mkdir(parents=True, exist_ok=True)
    k = np.array([[721.5, 0, 609.6], [0, 721.5, 172.9], [0, 0, 1]])
    offsets = [[0, 0, 0], [-0.537, 0, 0], [0.06, -0.0003, 0.0027], [-0.47, 0.002, 0.003]]
    projections = [k @ np.hstack([np.eye(3), np.array(o)[:, None]]) for o in offsets]

    def rotation(x, y, z):
        (cx, cy, cz), (sx, sy, sz) = np.cos([x, y, z]), np.sin([x, y, z])
        return (
            np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
            @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
            @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        )

    rectifying = rotation(0.008, -0.009, 0.007)
    axes = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]) @ rotation(0.014, 0.002, -0.007)
    velodyne = np.hstack([axes, [[-0.004], [-0.076], [-0.272]]])
    whole = np.vstack([velodyne, [0, 0, 0, 1]])
    wide = np.eye(4)
    wide[:3, :3] = rectifying

    def text(matrix):
        return " ".join(f"{v:.12e}" for v in np.ravel(matrix))

    lines = [f"P{i}: {text(p)}" for i, p in enumerate(projections)]
    odometry = lines + [f"Tr: {text((wide @ whole)[:3])}"]
    (folder / "odometry").mkdir(exist_ok=True)
    (folder / "odometry/calib.txt").write_text("\n".join(odometry) + "\n")
    objects = lines + [f"R0_rect: {text(rectifying)}", f"Tr_velo_to_cam: {text(velodyne)}", f"Tr_imu_to_velo: {text(np.eye(4)[:3])}"]
    (folder / "object").mkdir(exist_ok=True)
    (folder / "object/000001.txt").write_text("\n".join(objects) + "\n\n")
    raw = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    for i, p in enumerate(projections):
        raw += [f"S_{i:02}: 1.392000e+03 5.120000e+02", f"K_{i:02}: {text(k)}", f"D_{i:02}: {text(np.zeros(5))}"]
        raw += [f"R_{i:02}: {text(np.eye(3))}", f"T_{i:02}: {text(np.zeros(3))}"]
        raw += ["S_rect_%02d: 1.242000e+03 3.750000e+02" % i, f"R_rect_{i:02}: {text(rectifying)}", f"P_rect_{i:02}: {text(p)}"]
    (folder / "raw").mkdir(exist_ok=True)
    (folder / "raw/calib_cam_to_cam.txt").write_text("\n".join(raw) + "\n")
    lidar = ["calib_time: 15-Mar-2012 11:37:16", f"R: {text(velodyne[:, :3])}", f"T: {text(velodyne[:, 3])}", "delta_f: 0 0", "delta_c: 0 0"]
    (folder / "raw/calib_velo_to_cam.txt").write_text("\n".join(lidar) + "\n")

    points = np.array([[10.0, 1.0, -0.5], [25.0, -6.0, 1.0], [5.0, 0.2, -1.4]])
    seen = projections[2] @ wide @ whole @ np.hstack([points, np.ones((3, 1))]).T
    expected["kitti"] = {"points": points.tolist(), "pixels": (seen[:2] / seen[2]).T.tolist(), "depths": seen[2].tolist()}

    message = {
        "header": {"stamp": {"sec": 3, "nanosec": 4}, "frame_id": "camera"},
        "height": 480,
        "width": 640,
        "distortion_model": "plumb_bob",
        "d": [-0.28, 0.07, 0.001, -0.0005, 0.0],
        "k": [525.0, 0.0, 319.5, 0.0, 526.0, 239.5, 0.0, 0.0, 1.0],
        "r": np.eye(3).ravel().tolist(),
        "p": [500.0, 0.0, 320.0, 0.0, 0.0, 501.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": 0,
        "roi": {"x_offset": 0, "do_rectify": False},
    }
    (folder / "camera_info.yaml").write_text(yaml.safe_dump(message, sort_keys=False) + "---\n")


def main():
    expected = {}
    depth_files(expected)
    pictures(expected)
    clouds(expected)
    calibrations(expected)
    (OUT / "expected.json").write_text(json.dumps(expected) + "\n")


main()
