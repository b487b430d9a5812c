#!/usr/bin/env bash
# A model in ten minutes, on a machine with a GPU, PyTorch and nothing else: no Rust, no network.
#
#   training/run.sh pack                    here: builds and packs what that machine needs (training/out/pack.tar.xz, at most 50 MB)
#   OUT=DIR training/run.sh run [PACK]      there: renders on all cores while it trains; ends within SECONDS_TOTAL
#
# What a run leaves in OUT: log.txt, result.json, curve.csv, curve.png, samples, and the checkpoint in pieces of at most 15 MB:
#   cat OUT/checkpoint.tar.part-* | tar x -C DIR          (DIR/last and DIR/best are checkpoints that the crate loads)
#
# Settings, by the environment, with what they are without it:
#   SECONDS_TOTAL=600  SHAPE=small  SIZE=384x288  PROMPT=512  QUESTIONS=128  VARIANTS=4  SHARD=64  BATCH=64  RATE=1.5e-3
#   POINTS=40,1500  HELD_FRAMES=256  WAIT_FRAMES=1024  MAX_GB=30  SEED=7  GPUS and THREADS: all; PYTHON=python3; WORK: a temporary folder
#   RECORDS_ARGS, TRAIN_ARGS: more arguments for the two programs; INIT: a checkpoint to start from instead of random weights
#   EXTRA (pack): files and folders that the records need; SHAPE and RECORDS_ARGS name them as @extra/NAME
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)

pack() {
    local root out stage host=x86_64-unknown-linux-gnu musl=x86_64-unknown-linux-musl size
    root=$(dirname "$here") out=$here/out stage=$here/out/pack
    rm -rf "$stage"
    mkdir -p "$stage/bin" "$stage/extra"
    cd "$root"
    if [ -d "$(rustc --print sysroot)/lib/rustlib/$musl" ]; then
        host=$musl
    elif [ -n "$(find /usr/lib /usr/lib64 -name libc.a -print -quit 2>/dev/null)" ]; then
        # No musl here, but a static C library of the GNU kind will do.
        export RUSTFLAGS="${RUSTFLAGS:-} -C target-feature=+crt-static"
    else
        echo "NOTE: a program that needs this machine's C library or a newer one: $(ldd --version | head -n 1)"
    fi
    cargo build --release --example records --target "$host"
    cp "${CARGO_TARGET_DIR:-target}/$host/release/examples/records" "$stage/bin/"
    strip "$stage/bin/records"
    cp -r "$here/sdim_training" "$here/run.sh" "$stage/"
    find "$stage" -name __pycache__ -prune -exec rm -rf {} +
    for path in ${EXTRA:-}; do
        cp -rL "$path" "$stage/extra/"
    done
    XZ_OPT="${XZ_OPT:--6}" tar -C "$stage" -cJf "$out/pack.tar.xz" .
    size=$(stat -c %s "$out/pack.tar.xz")
    echo "$out/pack.tar.xz: $size bytes, $(file -b "$stage/bin/records" 2>/dev/null | cut -d, -f 1-4)"
    if [ "$size" -gt 50000000 ]; then
        echo "more than 50 MB: less in EXTRA" >&2
        exit 1
    fi
}

