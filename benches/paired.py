#!/usr/bin/env python3
"""What a change cost: the same frames in two results of `evaluate`, difference by difference.

    python benches/paired.py RESULTS_F32 RESULTS_INT8 [--method sdim-tiny]

Prints, for each number of points, the mean error of the first, the mean of (second - first) over frames, and its 95 % interval
(bootstrap over frames, 10,000 draws, seed 0). Needs nothing but Python.
"""

import argparse
import csv
import pathlib
import random


def read(folder, method, metric):
    with open(folder / "frames.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["method"] == method]
    return {(int(row["points"]), row["frame"]): float(row[metric]) for row in rows}


def interval(values):
    draw = random.Random(0)
    means = sorted(sum(draw.choices(values, k=len(values))) / len(values) for _ in range(10_000))
    return means[250], means[-251]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=pathlib.Path)
    parser.add_argument("second", type=pathlib.Path)
    parser.add_argument("--method", default="sdim-tiny")
    args = parser.parse_args()
    for metric in ["mae", "abs_rel"]:
        first, second = (read(folder, args.method, metric) for folder in (args.first, args.second))
        if not first or first.keys() != second.keys():
            parser.exit(1, f"not the same frames of {args.method}: {len(first)} and {len(second)}\n")
        for points in sorted({points for points, _ in first}):
            frames = [key for key in first if key[0] == points]
            differences = [second[key] - first[key] for key in frames]
            mean, (low, high) = sum(differences) / len(frames), interval(differences)
            base = sum(first[key] for key in frames) / len(frames)
            print(f"{metric:8} {points:5} points: {base:.5f} {mean:+.5f} ({low:+.5f} to {high:+.5f})")


main()
