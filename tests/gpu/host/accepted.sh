#!/usr/bin/env bash
# Whether nvcc, NVRTC and g++ take our kernels: PTX for each architecture, for the oldest one, and C++ for the CPU.
#
#   CUDA_HOME=... tests/gpu/host/accepted.sh
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
for source in "$here"/../../../src/kernels/cuda/*.cu; do
    for architecture in sm_80 sm_86 sm_89 sm_90; do
        "$CUDA_HOME/bin/nvcc" -ptx -Werror all-warnings -arch=$architecture -o "$out/kernels.ptx" "$source"
        echo "$(basename "$source") $architecture: $(grep -c '\.visible \.entry' "$out/kernels.ptx") kernels"
    done
    echo "$(basename "$source") NVRTC: $(LD_LIBRARY_PATH=$CUDA_HOME/lib64 python3 "$here/nvrtc.py" libnvrtc.so "$source")"
    python3 "$here/module.py" "$source" "$out/kernels.so"
    echo "$(basename "$source") g++: $(nm -D "$out/kernels.so" | grep -cw host_kernels) table of kernels"
done
