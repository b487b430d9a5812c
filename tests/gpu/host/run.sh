#!/usr/bin/env bash
# Runs a program that was built for CUDA on a machine without a GPU: `libraries.cpp` beside this file stands in for CUDA's libraries.
#
#   tests/gpu/host/run.sh PROGRAM [ARGUMENT...]      needs g++ and Python
#
# CUDA_HOME names the toolkit, whose headers candle's kernels include; SDIM_HOST_CUDA a folder for what is compiled.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
program=$1
shift
export SDIM_HOST_CUDA=${SDIM_HOST_CUDA:-$here/../out/host} SDIM_HOST_MODULE=$here/module.py
mkdir -p "$SDIM_HOST_CUDA"
name=$(printf '%s' "$program" | sha256sum | cut -c1-12)
libraries=$SDIM_HOST_CUDA/libraries-$name
if [ ! -e "$libraries/made" ] || [ "$program" -nt "$libraries/made" ] || [ "$here/libraries.cpp" -nt "$libraries/made" ]; then
    mkdir -p "$libraries"
    g++ -std=c++17 -O2 -fPIC -c -o "$libraries/known.o" "$here/libraries.cpp"
    # All other names of CUDA that the program wants answer that they are not supported: 801, `CUDA_ERROR_NOT_SUPPORTED`.
    nm --defined-only "$libraries/known.o" | awk '$2 == "T" { print $3 }' | sort >"$libraries/known"
    nm -D --undefined-only "$program" | awk '{ print $2 }' | sed 's/@.*//' |
        grep -E '^(cu[A-Z]|cublas|cublasLt|cuda[A-Z]|__cuda|curand|nvrtc)' | sort | comm -23 - "$libraries/known" |
        sed 's/.*/int &(void) { return 801; }/' >"$libraries/others.c"
    gcc -fPIC -c -o "$libraries/others.o" "$libraries/others.c"
    g++ -shared -o "$libraries/all.so" "$libraries/known.o" "$libraries/others.o" -ldl
    # What is built with the toolkit wants these files.
    for file in $(readelf -d "$program" | sed -n 's/.*NEEDED.*\[\(lib\(cu\|nvrtc\)[^]]*\)\]/\1/p'); do
        ln -sf all.so "$libraries/$file"
    done
    touch "$libraries/made"
fi
LD_LIBRARY_PATH=$libraries exec "$program" "$@"
