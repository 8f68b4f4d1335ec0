"""Imagery <-> shards: tars in webdataset's layout with a manifest and a record table.

In: records of a source (room `sources`), or a folder of tars. Out: a set of shards on any storage;
its samples, images by key, and records.
Reading begins in `shard_set.py`: `open_shards` gives a `ShardSet`, and everything else reads
through it. Below it: `samples.py` and `tar_reader.py` (webdataset's iterators) behind
`tar_guard.py`, which refuses damaged and hostile tars; `external.py` for shards that others made.
Packing begins in `pack.py`: a scan, plans (`plan.py`), tars (`pack_tars.py`, `writer.py`),
duplicates and extensions (`duplicates.py`), and last the manifest. `verify.py` finds damage,
`repair.py` packs damaged shards again.
"""
