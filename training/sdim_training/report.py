"""What a run shows of itself: curve.csv, its picture, and sample pictures. `python -m sdim_training.report curve.csv`."""

import csv
import struct
import sys
import zlib
from pathlib import Path

import numpy as np


class Curve:
    """Rows of curve.csv. Going on after `step` drops what was written of later steps."""

    def __init__(self, path, columns, step):
        self.path, self.columns = path, columns
        rows = [r for r in read(path) if int(r["step"]) <= step] if step and path.exists() else []
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, columns, restval="", extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)

    def add(self, **row):
        with open(self.path, "a", newline="") as file:
            row = {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()}
            csv.DictWriter(file, self.columns, restval="").writerow(row)


def read(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def draw(path):
    """curve.png beside curve.csv: the loss, and the held-out error by interpolation's. False without matplotlib."""
    try:
        import matplotlib

        matplotlib.use("agg")
        from matplotlib import pyplot
    except ImportError:
        return False
    rows, (figure, axes) = read(path), pyplot.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for name in rows[0] if rows else ():
        if name in ("loss", "l1") or name.startswith(("ratio_", "geometric_")):
            points = [(int(r["step"]), float(r[name])) for r in rows if r[name]]
            axes[0 if name in ("loss", "l1") else 1].plot(*(zip(*points) if points else ([], [])), ".-", label=name)
    axes[0].set_yscale("log")
    axes[1].set_ylabel("held-out error by interpolation's")
    for axis in axes:
        axis.set_xlabel("step")
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend()
    figure.savefig(path.with_suffix(".png"), dpi=90)
    pyplot.close(figure)
    return True


def png(path, picture):
    """Writes u8 [h, w, 3]."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width, _ = picture.shape
    lines = np.concatenate([np.zeros((height, 1), np.uint8), picture.reshape(height, -1)], 1).tobytes()
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (b"IHDR", header), (b"IDAT", zlib.compress(lines, 6)), (b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*p) for p in parts))


# Near is warm, far is cold.
STOPS = np.array([[140, 15, 35], [240, 100, 30], [250, 220, 90], [90, 200, 130], [40, 110, 190], [40, 25, 90]], float)


def coloured(values, low, high):
    """u8 colours of numbers between `low` and `high`; what is not a number is black."""
    t = np.nan_to_num((values - low) / max(high - low, 1e-6)).clip(0, 1) * (len(STOPS) - 1)
    colours = np.stack([np.interp(t, np.arange(len(STOPS)), STOPS[:, c]) for c in range(3)], -1)
    return np.where(np.isnan(values)[..., None], 0, colours).astype(np.uint8)


def comparison(batch, answers):
    """One row per frame whose questions form a grid: picture, measurements, hint, answer, truth, error of the answer."""
    rows = []
    for i, answer in enumerate(answers):
        x, y = batch.asked_at[i].long().unbind(-1)
        shape = len(y.unique()), len(x.unique())
        rgb = batch.rgb[i].cpu().numpy()
        step = rgb.shape[1] // shape[1]
        truth, hint, answer = (t.cpu().numpy().reshape(shape) for t in (batch.value[i], batch.hint[i], answer))
        low, high = np.nanpercentile(truth, [1, 99])
        measured = batch.depth[i].cpu().numpy()
        measured = coloured(np.where(measured > 0, measured, np.nan), low, high)
        maps = [coloured(m, low, high) for m in (hint, answer, truth)]
        maps.append(coloured(-np.abs(answer - truth), -0.2 * high, 0.0))
        size = shape[0] * step, shape[1] * step
        maps = [m.repeat(step, 0).repeat(step, 1) for m in maps]
        rows.append(np.concatenate([p[: size[0], : size[1]] for p in (rgb, measured, *maps)], 1))
    return np.concatenate(rows, 0)


def samples(path, pairs):
    """A picture of batches with the answers to them."""
    path.parent.mkdir(exist_ok=True)
    png(path, np.concatenate([comparison(*pair) for pair in pairs], 0))


if __name__ == "__main__":
    for name in sys.argv[1:]:
        if not draw(Path(name)):
            raise SystemExit("matplotlib is not installed")
