"""Exact retrieval and its measures: queries ranked against a gallery, by the official protocol.

In: feature tables (`features.table`). Out: one row per query and one row of metrics per task, as
Arrow tables and dictionaries; measures by number of views and by part of the embedding, and the gap
between two views.

Begin with `tasks.retrieve`, which ranks one task and measures it. `ranking` ranks, block by block
and on any number of workers; `exact_scores` makes its scores independent of the blocks. `metrics`
(Recall@K, AP), `geo_metrics` (metres, SDM@K) and `bootstrap` (95 % intervals) turn ranks into
figures. `subsets`, `views`, `parts` and `view_gap` measure variations of a task. `results` reads an
evaluation's JSON files back.
"""
