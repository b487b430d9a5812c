"""Whether NVRTC takes a CUDA C file as the crate gives it: without headers or options. `nvrtc.py LIBRARY SOURCE.cu`"""

import ctypes
import pathlib
import sys
import time

library = ctypes.CDLL(sys.argv[1])
source = pathlib.Path(sys.argv[2]).read_bytes()
program = ctypes.c_void_p()
start = time.time()
assert library.nvrtcCreateProgram(ctypes.byref(program), source, None, 0, None, None) == 0
code = library.nvrtcCompileProgram(program, 0, None)
size = ctypes.c_size_t()
if code != 0:
    library.nvrtcGetProgramLogSize(program, ctypes.byref(size))
    log = ctypes.create_string_buffer(size.value)
    library.nvrtcGetProgramLog(program, log)
    sys.exit(log.value.decode())
assert library.nvrtcGetPTXSize(program, ctypes.byref(size)) == 0
ptx = ctypes.create_string_buffer(size.value)
assert library.nvrtcGetPTX(program, ptx) == 0
text = ptx.value.decode()
head = " ".join(line for line in text.splitlines() if line.startswith((".version", ".target")))
print(f"{text.count('.visible .entry')} kernels, {head}, {time.time() - start:.2f} s")
