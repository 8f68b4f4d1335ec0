"""Shards -> batches of decoded images.

In: a `ShardSet` (room `shards`). Out: shuffled pairs of batches of both views for training, or the
samples of a shard decoded in their order for embedding; images as bytes (B, 3, H, W).
Begin in `training.py`: `TrainingStream.epoch`, and `TrainingStream.pipeline`, the webdataset
pipeline behind it, to which you can add stages of your own.
`sampler.py` plans which samples a rank reads in an epoch; `pairs.py` chooses those of pairs;
`pseudo_labels.py` puts found pairs in place of the labels; `ordered.py` decodes; `kept.py` keeps
decoded images in memory from epoch to epoch; `holdout.py` chooses the locations that are held out
of training.
"""
