#!/usr/bin/env bash
# Checks sdim on a CUDA device: answers against the CPU's, the golden tensors, repeats from several threads, times.
#
#   bash tests/gpu/run.sh [SECONDS]     235 if nothing is said; all ends within them, the most important first
#
# Beside it, or in out/: payload.tar.xz of pack.sh. Needs a driver, Python, and CUDA's run-time libraries (PyTorch's wheels have
# them). Prints a table; everything else goes to $OUT.
set -u
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
budget=${1:-235}
out=${OUT:-$here/out/results}
mkdir -p "$out/logs"
table=$out/table.txt
: >"$table"

remaining() { echo $((budget - SECONDS)); }
note() { printf '%s\n' "$*" >>"$table"; }

payload=$here/payload.tar.xz
[ -e "$payload" ] || payload=$here/out/payload.tar.xz
work=$(mktemp -d "${TMPDIR:-/tmp}/sdim-gpu.XXXXXX")
if ! python3 -c 'import sys, tarfile; tarfile.open(sys.argv[1]).extractall(sys.argv[2])' "$payload" "$work" 2>"$out/logs/unpack.log"; then
    tail -n 3 "$out/logs/unpack.log"
    exit 1
fi

# The driver compiles candle's PTX at the first use of each kernel, and keeps what it made here.
export CUDA_CACHE_PATH=$work/ptx CUDA_CACHE_MAXSIZE=4000000000
# Where the tests look for their fixtures.
export CARGO_MANIFEST_DIR=$work
export LD_LIBRARY_PATH=$(python3 "$work/libraries.py")${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}

# check NAME LIMIT COMMAND...: runs it, at most LIMIT seconds and never beyond what is left; a line of the table says how it ended.
check() {
    local name=$1 limit=$2 log=$out/logs/$1.log left began code
    shift 2
    left=$(($(remaining) - 5))
    if [ "$left" -lt 5 ]; then
        note "$(printf '%-22s left out: no time' "$name")"
        return 1
    fi
    [ "$limit" -lt "$left" ] || limit=$left
    began=$(date +%s%N)
    timeout --kill-after=2 "$limit" "$@" >"$log" 2>"$log.err" </dev/null
    code=$?
    local ended=ok
    [ $code = 0 ] || ended="FAILED ($code)"
    [ $code != 124 ] || ended="STOPPED after $limit s"
    note "$(printf '%-22s %-22s %6.1f s' "$name" "$ended" "$(((($(date +%s%N) - began)) / 1000000))e-3")"
    if [ $code != 0 ]; then
        # Of tests, what each said where it panicked; else what looks like an error.
        { grep -ahA3 'panicked at' "$log.err" || grep -ahE 'rror|not found|round' "$log" "$log.err"; } |
            grep -vE '^--$|stack backtrace|RUST_BACKTRACE' | cut -c1-200 | awk '!seen[$0]++' | head -n 14 | sed 's/^/    /' >>"$table"
    fi
    return $code
}

# tests NAME LIMIT PROGRAM [ARGUMENT...]: tests on the device.
tests() {
    local name=$1 limit=$2 program=$3
    shift 3
    check "$name" "$limit" env SDIM_TEST_DEVICE=cuda:0 "$work/bin/test-$program" --nocapture "$@"
    # With what a passing golden test says of its margins.
    grep -ahE '^test result|tensors agree|first ids' "$out/logs/$name.log" 2>/dev/null | cut -c1-170 | sed 's/^/    /' >>"$table"
}

frame() {
    local name=$1 limit=$2
    shift 2
    check "$name" "$limit" "$work/bin/complete" --rgb "$work/assets/example/rgb.png" --sparse "$work/assets/example/sparse.png" \
        --gt "$work/assets/example/gt.png" --depth-scale mm --json --out "$out/maps/$name" "$@" || return 0
    python3 "$work/report.py" frame "$out/logs/$name.log" >>"$table"
}

model() {
    local name=$1 limit=$2
    shift 2
    check "$name" "$limit" "$work/bin/throughput" --device cuda:0 --json "$@" || return 0
    python3 "$work/report.py" model "$out/logs/$name.log" >>"$table"
}

