"""The values that a function reads: its code, and the values that it takes from outside, however far away they are.

    Walk      goes through a function and all that it uses: globals, closures, attributes, helpers, classes, arrays
    identity  that as a text, the same in every process: a store of a sweep tells by it whether `keep` has changed
    Edition   a function as it is now, with what it reads: what is derived from it serves while that is the same

**What is seen.** Numbers, texts, arrays, containers, functions, classes and objects that the code names: globals, also
of helpers in the user's other modules, closure cells, defaults, keywords of `functools.partial`, attributes of objects
and functions, modules imported inside. Installed packages are named, not read.

**What is not seen.** Files and environment variables that a function reads while it runs, `globals()["c"]` and other
names that it makes up, the inside of objects written in C (a generator, a random generator, a lock), and what
`functools.cache` or another memory of the user's own keeps.

`Walk` and `identity` stand in `_identity`, which reads byte code for them, `Edition` in `_edition`; `_marks` makes the
next look quick.
"""

from lagjax._interface.reads._edition import Edition
from lagjax._interface.reads._identity import array_text, hash_of, identity, place_in, source, strip_addresses
