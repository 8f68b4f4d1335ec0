"""Numbers that separate right answers from wrong ones -> probabilities.

In: features of answers whose truth is known. Out: a model of their probability (`logistic.py`), the
threshold to answer at (`cross_validation.py`), and whether the probabilities come true
(`reliability.py`). NumPy only, no I/O. The answer's own room, `locate`, and `matching` choose the
features.
"""
