#!/usr/bin/env bash
# Runs this crate and PyTorch + transformers on the same random model, and prints both with their ratio.
#
#   benches/peers/compare.sh                                                          3B shapes on the CPU
#   benches/peers/compare.sh --device cuda:0 --queries 4096 --batch 2048 --rounds 3
#   benches/peers/compare.sh --shapes tiny --width 96 --height 64                     small enough for a look
#
# Options are those that `examples/throughput` and shared_prefix.py have in common, --shapes for its --random. What one of them alone
# shall get stands in OURS_ARGS or PEER_ARGS (`PEER_ARGS="--batch 512 --attention flash_attention_2"`). OURS names the program if it is
# not to be built, PYTHON the interpreter. Answers are given in digits and in number tokens.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
python=${PYTHON:-python3}
theirs=("$@")
ours=()
for argument in "$@"; do
    ours+=("${argument/#--shapes/--random}")
done
[[ " $* " == *" --shapes"* ]] || ours+=(--random 3b)
[[ " $* " == *" --numbers"* ]] || { ours+=(--numbers digits,bins) && theirs+=(--numbers digits,bins); }
if [ -z "${OURS:-}" ]; then
    features=()
    [[ " $* " != *" cuda"* ]] || features=(--features cuda)
    cd "$here/../.."
    cargo build --quiet --release "${features[@]}" --example throughput
    OURS=${CARGO_TARGET_DIR:-target}/release/examples/throughput
fi
logs=$(mktemp -d)
trap 'rm -rf "$logs"' EXIT
# One after the other, so that neither waits for the other's memory or cores.
# shellcheck disable=SC2086
"$OURS" --json "${ours[@]}" ${OURS_ARGS:-} >"$logs/ours"
# shellcheck disable=SC2086
"$python" "$here/shared_prefix.py" "${theirs[@]}" ${PEER_ARGS:-} >"$logs/peer"
"$python" - "$logs/ours" "$logs/peer" <<'PYTHON'
import json
import sys


def read(path):
    lines = (json.loads(line) for line in open(path) if line.startswith("{"))
    return {(line["numbers"], line["queries"]): line for line in lines}


def row(who, o):
    held = o.get("device_memory_bytes") or o["peak_rss_bytes"]
    cells = (o["vision_s"], o["prefill_s"], o["queries_s"], o["frame_s"])
    return f"  {who:12}" + "".join(f"{s:10.4f}" for s in cells) + f"{o['queries_per_second']:12.1f}{held * 1e-9:10.2f}"


ours, theirs = map(read, sys.argv[1:])
peer = next(iter(theirs.values()), {})
print(f"torch {peer.get('torch')}, transformers {peer.get('transformers')}, {peer.get('attention')}")
print(f"{'':14}{'vision s':>10}{'prefix s':>10}{'queries s':>10}{'frame s':>10}{'queries/s':>12}{'GB':>10}")
for key, o in ours.items():
    p = theirs.get(key)
    print(f"{key[1]} queries, {key[0]}: {o['tokens_per_query']} tokens each, {o['prompt_tokens']} in the prefix")
    print(row("this crate", o))
    if p:
        print(row("PyTorch", p))
        times = [p[k] / max(o[k], 1e-9) for k in ("vision_s", "prefill_s", "queries_s", "frame_s")]
        print("  " + f"{'ratio':12}" + "".join(f"{r:10.2f}" for r in times))
PYTHON
