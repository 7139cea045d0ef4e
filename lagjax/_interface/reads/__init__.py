"""The values that a user's function reads: its code, and all values from outside of it, directly or through helpers.

    Walk      visits a function and all that it uses: globals, closures, attributes, helpers, classes, arrays
    identity  the result as text, the same in every process: a stored sweep detects by it that `keep` has changed
    Edition   a function with all that it read at one time: results derived from it are valid until that changes

**What is seen.** Numbers, texts, arrays, containers, functions, classes and objects that the code names: globals, also
of helpers in the user's other modules, closure cells, defaults, keywords of `functools.partial`, attributes of objects
and functions, modules imported inside. Installed packages are named, not read.

**What is not seen.** Files and environment variables that a function reads while it runs, `globals()["c"]` and other
computed names, the inside of objects written in C (a generator, a random generator, a lock), and what `functools.cache`
or another cache of the user's own keeps.

`Walk` and `identity` are in `_identity`, which reads byte code, `Edition` in `_edition`; `_marks` makes checks fast.
"""

from lagjax._interface.reads._edition import Edition
from lagjax._interface.reads._identity import array_text, hash_of, identity, index_of, source_text, strip_addresses
