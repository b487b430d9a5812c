"""Lines of the table of run.sh: `frame LOG` of a JSON object, `model LOG` of one or more, `operations LOG LOG` of our
kernels and of candle's, `maps A B` of two .npy files of depths."""

import array
import json
import math
import struct
import sys


def loaded(path):
    with open(path) as file:
        return json.loads(file.read().strip().splitlines()[-1])


def memory(o):
    held = o.get("device_memory_bytes")
    return f", device {held / 1e9:.2f} GB" if held else ""


def frame(path):
    o = loaded(path)
    s = o["seconds"]
    stages = " ".join(f"{key} {s[key]:.3f}" for key in ("encode", "prefill", "queries", "refine", "total"))
    print(f"    MAE {o['mae']:.5f} m, {o['asked']} asked, {o['queries_per_second']:.0f}/s; load {s['load']:.2f} first {s['first_total']:.3f}; {stages} s{memory(o)}")


def model(path):
    with open(path) as file:
        lines = [json.loads(line) for line in file if line.startswith("{")]
    for o in lines:
        print(
            f"    load {o['load_s']:.1f} s, vision {o['vision_s']:.4f} s, prefix of {o['prompt_tokens']} {o['prefill_s']:.4f} s, "
            f"{o['queries']} in {o['numbers']} at {o['queries_per_second']:.0f} queries/s, {o['gflops'] / 1e3:.0f} TFLOP/s, "
            f"{o['frame_s']:.3f} s a frame{memory(o)}"
        )


def operations(*paths):
    found = []
    for path in paths:
        with open(path) as file:
            found.append({name.strip(): float(ms.split()[0]) for name, ms in (line.rsplit("  ", 1) for line in file if line.endswith(" ms\n"))})
    for name, ours in found[0].items():
        other = found[1].get(name, math.nan)
        print(f"    {name:10} {ours:7.3f} ms, candle's {other:7.3f} ms, {other / ours:.1f} times")


def depths(path):
    with open(path, "rb") as file:
        head = file.read(10)
        file.read(struct.unpack("<H", head[8:10])[0])
        values = array.array("f")
        values.frombytes(file.read())
    return values


def maps(a, b):
    a, b = depths(a), depths(b)
    assert len(a) == len(b), (len(a), len(b))
    off = sorted(abs(x - y) for x, y in zip(a, b) if not (math.isnan(x) and math.isnan(y)))
    unread = sum(math.isnan(v) for v in off)
    at = lambda share: off[min(len(off) - 1, int(share * len(off)))]
    print(f"mean {sum(off) / len(off):.2e} m, 99 % within {at(0.99):.2e}, 99.99 % {at(0.9999):.2e}, most {off[-1]:.2e} m, {unread} unread on one side")


try:
    {"frame": frame, "model": model, "maps": maps, "operations": operations}[sys.argv[1]](*sys.argv[2:])
except (OSError, ValueError, KeyError, IndexError) as error:
    print(f"    nothing to report: {type(error).__name__} {error}"[:160])
