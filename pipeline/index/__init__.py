"""FAISS indexes: a feature table in, an index on disk out, opened for searching.

In: a feature table and a memory budget (`build.build_index`). Out: a folder with FAISS files, the
ids of their rows, and `index.json`; `searcher.Index` opens it and finds hits, `distributed` spreads
it over a cluster, `update` extends, reduces and verifies it.

Begin with `planning/`, which chooses the kind of index; then `build.py`, the stage, which trains
(`train.py`), builds work units (`units.py`, `workspace.py`) and measures recall (`tuning/`,
`finish.py`); then `searcher.py` and `part.py`, one search. `metadata.py` has the fields of
`index.json`.
"""
