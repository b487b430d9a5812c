#!/usr/bin/env bash
# Models in ten minutes, on a machine with a GPU, PyTorch and nothing else: no Rust, no network.
#
#   training/run.sh pack                    here: builds and packs what that machine needs (training/out/pack.tar.xz, at most 50 MB)
#   OUT=DIR training/run.sh run [PACK]      there: renders on all cores while it trains; ends within SECONDS_TOTAL
#
# What a run leaves in OUT, for each model of MODELS: results.tar.gz (logs, curves, results, samples of all of them) and
# checkpoints in pieces of at most 15 MB:
#   cat OUT/MODEL.tar.part-* | tar x -C DIR          (DIR/MODEL/last and DIR/MODEL/best are checkpoints that the crate loads)
#
# Settings, by the environment, with what they are without it:
#   MODELS=small: one or more, trained at the same time from the same records; all ask in the way of the first one
#   SECONDS_TOTAL=600  SIZE=384x288  PROMPT=512  QUESTIONS=128  VARIANTS=4  SHARD=64  BATCH=64  RATE=1.5e-3  POINTS=40,1500
#   MIX: procedural=0.5,furnished=0.35,streets=0.15 with furniture in the pack, procedural=0.85,streets=0.15 without;
#       glazed=SHARE adds panes of glass that sensors see through
#   HELD_MIX: mixes of the held-out sets, spaces between; procedural=1, and furnished=1 with furniture
#   HELD_FRAMES=128  WAIT_FRAMES=1024  MAX_GB=30  SEED=7  GPUS and THREADS: all; PYTHON=python3; WORK: a temporary folder
#   RECORDS_ARGS, TRAIN_ARGS, TRAIN_ARGS_MODEL: more arguments for the programs; INIT_MODEL: a checkpoint to start from,
#       what the shape has and it has not is initial
#   FURNITURE (pack): folder of a furniture library, of which FURNITURE_MB=28 travel; EXTRA (pack): files and folders that the
#   records need; MODELS, INIT_MODEL and RECORDS_ARGS name them as @extra/NAME; TARGET_CPU=x86-64-v3 (pack)
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
        RUSTFLAGS="${RUSTFLAGS:-} -C target-feature=+crt-static"
    else
        echo "NOTE: a program that needs this machine's C library or a newer one: $(ldd --version | head -n 1)"
    fi
    export RUSTFLAGS="${RUSTFLAGS:-} -C target-cpu=${TARGET_CPU:-x86-64-v3}"
    local built=${CARGO_TARGET_DIR:-target}/$host/release/examples examples=(--example records)
    [ -z "${FURNITURE:-}" ] || examples+=(--example furniture)
    cargo build --release "${examples[@]}" --target "$host"
    cp "$built/records" "$stage/bin/"
    strip "$stage/bin/records"
    cp -r "$here/sdim_training" "$here/run.sh" "$stage/"
    find "$stage" -name __pycache__ -prune -exec rm -rf {} +
    if [ -n "${FURNITURE:-}" ]; then
        "$built/furniture" --library "$FURNITURE" --pack "$stage/extra/furniture" --megabytes "${FURNITURE_MB:-28}"
    fi
    for path in ${EXTRA:-}; do
        cp -rL "$path" "$stage/extra/"
    done
    XZ_OPT="${XZ_OPT:--6}" tar -C "$stage" -cJf "$out/pack.tar.xz" .
    size=$(stat -c %s "$out/pack.tar.xz")
    echo "$out/pack.tar.xz: $size bytes, $(file -b "$stage/bin/records" 2>/dev/null | cut -d, -f 1-4)"
    if [ "$size" -gt 50000000 ]; then
        echo "more than 50 MB: less in EXTRA, or a smaller FURNITURE_MB" >&2
        exit 1
    fi
}

# The name of a model: that of its shape, or of the file that holds one.
named() {
    basename "$1" .json
}

# A name as a part of a variable's.
variable() {
    echo "${1//[^A-Za-z0-9_]/_}"
}

# Writes records; what all sets share is in the array `common`.
records() {
    "$pack/bin/records" "${common[@]}" ${extra[@]+"${extra[@]}"} "$@"
}

