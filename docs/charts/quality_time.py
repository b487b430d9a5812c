#!/usr/bin/env python3
"""Draws quality against time: assets/quality_time.png from the points of quality_time.csv beside this file.

    pip install matplotlib
    python docs/charts/quality_time.py                                # draw
    cargo build --release --example complete
    python docs/charts/quality_time.py --measure --machine "two cores (CPU)"   # measure the points on this machine, then draw

A point is one plan on the bundled frame (640x480, 500 points): least time of some runs with the checkpoint already loaded, and the mean absolute
error over pixels that were not measured. `--model NAME=DIR` measures another checkpoint beside the embedded one.
"""

import argparse
import csv
import json
import pathlib
import subprocess
import tempfile

HERE = pathlib.Path(__file__).parent
ROOT = HERE.parents[1]
POINTS = HERE / "quality_time.csv"
CHART = ROOT / "assets" / "quality_time.png"
FIELDS = ["name", "plan", "asked", "seconds", "mae_m"]
PLANS = ["budget:1024", "budget:6144", "stride:8", "stride:4", "stride:2", "every"]


def complete(program, model, plan, runs):
    """The fastest of some runs of `complete`, as the object that it prints."""
    best = None
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as out:
            command = [program, "--json", "--plan", plan, "--model", model, "--out", out]
            run = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        if best is None or run["seconds"]["total"] < best["seconds"]["total"]:
            best = run
    return best


def measure(args):
    rows = []
    for name, model in [("sdim-tiny", "tiny")] + [m.split("=", 1) for m in args.model]:
        for plan in args.plans:
            run = complete(args.program, model, plan, args.runs)
            point = [name, plan, run["asked"], f"{run['seconds']['total']:.3f}", f"{run['mae']:.4f}"]
            print(*point, flush=True)
            rows.append(point)
    rows.append(["nearest", "", "", "", f"{run['nearest']['mae']:.4f}"])
    with open(POINTS, "w", newline="") as file:
        file.write(f"# {args.machine}\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(FIELDS)
        writer.writerows(rows)


def read():
    """The machine, and the rows."""
    lines = POINTS.read_text().splitlines()
    return lines[0].lstrip("# "), list(csv.DictReader(lines[1:]))


def draw():
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    machine, rows = read()
    figure, axes = pyplot.subplots(figsize=(7.2, 3.6), dpi=110)
    timed = [r for r in rows if r["seconds"]]
    for number, name in enumerate(dict.fromkeys(r["name"] for r in timed)):
        # Names of plans stand above the first checkpoint's points and below the next one's.
        beside = (0, 7) if number % 2 == 0 else (0, -14)
        points = sorted((float(r["seconds"]), float(r["mae_m"]), r["plan"]) for r in timed if r["name"] == name)
        axes.plot(*zip(*[p[:2] for p in points]), "o-", label=name)
        for seconds, error, plan in points:
            axes.annotate(plan, (seconds, error), textcoords="offset points", xytext=beside, ha="center", fontsize=8)
    for row in rows:
        if not row["seconds"]:
            axes.axhline(float(row["mae_m"]), linestyle="--", color="grey", linewidth=1)
            axes.annotate(f"{row['name']} (no model)", (0.01, float(row["mae_m"])), xycoords=("axes fraction", "data"),
                          textcoords="offset points", xytext=(0, 4), fontsize=8, color="grey")
    seconds = [float(r["seconds"]) for r in timed]
    axes.set_xscale("log")
    axes.set_xlim(0.6 * min(seconds), 1.7 * max(seconds))
    axes.set_ylim(0, 1.15 * max(float(r["mae_m"]) for r in rows))
    axes.xaxis.set_major_locator(LogLocator(subs=[1, 2, 5]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(f"seconds per frame, {machine}")
    axes.set_ylabel("mean absolute error, metres")
    axes.set_title("Bundled frame, 640x480, 500 measured pixels", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", fontsize=9)
    figure.tight_layout()
    # No date or version inside: the same points give the same bytes.
    figure.savefig(CHART, metadata={"Software": None})


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--measure", action="store_true", help="measure the points before drawing")
    parser.add_argument("--machine", help="what the times were measured on, for the axis (with --measure)")
    parser.add_argument("--program", default=str(ROOT / "target/release/examples/complete"))
    parser.add_argument("--model", action="append", default=[], metavar="NAME=DIR", help="another checkpoint; several times")
    parser.add_argument("--plans", type=lambda text: text.split(","), default=PLANS)
    parser.add_argument("--runs", type=int, default=5)
    args = parser.parse_args()
    if args.measure:
        if not args.machine:
            parser.error("--measure needs --machine, which stands at the chart's axis")
        measure(args)
    draw()


if __name__ == "__main__":
    main()