# Milliseconds of each operation, by our kernels and by candle's; a warning that ours are left out stands in the log.
operations() {
    local limit=$1 name
    for name in ours candle; do
        check "operations-$name" "$limit" env SDIM_CUDA_KERNELS=$([ $name = ours ] && echo on || echo off) "$work/bin/throughput" \
            --random 3b --device cuda:0 --batch 2048 --operations 411 || return 0
    done
    python3 "$work/report.py" operations "$out/logs/operations-ours.log" "$out/logs/operations-candle.log" >>"$table"
}

# The same 3B work in PyTorch and here, where transformers is installed. PyTorch copies the prefix for each item of a batch.
peers() {
    local limit=$1
    shift
    if ! python3 -c 'import torch, transformers' 2>"$out/logs/peers-import.log"; then
        note "peers                  left out: $(tail -n 1 "$out/logs/peers-import.log" | cut -c1-100)"
        return 0
    fi
    check peers "$limit" env OURS="$work/bin/throughput" PYTHON=python3 OURS_ARGS="--batch 2048" PEER_ARGS="--batch 1024" \
        bash "$work/benches/peers/compare.sh" "$@" || return 0
    sed 's/^/    /' "$out/logs/peers.log" >>"$table"
}

compare() {
    [ -e "$out/maps/$1/dense.npy" ] && [ -e "$out/maps/$2/dense.npy" ] || return 0
    note "$(printf '    %s against %s: %s' "$2" "$1" "$(python3 "$work/report.py" maps "$out/maps/$1/dense.npy" "$out/maps/$2/dense.npy" 2>&1 | tail -n 1)")"
}

{
    nvidia-smi --query-gpu=name,driver_version,memory.total,memory.used --format=csv,noheader || echo "no nvidia-smi"
    nproc
    ldd "$work/bin/complete" | grep -E 'libcu|not found'
} >"$out/logs/machine.log" 2>&1
note "$(grep -v 'command not found' "$out/logs/machine.log" | head -n 1), $(nproc) CPU cores"
grep 'not found' "$out/logs/machine.log" | sed 's/^/    /' >>"$table"

# One run after the other pays for the kernels that it is the first to use.
frame cpu-f32 20 --device cpu --weights f32 --repeat 2
frame cuda-f32-first 75 --device cuda:0 --weights f32
compare cpu-f32 cuda-f32-first
frame cuda-bf16 40 --device cuda:0 --weights bf16 --repeat 2
compare cpu-f32 cuda-bf16
tests golden 45 golden --skip formats --test-threads 4
tests device 45 device --test-threads 2
# Those unit tests of the kernels that choose their device, `on_device` in src/kernels/testing.rs, with the ones beside them.
tests kernels 25 lib kernels::cuda kernels::fused_tests kernels::attention::batched kernels::ops::norm kernels::ops::rope kernels::ops::bin_rows \
    vlm::qwen2_5::crops model::wide_glimpse
# What lies between the products of a layer of the 3B shapes, with and without our kernels.
operations 30
model 3b-bf16 60 --random 3b --weights bf16 --queries 4096 --batch 2048 --rounds 3
# A frame of 644x476 with one number token for an answer: every fourth column and row, then every pixel.
model 3b-number-tokens 75 --random 3b --weights bf16 --numbers bins --queries 19159,306544 --batch 4096 --rounds 2
peers 75 --device cuda:0 --shapes 3b --queries 4096 --rounds 2
frame stride4-f32 15 --device cuda:0 --weights f32 --plan stride:4 --repeat 4
frame stride4-bf16 15 --device cuda:0 --weights bf16 --plan stride:4 --repeat 4
frame every-bf16 20 --device cuda:0 --weights bf16 --plan every --repeat 3
frame every-f32 20 --device cuda:0 --weights f32 --plan every --repeat 3
tests number_tokens 20 number_tokens
tests shared_prefix 30 shared_prefix
tests fusion 15 fusion
tests complete 25 complete
tests bad_checkpoint 20 bad_checkpoint
frame every-cpu 25 --device cpu --weights f32 --plan every
compare every-cpu every-f32
model 3b-batch512 30 --random 3b --weights bf16 --queries 1024 --batch 512 --rounds 2

cp "$table" "$out/table.full.txt"
head -c 10500 "$table"
printf '%s s of %s; logs in %s\n' "$SECONDS" "$budget" "$out"
rm -rf "$work"
