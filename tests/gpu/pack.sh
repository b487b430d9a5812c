#!/usr/bin/env bash
# Builds what run.sh needs and packs it: out/payload.tar.xz beside this file, programs without symbols, fixtures, the bundled frame.
#
#   tests/gpu/pack.sh     with CUDA's compiler and libraries at hand: docs/gpu.md
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
cd "$here/../.."
programs=(complete throughput)
tests=(golden device number_tokens shared_prefix fusion complete bad_checkpoint)

# A build that was cut off leaves kernels without text, which would be found out on the device only.
whole() {
    local file
    for file in "$1"/*.ptx; do
        grep -q '\.visible \.entry' "$file" || { echo "$file holds no kernel: remove its folder and build again" >&2; return 1; }
    done
}

built=$(cargo build --release --features cuda $(printf -- '--example %s ' "${programs[@]}") --message-format json |
    python3 -c '
import json, sys
for line in sys.stdin:
    m = json.loads(line)
    if m.get("reason") == "build-script-executed" and "candle-kernels" in m["package_id"]: print("kernels", m["out_dir"])
    if m.get("reason") == "compiler-artifact" and m.get("executable"): print(m["target"]["name"], m["executable"])')
checked=$(cargo test --release --features cuda --no-run --lib $(printf -- '--test %s ' "${tests[@]}") --message-format json |
    python3 -c '
import json, sys
for line in sys.stdin:
    m = json.loads(line)
    if m.get("reason") != "compiler-artifact" or not m.get("executable"): continue
    # The unit tests are those of the library.
    if "test" in m["target"]["kind"]: print(m["target"]["name"], m["executable"])
    elif m["profile"]["test"]: print("lib", m["executable"])')
whole "$(awk '$1 == "kernels" { print $2 }' <<<"$built")"

stage=$(mktemp -d)
trap 'rm -rf "$stage"' EXIT
mkdir -p "$stage/bin" "$stage/tests/fixtures" "$stage/assets" "$here/out"
# A test and an example of one name: the test gets another one.
for name in "${programs[@]}"; do strip -o "$stage/bin/$name" "$(awk -v n="$name" '$1 == n { print $2 }' <<<"$built")"; done
for name in lib "${tests[@]}"; do strip -o "$stage/bin/test-$name" "$(awk -v n="$name" '$1 == n { print $2 }' <<<"$checked")"; done
cp -r assets/example "$stage/assets/"
cp -r tests/fixtures/qwen_small tests/fixtures/family "$stage/tests/fixtures/"
cp "$here/libraries.py" "$here/report.py" "$stage/"
mkdir -p "$stage/benches/peers"
cp benches/peers/shared_prefix.py benches/peers/compare.sh "$stage/benches/peers/"
# The programs have most of their bytes in common: the dictionary holds all of them.
tar -C "$stage" -cf - . | xz -T1 --lzma2=preset=1,dict=384MiB >"$here/out/payload.tar.xz"
ls -l "$here/out/payload.tar.xz"
