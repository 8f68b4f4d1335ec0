"""Stages that need the network and the pipeline, other than training.

In: settings (`settings.py`, which imports nothing heavy). Out: files at the paths that the
settings name. One file per job: locate, calibrate, serve, import_weights, export_weights, demo,
and what make_shards, evaluate and compare print beside the pipeline's own stage. Each is a
function from settings to files, to be called from a notebook too; `jobs/NAME.py` imports it after
the command line was parsed. Begin with `locate.py`.
"""
