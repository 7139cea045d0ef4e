"""The Taylor series of a motion: from the operations of a program to coefficients, and the memory of derivatives.

_lanes             the operations of a program on vectors, one by one: the form of small kernels
_tables            the form of large kernels: operations are data that one loop executes;  _schedule: their order
_table_reads       table entries, read from the parameters of a member
_guards            functions of the state that are watched, as programs
_motion_parts      the programs that a kernel is made from, and their series
_taylor            the coefficients of a motion, and values of its series within a step
_tangent_memory    the memory of tangents;  _cotangents: that of cotangents
"""