# Renders what models are scored on, all sets at once.
held_out() {
    local mix name points pids=() names=" " sets=()
    for mix in $held_mix; do
        name=${mix%%=*}
        case $names in
        *" $name "*) name=$name${#names} ;;
        *) sets+=("$name=1") ;;
        esac
        names="$names$name "
        for points in 100 500; do
            records --mix "$mix" --out "$work/held/$name-$points" --held-out "$points" --count "$held" \
                --shard 16 --questions 1024 &
            pids+=($!)
        done
    done
    local all=${sets[*]}
    records --mix "${all// /,}" --out "$work/pictures" --held-out 500 --grid 4 --count 6 --shard 6 &
    pids+=($!)
    for pid in "${pids[@]}"; do
        wait "$pid"
    done
}

# Trains one model; its number chooses the GPU where there are several.
train() {
    local name=$1 number=$2 launch=("$python" -m sdim_training.train) own
    own=TRAIN_ARGS_$(variable "$name")
    set +e
    if [ "${#models[@]}" -gt 1 ]; then
        [ "${gpus:-0}" -le 1 ] || export CUDA_VISIBLE_DEVICES=$((number % gpus))
    elif [ "${gpus:-0}" -gt 1 ]; then
        launch=("$python" -m torch.distributed.run --standalone --nproc-per-node "$gpus" -m sdim_training.train)
    fi
    local plain= status started
    # A machine whose compiler fails trains all the same, more slowly.
    while :; do
        started=$(date +%s)
        # The trainer itself ends in time; a signal makes it save and end, should it be late.
        # shellcheck disable=SC2086
        timeout --kill-after=4 --signal=TERM $((end - $(date +%s) - 12)) "${launch[@]}" --records "$work/train" \
            --init "$work/fresh/$name" --out "$work/out/$name" --held-out "$work"/held/* --pictures "$work/pictures" \
            --follow --wait-frames "${WAIT_FRAMES:-1024}" --batch "${BATCH:-64}" --rate "${RATE:-1.5e-3}" \
            --seed "${SEED:-7}" --until $((end - 18)) ${TRAIN_ARGS:-} ${!own:-} $plain 2>&1 | tee -a "$work/logs/log-$name.txt"
        status=${PIPESTATUS[0]}
        [ "$status" -ne 0 ] || break
        echo "the trainer of $name ended with $status after $(($(date +%s) - started)) s"
        [ -z "$plain" ] && [ $(($(date +%s) - started)) -lt 150 ] && [ $((end - $(date +%s))) -gt 60 ] || break
        plain=--no-compile
    done
}

run() {
    : "${OUT:?where results go}"
    begin=$(date +%s)
    end=$((begin + ${SECONDS_TOTAL:-600}))
    python=${PYTHON:-python3}
    mkdir -p "$OUT"
    OUT=$(cd "$OUT" && pwd)
    work=${WORK:-$(mktemp -d)} renderer=
    mkdir -p "$work/logs"
    trap collect EXIT
    exec > >(tee -a "$work/logs/log.txt") 2>&1
    pack=$here
    if [ ! -x "$here/bin/records" ]; then
        pack=$work/pack
        mkdir -p "$pack"
        tar -C "$pack" -xJf "${1:-$here/out/pack.tar.xz}"
    fi
    gpus=${GPUS:-$(nvidia-smi -L 2>/dev/null | grep -c ^GPU || true)} held=${HELD_FRAMES:-128}
    local shapes=${MODELS:-small} more=${RECORDS_ARGS:-} mix=procedural=0.85,streets=0.15 shape
    shapes=${shapes//@extra/$pack/extra} more=${more//@extra/$pack/extra} held_mix=procedural=1
    read -r -a extra <<<"$more"
    if [ -d "$pack/extra/furniture" ]; then
        extra+=(--library "$pack/extra/furniture")
        mix=procedural=0.5,furnished=0.35,streets=0.15 held_mix="procedural=1 furnished=1"
    fi
    mix=${MIX:-$mix} held_mix=${HELD_MIX:-$held_mix}
    read -r -a models <<<"$shapes"
    echo "$(nproc) cores, $gpus GPUs, PyTorch $("$python" -c 'import importlib.metadata as m; print(m.version("torch"))'), $work: $(df -h --output=avail "$work" | tail -n 1) free"

    common=(--size "${SIZE:-384x288}" --prompt "${PROMPT:-512}" --points "${POINTS:-40,1500}"
        --seed "${SEED:-7}" --threads "${THREADS:-$(nproc)}")
    local settings=() init
    for shape in "${models[@]}"; do
        init=INIT_$(variable "$(named "$shape")")
        init=${!init:-}
        records --shape "$shape" ${settings[@]+"${settings[@]}"} --fresh "$work/fresh/$(named "$shape")" \
            ${init:+--from "${init//@extra/$pack/extra}"}
        # All models ask in the way of the first one.
        settings=(--settings "$work/fresh/$(named "${models[0]}")/sdim.json")
    done
    common+=(--shape "${models[0]}" "${settings[@]}")
    # The renderer makes way for the held-out sets and for the trainers' threads.
    nice -n 10 "$pack/bin/records" "${common[@]}" ${extra[@]+"${extra[@]}"} --mix "$mix" --out "$work/train" \
        --count 100000000 --shard "${SHARD:-64}" --questions "${QUESTIONS:-128}" --variants "${VARIANTS:-4}" --max-gb "${MAX_GB:-30}" --seconds $((end - $(date +%s) - 20)) &
    renderer=$!
    held_out
    echo "$(($(date +%s) - begin)) s until training starts"

    export PYTHONPATH=$pack OMP_NUM_THREADS=${OMP_NUM_THREADS:-4} TORCHINDUCTOR_CACHE_DIR=$work/inductor PYTHONUNBUFFERED=1
    local number=0 trainers=()
    for shape in "${models[@]}"; do
        train "$(named "$shape")" "$number" &
        trainers+=($!)
        number=$((number + 1))
    done
    wait "${trainers[@]}" || true
    echo "$(($(date +%s) - begin)) s of ${SECONDS_TOTAL:-600}"
}

# A model's checkpoints in pieces; with its best one if that is another than the last.
pieces() {
    local name=$1 best=$2 from=$work/out/$1 stage=$work/stage/$1 file
    rm -rf "$stage" "$OUT/$name".tar.part-*
    mkdir -p "$stage/last"
    for file in config.json preprocessor_config.json sdim.json tokenizer.json model.safetensors; do
        [ ! -f "$from/$file" ] || cp "$from/$file" "$stage/last/"
    done
    if [ "$best" = yes ] && [ -d "$from/best" ] && ! cmp -s "$from/model.safetensors" "$from/best/model.safetensors"; then
        cp -r "$from/best" "$stage/"
    fi
    tar -C "$work/stage" -c "$name" | split -b 15000000 - "$OUT/$name.tar.part-"
}

# Whatever happened, what is there goes to OUT: seven pieces of checkpoints at most, and one file of all else.
collect() {
    [ "$BASHPID" = "$$" ] || return 0
    trap - EXIT
    set +e
    [ -z "$renderer" ] || kill "$renderer" 2>/dev/null
    local from name stage=$work/results
    rm -rf "$stage"
    mkdir -p "$stage"
    for from in "$work"/out/*; do
        [ -d "$from" ] || continue
        name=$(basename "$from")
        mkdir -p "$stage/$name"
        cp "$from"/{result.json,curve.csv,curve.png} "$stage/$name/" 2>/dev/null
        # shellcheck disable=SC2012
        ls "$from"/samples/*.png 2>/dev/null | tail -n 3 | xargs -r cp -t "$stage/$name/"
        pieces "$name" yes
    done
    if [ "$(find "$OUT" -name '*.tar.part-*' | wc -l)" -gt 7 ]; then
        for from in "$work"/out/*; do
            pieces "$(basename "$from")" no
        done
    fi
    cp "$work"/train/records.json "$stage/" 2>/dev/null
    # shellcheck disable=SC2012
    ls -l "$OUT" | tail -n +2
    echo "$(($(date +%s) - begin)) s in all"
    cp "$work"/logs/* "$stage/"
    tar -C "$stage" -czf "$OUT/results.tar.gz" .
    [ -n "${WORK:-}" ] || rm -rf "$work"
}

case "${1:-}" in
pack) pack ;;
run) shift && run "$@" ;;
*) sed -n '2,/^set -/{/^#/p}' "$0" && exit 2 ;;
esac
