#!/usr/bin/env python3
"""Writes tests/fixtures/preprocess: what the reference makes of image files, sizes, limits and pixels.

    pip install -r tests/reference/requirements.txt
    python tests/reference/make_preprocess.py [DIRECTORY]

`resize.json`: rows of width, height, new width, new height and the CRC-32 of Pillow's bicubic and Lanczos resizes of a picture
that `tests/preprocess.rs` computes as `picture()` does here. `limits.json`: preprocessor configs, image sizes, and the grid
that the image processor makes of them, or null where it raises. `files.json`: pixels of image files as `load_image`
reads them, hexadecimal.
"""

import copy
import json
import pathlib
import struct
import sys
import zlib

import numpy as np
import PIL
import transformers
from PIL import Image
from transformers.image_utils import load_image
from transformers.models.qwen2_vl.image_processing_pil_qwen2_vl import Qwen2VLImageProcessorPil

from make_golden import assert_columns_first

OUT = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else pathlib.Path(__file__).parents[1] / "fixtures/preprocess")


def lines(values):
    return "[\n" + ",\n".join(json.dumps(v) for v in values) + "\n]\n"


def mix(x):
    """The finaliser of MurmurHash3."""
    x = x ^ (x >> 16)
    x = x * np.uint32(0x85EBCA6B)
    x = x ^ (x >> 13)
    x = x * np.uint32(0xC2B2AE35)
    return x ^ (x >> 16)


