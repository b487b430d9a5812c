#!/usr/bin/env python3
"""Writes tests/fixtures/sensors: what OpenCV makes of points, pixels and raw frames, and NumPy of clouds.

    pip install -r tests/reference/requirements.txt
    python tests/reference/make_sensors.py [DIRECTORY]

`cameras.json`: for lens models and a pose, points with the pixels that `projectPoints` gives them, and pixels with the rays that
`undistortPoints` finds. `frames.json`: raw bytes (hexadecimal) with the RGB of `cvtColor`; Bayer patterns are made of a part of
`assets/example/rgb.png`. `clouds.json`: structured arrays, each as the fields, bytes and points of a PointCloud2.
"""

import json
import pathlib
import sys

import cv2
import numpy as np

ROOT = pathlib.Path(__file__).parents[2]
OUT = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "tests/fixtures/sensors")
SIZE = (640, 480)
K = np.array([[420.0, 0.0, 325.5], [0.0, 415.0, 236.25], [0.0, 0.0, 1.0]])
LENSES = [
    ("plumb_bob", []),
    ("plumb_bob", [-0.28, 0.08, 0.0012, -0.0007, -0.009]),
    ("plumb_bob", [0.12, -0.21, -0.003, 0.002]),
    ("rational_polynomial", [0.52, -2.72, 0.0006, -0.0002, 1.57, 0.4, -2.54, 1.5]),
    ("equidistant", [-0.021, 0.0043, -0.0031, 0.0004]),
]
# Column and row of the part of the picture, its width and height.
PART = (150, 110, 40, 30)
# OpenCV names a pattern by the second row's second and third pixel; the mapping is that of ROS's cv_bridge.
PATTERNS = {
    "bayer_rggb8": ((0, 0), cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": ((1, 1), cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": ((0, 1), cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": ((1, 0), cv2.COLOR_BayerGB2RGB),
}


def write(name, value):
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / name).write_text("[\n" + ",\n".join(json.dumps(v) for v in value) + "\n]\n")


def rounded(values, digits):
    return [[round(float(v), digits) for v in row] for row in np.asarray(values).reshape(len(values), -1)]


def camera(rng, model, d):
    rotation, translation = np.array([0.02, -0.05, 0.03]), np.array([0.12, -0.25, 0.05])
    pixels = rng.uniform((0, 0), SIZE, (24, 2))
    coefficients = np.array(d) if d else np.zeros(4)
    points_in = pixels.reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    if model == "equidistant":
        rays = cv2.fisheye.undistortPoints(points_in, K, coefficients, criteria=criteria)
    else:
        rays = cv2.undistortPointsIter(points_in, K, coefficients, np.eye(3), np.eye(3), criteria)
    rays = rays.reshape(-1, 2)
    rows = cv2.Rodrigues(rotation)[0]
    # Points in the LiDAR's axes that lie on those rays.
    seen = np.column_stack([rays, np.ones(len(rays))]) * rng.uniform(0.5, 40, (len(rays), 1))
    points = np.array(rounded((seen - translation) @ rows, 5))
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    found = project(points.reshape(-1, 1, 3), rotation.reshape(3, 1), translation.reshape(3, 1), K, coefficients)[0]
    return {
        "model": model, "d": d, "k": K.ravel().tolist(), "size": SIZE,
        "lidar_to_camera": np.column_stack([rows, translation]).tolist(),
        "points": points.tolist(), "projected": rounded(found, 4), "pixels": rounded(pixels, 4),
        "rays": rounded(rays_of(model, rounded(pixels, 4), coefficients, criteria), 7),
    }


def rays_of(model, pixels, d, criteria):
    points = np.array(pixels).reshape(-1, 1, 2)
    if model == "equidistant":
        return cv2.fisheye.undistortPoints(points, K, d, criteria=criteria)
    return cv2.undistortPointsIter(points, K, d, np.eye(3), np.eye(3), criteria)


def mosaic(rgb, red):
    """A sensor's raw frame: at each pixel the one colour that its filter lets through."""
    y, x = np.mgrid[: rgb.shape[0], : rgb.shape[1]]
    in_column, in_row = x % 2 == red[0], y % 2 == red[1]
    channel = np.where(in_column & in_row, 0, np.where(in_column | in_row, 1, 2))
    return np.take_along_axis(rgb, channel[..., None], 2)[..., 0]


def frames(rng):
    for name, code in [("yuv422", cv2.COLOR_YUV2RGB_UYVY), ("yuv422_yuy2", cv2.COLOR_YUV2RGB_YUY2)]:
        raw = rng.integers(0, 256, (8, 12, 2), dtype=np.uint8)
        yield {"encoding": name, "size": [12, 8], "raw": raw.tobytes().hex(), "rgb": cv2.cvtColor(raw, code).tobytes().hex()}
    x, y, width, height = PART
    picture = cv2.imread(str(ROOT / "assets/example/rgb.png"))[y : y + height, x : x + width, ::-1]
    for name, (red, code) in PATTERNS.items():
        raw = mosaic(picture, red)
        rgb = cv2.cvtColor(raw, code)
        yield {"encoding": name, "part": PART, "raw": raw.tobytes().hex(), "rgb": rgb.tobytes().hex()}


def clouds(rng):
    xyz = rng.uniform(-20, 20, (6, 3)).astype(np.float32)
    for order in "<>":
        for kind, offsets, size in [("f4", (0, 4, 8), 12), ("f4", (16, 4, 20), 32), ("f8", (8, 0, 16), 26)]:
            layout = {"names": ["x", "y", "z"], "formats": [order + kind] * 3, "offsets": offsets, "itemsize": size}
            array = np.zeros(len(xyz), dtype=np.dtype(layout))
            for i, name in enumerate("xyz"):
                array[name] = xyz[:, i]
            yield {
                "is_bigendian": order == ">", "datatype": 7 if kind == "f4" else 8, "offsets": offsets, "point_step": size,
                "data": array.tobytes().hex(), "points": xyz.astype(float).tolist(),
            }


def main():
    rng = np.random.default_rng(14)
    write("cameras.json", [camera(rng, model, d) for model, d in LENSES])
    write("frames.json", list(frames(rng)))
    write("clouds.json", list(clouds(rng)))


main()
