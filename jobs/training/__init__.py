"""Training: from shards and a recipe to a run's folder.

In: TrainSettings (`settings.py`), with a recipe (`recipes/`). Out: RUN/last.pt, metrics.jsonl,
config.yaml and TensorBoard. A step is four calls deep: the driver (`driver.py`) validates the
input and starts the workers, in this process or by Ray Train (`ray_group.py`); a worker
(`worker.py`) runs the epochs; the loop (`loop.py`) takes an epoch's steps; `Training.step` is in
model/training.py. Beside them: what a worker holds (`state.py`), checkpoints and metrics on disk
(`checkpoints.py`), metric sums (`metrics.py`), probes of held-out locations (`probes.py`), the
table of settings (`config_table.py`). Begin with `driver.py`.
"""