def picture(width, height):
    """Noise, and black and white blocks in it."""
    seed = np.uint32(width * 65536 + height)
    index = np.arange(width * height * 3, dtype=np.uint32)
    noise = (mix(index * np.uint32(0x9E3779B1) + seed) >> 24).astype(np.uint8).reshape(height, width, 3)
    y, x = np.mgrid[:height, :width]
    noise[(x // 5 + y // 7) % 3 == 0] = 0
    noise[(x // 7 + y // 5) % 4 == 0] = 255
    return Image.fromarray(noise, "RGB")


def resizes():
    rng = np.random.default_rng(12)
    sizes = np.exp(rng.uniform(0, np.log(400), (200, 4))).astype(int).tolist()
    sizes += [[w, h, w, max(1, h // 2)] for w, h in rng.integers(1, 90, (10, 2)).tolist()]
    sizes += [[w, h, w * 3 // 2 + 1, h] for w, h in rng.integers(1, 90, (10, 2)).tolist()]
    # The last is that of ScanNet's pictures.
    sizes += [[640, 480, 644, 476], [480, 640, 476, 644], [1, 1, 56, 56], [1, 1, 1, 1], [5, 700, 28, 1400], [2000, 10, 56, 28], [1296, 968, 640, 480]]
    for w, h, new_w, new_h in sizes:
        image = picture(w, h)
        row = [w, h, new_w, new_h]
        for method in [Image.BICUBIC, Image.LANCZOS]:
            assert_columns_first(image, (new_w, new_h), method)
            row.append(zlib.crc32(image.resize((new_w, new_h), method).tobytes()))
        yield row


def limits():
    edges = {"shortest_edge": 28 * 28 * 4, "longest_edge": 28 * 28 * 30}
    configs = [
        {},
        {"min_pixels": 3136, "max_pixels": 12845056},
        {"size": edges},
        # Either limit of its own replaces the edge.
        {"size": edges, "min_pixels": 28 * 28 * 20},
        {"size": edges, "max_pixels": 28 * 28 * 8},
        {"size": {"shortest_edge": 1, "longest_edge": 2}, "min_pixels": 3136, "max_pixels": 28 * 28 * 50},
        {"size": edges, "min_pixels": None, "max_pixels": None},
        {"size": None},
        {"max_pixels": 28 * 28 * 8},
        {"min_pixels": 28 * 28 * 60},
        # A `size` that lacks an edge has no default for it, but may be completed.
        {"size": {"shortest_edge": 3136}},
        {"size": {"longest_edge": 28 * 28 * 30}},
        {"size": {"shortest_edge": 3136}, "max_pixels": 28 * 28 * 8},
        {"size": {}},
        {"size": {"min_pixels": 3136, "max_pixels": 28 * 28 * 8}},
        {"size": {"min_pixels": 3136, "max_pixels": 28 * 28 * 8}, "min_pixels": 3136, "max_pixels": 28 * 28 * 9},
        {"patch_size": 10, "merge_size": 3, "min_pixels": 900, "max_pixels": 90000},
        {"min_pixels": 28 * 28 * 9, "max_pixels": 28 * 28 * 4},
    ]
    sizes = [(480, 640), (1, 1), (20, 30), (1, 200), (200, 1), (1, 201), (402, 2), (1200, 1600), (56, 56)]
    for config in configs:
        grids = []
        for height, width in sizes:
            try:
                processor = Qwen2VLImageProcessorPil.from_dict(copy.deepcopy(config))
                made = processor(images=[Image.new("RGB", (width, height))], return_tensors="np")
                grids.append(made["image_grid_thw"][0].tolist()[1:])
            except (ValueError, TypeError) as error:
                print(f"  {config} {height}x{width}: {error}")
                grids.append(None)
        yield {"config": config, "sizes": sizes, "grids": grids}


def png(width, height, depth, colour, rows, *chunks):
    """A PNG of a kind that Pillow does not write."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    data = zlib.compress(b"".join(b"\0" + row for row in rows))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + b"".join(chunk(*c) for c in chunks) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def files():
    rng = np.random.default_rng(5)
    (OUT / "files").mkdir(parents=True, exist_ok=True)
    for orientation in range(1, 9):
        exif = Image.Exif()
        exif[0x0112] = orientation
        rgb = Image.fromarray(rng.integers(0, 256, (3, 5, 3), dtype=np.uint8), "RGB")
        rgb.save(OUT / f"files/turned_{orientation}.png", exif=exif)
        # Blocks of one grey level each, which every decoder of JPEG reads alike.
        blocks = np.kron(rng.integers(0, 256, (2, 3), dtype=np.uint8), np.ones((8, 8), np.uint8))
        Image.fromarray(blocks, "L").save(OUT / f"files/turned_{orientation}.jpg", exif=exif, quality=100)
    exif[0x0112] = 9
    rgb.save(OUT / "files/turned_out_of_range.png", exif=exif)
    value = lambda *shape: rng.integers(0, 256, shape, dtype=np.uint8)
    made = {
        "grey": Image.fromarray(value(3, 4), "L"),
        "grey_alpha": Image.fromarray(value(3, 4, 2), "LA"),
        "rgba": Image.fromarray(value(3, 4, 4), "RGBA"),
        "bilevel": Image.fromarray(value(3, 4), "L").convert("1"),
        "palette": Image.fromarray(value(3, 4, 3), "RGB").quantize(5),
        "grey_16": Image.fromarray(rng.integers(0, 65536, (3, 4), dtype=np.uint16)),
    }
    for name, image in made.items():
        image.save(OUT / f"files/{name}.png")
    made["palette"].save(OUT / "files/palette_transparent.png", transparency=1)
    Image.fromarray(value(3, 4, 3), "RGB").save(OUT / "files/rgb_transparent.png", transparency=(1, 2, 3))
    wide = lambda channels: [rng.bytes(4 * 2 * channels) for _ in range(3)]
    for name, colour, channels in [("rgb_16", 2, 3), ("rgba_16", 6, 4), ("grey_alpha_16", 4, 2)]:
        (OUT / f"files/{name}.png").write_bytes(png(4, 3, 16, colour, wide(channels)))
    for name, depth in [("grey_2", 2), ("grey_4", 4)]:
        (OUT / f"files/{name}.png").write_bytes(png(4, 3, depth, 0, [rng.bytes(depth // 2) for _ in range(3)]))
    for path in sorted((OUT / "files").iterdir()):
        image = load_image(str(path))
        mode = Image.open(path).mode
        yield {"file": path.name, "mode": mode, "size": list(image.size), "rgb": image.tobytes().hex()}


def main():
    assert transformers.__version__ == "5.23.0" and int(PIL.__version__.split(".")[0]) < 13
    OUT.mkdir(parents=True, exist_ok=True)
    for name, rows in [("resize", resizes()), ("limits", limits()), ("files", files())]:
        rows = list(rows)
        (OUT / f"{name}.json").write_text(lines(rows))
        print(f"{name}: {len(rows)}")


if __name__ == "__main__":
    main()
