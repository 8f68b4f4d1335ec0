"""The networks and their training step; torch only (PVDA, arXiv 2401.01573).

In: images as bytes (B, 3, H, W). Out: maps, embeddings, and weights after a step. Knows no Ray, no
files but checkpoints' bytes, and nothing of `pipeline`. `config.py` has the settings, `pvda.py`
the networks, `losses.py` one function per equation, `schedule.py` alpha and learning rates,
`training.py` the two-step update, `checkpoint.py` weights and config as bytes. Rooms: `backbones/`
(images to maps), `parts/` (pooling), `inference/` (the encoder made fast), `weights/` (public
weights). Begin with `pvda.py`.
"""
