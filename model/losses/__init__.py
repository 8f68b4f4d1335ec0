"""Losses: one function per formula, each with its source.

In: logits, verdicts or unit embeddings of a step's images. Out: a scalar to minimise, or its terms.
`pvda.py` has the paper's equations 1 to 4, `contrastive.py` the losses that compare the two views
row by row. Begin with `pvda.py`.
"""
