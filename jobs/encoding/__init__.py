"""Encoders of the jobs: a checkpoint in, embeddings of shards or of photos out.

In: a checkpoint's bytes, and the settings of encoding or the encoding that an index records. Out:
an `EncoderSpec` for the embedding stage (`encoder.py`), or a `PhotoEncoder` for photos
(`photo_encoder.py`) that `queries.py` reads from any storage.

Begin with `encoder.py`; `probe_images.py` has the images by which encoders are checked.
"""
