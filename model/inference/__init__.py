"""The encoder for embedding: fast, and checked against the plain one.

In: an encoder in evaluation mode, and a few images. Out: a FastEncoder of images as bytes to unit
embeddings, in a stated precision. `embed.py` has the reference and the fast form, `optimise.py`
builds and checks it, `fuse_batchnorm.py`, `openvino_runtime.py`, `compile.py` and `int8.py` are the
ways to make it fast, `precision.py` names the precisions. Begin with `optimise.py`.
"""
