"""The model of a fit: what is measured, what is free, and the residuals of one trial with their derivatives.

`_records` are measurements as the user gives them (`_inputs`: what drove the scene, `_timings`: instants of crossings,
`_sensor_faults`: what records show of their sensors), `_pieces` puts them in batches. `_parameters` are the free
numbers, `_transforms` keep them in a set, `_law_parameters` are those of functions whose numbers a fit chooses.
`_motions` follows the scene, `_signals` says what its sensors show (`_sensors`: delays, whole turns). `_residuals`
joins all that to the residuals of one trial; `_noise` is the law of their scatter, `_autocorrelation` what correlated
ones are worth, `_density` the posterior density that follows. `_assembly` makes the residuals out of what the user
gives; `_blas` keeps their linear algebra on one thread.
"""
