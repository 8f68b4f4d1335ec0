"""How good a search is, and how thorough it must be.

In: an index that answers queries, and the feature table that it was built from. Out: recall against
exact search, with and without filters, queries per second and latencies; and the search parameters
of the least work that reach a recall.

Begin with `ground_truth.py`, the queries and what exact search finds for them; then `recall.py`,
which measures an index by them, and `search_params.py`, which chooses.
"""
