"""Which FAISS index a gallery gets: the table of families, their plans, and the trial of a plan.

In: rows, dimension, memory, recall, latency and time to build. Out: the plan, what was rejected and
why, and the Pareto front of what was tried. Begin with `plan.py`; `families.py` has the table,
`trial.py` tries a plan on a sample of the table, `choice.py` chooses among the trials,
`planner.py` leads from a table to the plan.
"""
