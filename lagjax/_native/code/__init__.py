"""The words of machine code, which know nothing of a motion.

_constants    every numerical choice, with its reason
_objects      machine code kept on disk
_ir           LLVM's instructions, written like arithmetic
_frame        the memory of a thread, the lanes and the job, as a function of a kernel sees them
_loops        loops and decisions over numbers, written in Python, as machine code
"""
