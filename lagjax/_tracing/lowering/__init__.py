"""Lowering: what each primitive of a jaxpr does to arrays of node ids.

`_rules` has most primitives, `_indexing` those that index arrays, `_matrices` linear algebra, `_complex` complex
numbers as pairs. Their rules are registered by `lowers` when the modules are imported, which `_tracing` does.
"""
