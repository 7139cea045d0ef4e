"""The result of a fit: how well the parameters are determined, and what they predict.

`_result` is `Fit`. `_information` is the covariance with its null directions, `_identifiability` says these in words,
`_profile` is another way to intervals.
`_verdict` is the result of the search in words, with the records that pull at it, `_mistakes` those that explain a
poor one. `_prediction` follows other records, `_experiments` ranks planned ones, `_comparison` compares fits,
`_selection` chooses among candidate terms, `_evidence` finds how smooth learned functions are,
`_report` draws and writes.
"""
