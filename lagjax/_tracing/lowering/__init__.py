"""From JAX's operations to scalars: how each primitive of a jaxpr acts on arrays of node ids.

`_rules` has most of them, `_indexing` those that move numbers, `_matrices` linear algebra, `_complex` complex numbers
as pairs. Their rules are registered by `lowers` when they are imported, which the door of the room does.
"""
