"""The search of a fit: from first values to the least squares.

`_descent` is one descent by Gauss–Newton, with the starts of records eliminated; `_adam` descends by gradients.
`_reader` reads states and time scales off the data, `_search` goes over segments that grow to whole records;
`_multistart` is for first values that are far off. `_unexplained` is the share of the signals that a trial leaves.
"""