run() {
    : "${OUT:?where results go}"
    local begin end python=${PYTHON:-python3}
    begin=$(date +%s)
    end=$((begin + ${SECONDS_TOTAL:-600}))
    mkdir -p "$OUT"
    OUT=$(cd "$OUT" && pwd)
    work=${WORK:-$(mktemp -d)} renderer=
    trap collect EXIT
    exec > >(tee -a "$OUT/log.txt") 2>&1
    pack=$here
    if [ ! -x "$here/bin/records" ]; then
        pack=$work/pack
        mkdir -p "$pack"
        tar -C "$pack" -xJf "${1:-$here/out/pack.tar.xz}"
    fi
    local threads=${THREADS:-$(nproc)} gpus=${GPUS:-$(nvidia-smi -L 2>/dev/null | grep -c ^GPU || true)}
    local held=${HELD_FRAMES:-256} shape=${SHAPE:-small} extra=${RECORDS_ARGS:-}
    shape=${shape//@extra/$pack/extra} extra=${extra//@extra/$pack/extra}
    echo "$(nproc) cores, $gpus GPUs, $($python -c 'import torch; print("PyTorch", torch.__version__)'), $work: $(df -h --output=avail "$work" | tail -n 1) free"

    local records=("$pack/bin/records" --shape "$shape" --size "${SIZE:-384x288}" --prompt "${PROMPT:-512}"
        --questions "${QUESTIONS:-128}" --points "${POINTS:-40,1500}" --shard "${SHARD:-64}" --seed "${SEED:-7}"
        --threads "$threads")
    read -r -a extra <<<"$extra"
    records+=(${extra[@]+"${extra[@]}"})
    local init=${INIT:-$work/fresh} points
    [ -n "${INIT:-}" ] || "${records[@]}" --fresh "$init"
    for points in 100 500; do
        "${records[@]}" --out "$work/held/$points" --held-out "$points" --count "$held" --questions 1024
    done
    "${records[@]}" --out "$work/pictures" --held-out 500 --grid 4 --count 6 --shard 6
    # The renderer makes way for the trainer's threads.
    nice -n 10 "${records[@]}" --out "$work/train" --count 100000000 --variants "${VARIANTS:-4}" \
        --max-gb "${MAX_GB:-30}" --seconds $((end - $(date +%s) - 15)) &
    renderer=$!

    local launch=("$python" -m sdim_training.train)
    [ "${gpus:-0}" -le 1 ] || launch=("$python" -m torch.distributed.run --standalone --nproc-per-node "$gpus" -m sdim_training.train)
    export PYTHONPATH=$pack OMP_NUM_THREADS=${OMP_NUM_THREADS:-4} TORCHINDUCTOR_CACHE_DIR=$work/inductor PYTHONUNBUFFERED=1
    # The trainer itself ends in time; a signal makes it save and end, should it be late.
    # shellcheck disable=SC2086
    timeout --kill-after=5 --signal=TERM $((end - $(date +%s) - 10)) "${launch[@]}" --records "$work/train" --init "$init" \
        --out "$work/out" --held-out "$work/held/100" "$work/held/500" --pictures "$work/pictures" --follow \
        --wait-frames "${WAIT_FRAMES:-1024}" --batch "${BATCH:-64}" --rate "${RATE:-1.5e-3}" --seed "${SEED:-7}" \
        --until $((end - 15)) ${TRAIN_ARGS:-} || echo "the trainer ended with $?"
    echo "$(($(date +%s) - begin)) s of ${SECONDS_TOTAL:-600}"
}

# Whatever happened, what is there goes to OUT.
collect() {
    trap - EXIT
    [ -z "$renderer" ] || kill "$renderer" 2>/dev/null || true
    local from=$work/out stage=$work/stage
    mkdir -p "$stage/last"
    for name in result.json curve.csv curve.png; do
        [ ! -f "$from/$name" ] || cp "$from/$name" "$OUT/"
    done
    # shellcheck disable=SC2012
    ls "$from"/samples/*.png 2>/dev/null | tail -n 2 | xargs -r cp -t "$OUT/"
    for name in config.json preprocessor_config.json sdim.json tokenizer.json model.safetensors; do
        [ ! -f "$from/$name" ] || cp "$from/$name" "$stage/last/"
    done
    [ ! -d "$from/best" ] || cp -r "$from/best" "$stage/"
    rm -f "$OUT"/checkpoint.tar.part-*
    tar -C "$stage" -c . | split -b 15000000 - "$OUT/checkpoint.tar.part-"
    # shellcheck disable=SC2012
    ls -l "$OUT" | tail -n +2
    [ -n "${WORK:-}" ] || rm -rf "$work"
}

case "${1:-}" in
pack) pack ;;
run) shift && run "$@" ;;
*) sed -n '2,16p' "$0" && exit 2 ;;
esac
