"""The means to emit machine code, independent of mechanics.

_constants    every numerical constant of the kernels, with its reason
_objects      compiled objects kept on disk
_ir           LLVM's instructions, written like arithmetic
_frame        a kernel function with named access to the memory of its thread, to lanes and to the job
_loops        loops and decisions over numbers, written in Python, as machine code
"""
