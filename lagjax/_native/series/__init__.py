"""The Taylor series of a motion, from the operations of a program to coefficients, and the memory of their tangents.

_lanes             the operations of a program on vectors, one by one: the form of small kernels
_tables            the form of large ones: operations are data that one loop walks along;  _schedule: their order
_table_reads       entries of tables, read from where the numbers of a member lie
_guards            functions of the state that are watched, as programs
_motion_parts      the programs that a kernel is made from, and their series
_taylor            the coefficients of a motion, and what is read off them along a step
_tangent_memory    the memory of tangents;  _cotangents: that of cotangents
"""
