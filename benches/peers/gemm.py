#!/usr/bin/env python3
"""Times PyTorch's bf16 `F.linear` and this crate's packed products in turn, on the same machine.

    pip install torch
    python benches/peers/gemm.py --threads 1 --rounds 5
    python benches/peers/gemm.py --shapes 256x512 --rows 64 --ours "cargo bench -q --bench gemm --"

Each round times PyTorch, then ours, shape by shape; the least time of all rounds counts. PyTorch takes and gives bf16; ours takes and gives f32,
its conversions included. With one thread both count processor time, else time on the wall. `gate-` formats stand against
`silu(F.linear(x, g)) * F.linear(x, u)`. Prints one JSON object: times in seconds, the ratio of each, and their geometric mean.
"""

import argparse
import json
import math
import shlex
import subprocess
import time

import torch
from torch.nn.functional import linear, silu


def clock(threads):
    return time.process_time() if threads == 1 else time.perf_counter()


def torch_seconds(k, m, n, gate, threads, seconds):
    x, w, u = torch.randn(n, k).bfloat16(), torch.randn(m, k).bfloat16(), torch.randn(m if gate else 1, k).bfloat16()
    least, runs, start = math.inf, 0, time.perf_counter()
    with torch.inference_mode():
        while runs < 3 or time.perf_counter() - start < seconds:
            begin = clock(threads)
            out = silu(linear(x, w)) * linear(x, u) if gate else linear(x, w)
            least, runs = min(least, clock(threads) - begin), runs + 1
            del out
    return least


def our_seconds(command, shape, rows, formats, threads, seconds):
    command = shlex.split(command) + ["--shapes", shape, "--rows", ",".join(map(str, rows)), "--formats",
                                      ",".join(formats), "--threads", str(threads), "--seconds", str(seconds)]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    found = (json.loads(line) for line in lines if line.startswith("{"))
    return {(line["format"], line["n"]): line["seconds"] for line in found}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", default="2048x2048,2048x11008,11008x2048,1280x3840,1280x3420,256x512", help="inputs x outputs")
    parser.add_argument("--rows", default="1,64,256,1024", help="rows multiplied at once")
    parser.add_argument("--formats", default="bf16,int8", help="of: bf16, int8, gate-bf16, gate-int8")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=0.3, help="to repeat each product for, in each round")
    parser.add_argument("--ours", default="cargo bench -q --bench gemm --", help="how to run this crate's bench")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    rows, formats = [int(n) for n in args.rows.split(",")], args.formats.split(",")
    theirs, ours = {}, {}
    for _ in range(args.rounds):
        for shape in args.shapes.split(","):
            k, m = map(int, shape.split("x"))
            for gate in sorted({f.startswith("gate-") for f in formats}):
                for n in rows:
                    key = shape, gate, n
                    seconds = torch_seconds(k, m, n, gate, args.threads, args.seconds)
                    theirs[key] = min(theirs.get(key, math.inf), seconds)
            for (form, n), seconds in our_seconds(args.ours, shape, rows, formats, args.threads, args.seconds).items():
                key = shape, form, n
                ours[key] = min(ours.get(key, math.inf), seconds)
    products = []
    for (shape, form, n), seconds in ours.items():
        reference = theirs[shape, form.startswith("gate-"), n]
        products.append({"shape": shape, "rows": n, "format": form, "seconds": seconds, "torch_bf16_seconds": reference,
                         "ratio": reference / seconds})
    means = {form: math.exp(sum(math.log(p["ratio"]) for p in products if p["format"] == form) /
                            max(1, sum(p["format"] == form for p in products))) for form in formats}
    print(json.dumps({"torch": torch.__version__, "threads": args.threads, "rounds": args.rounds,
                      "geometric_mean_ratio": means, "products": products}, indent=1))


if __name__ == "__main__":
    main()
