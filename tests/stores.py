"""`sweep` with the arguments of its `Store` beside its own, so that a test changes either by name."""

import dataclasses

import lagjax

SETTLED = {field.name for field in dataclasses.fields(lagjax.Store)}


def run_sweep(system, over, ts, *, store, **arguments):
    settled = {name: arguments.pop(name) for name in SETTLED & set(arguments)}
    return lagjax.sweep(system, over, ts, store=lagjax.Store(store, **settled), **arguments)
