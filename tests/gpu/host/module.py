#!/usr/bin/env python3
"""A shared library of the kernels of a CUDA C file, compiled as C++ for the CPU.

    module.py SOURCE.cu OUT.so [ARGUMENT FOR g++]...

It holds `host_kernels`: names, and functions that call a kernel with arguments as `cuLaunchKernel` takes them.
"""
import pathlib
import re
import subprocess
import sys

HERE = pathlib.Path(__file__).parent
# Found again in what the preprocessor makes of macros.
MARK = "HOST_GLOBAL"
TABLE = """
namespace {
template <class... A, size_t... I> void host_call(void (*kernel)(A...), void **p, std::index_sequence<I...>) {
    kernel(*(std::remove_const_t<A> *)p[I]...);
}
template <class... A> void host_call(void (*kernel)(A...), void **p) {
    host_call(kernel, p, std::index_sequence_for<A...>());
}
}
struct HostKernel { const char *name; void (*call)(void **); };
extern "C" const HostKernel host_kernels[] = {
%s    {nullptr, nullptr},
};
"""


def main():
    source, out, *arguments = sys.argv[1:]
    # As CUDA C, memory may be read as another type than it was written as.
    common = ["g++", "-std=c++17", "-x", "c++", "-w", "-fno-strict-aliasing", "-I", str(HERE), *arguments]
    text = '#include <type_traits>\n#include <utility>\n#include "device.h"\n' + pathlib.Path(source).read_text()
    folder = str(pathlib.Path(source).resolve().parent)
    expanded = subprocess.run(
        [*common, "-I", folder, f"-D__global__={MARK}", "-E", "-P", "-"], input=text, stdout=subprocess.PIPE, text=True, check=True
    ).stdout
    names = re.findall(rf'extern\s+"C"\s+{MARK}\s+void\s+(\w+)\s*\(', expanded)
    entries = "".join(f'    {{"{n}", [](void **p) {{ host_call({n}, p); }}}},\n' for n in names)
    code = re.sub(rf"\b{MARK}\b", "", expanded) + TABLE % entries
    # As the device does without being told otherwise, products and sums may be contracted.
    subprocess.run([*common, "-O2", "-fPIC", "-shared", "-fpreprocessed", "-o", out, "-"], input=code, text=True, check=True)


main()
