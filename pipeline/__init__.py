"""Images and vectors in motion: folder -> shards -> batches -> feature table -> index -> answer.
Never imports model.
"""
