"""Prints the folders in which CUDA's run-time libraries lie, for LD_LIBRARY_PATH: those of PyTorch's wheels, of a toolkit, of the driver."""

import glob
import os
import site
import sys

NAMES = ("libcublas.so*", "libcublasLt.so*", "libcudart.so*", "libcurand.so*", "libnvrtc.so*")


def main():
    roots = [os.path.join(root, "nvidia", "*", "lib") for root in [*site.getsitepackages(), *sys.path] if root]
    roots += ["/usr/local/cuda*/lib64", "/usr/local/cuda*/targets/x86_64-linux/lib", "/usr/local/nvidia/lib*", "/usr/lib/x86_64-linux-gnu"]
    found = []
    for pattern in roots:
        for folder in sorted(glob.glob(pattern)):
            holds = any(glob.glob(os.path.join(folder, name)) for name in (*NAMES, "libcuda.so.1"))
            if holds and folder not in found:
                found.append(folder)
    print(":".join(found))


main()
