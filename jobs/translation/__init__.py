"""PCL's second stage: a GAN trained on pairs of the two views, and the shards that it translates.

In: shards whose UAV images have poses. Out: a generator's checkpoint, translated images, and shards
of them. Begin with `stage.py`.
"""
