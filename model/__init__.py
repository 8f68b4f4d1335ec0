"""The networks and their training step; torch only (PVDA, arXiv 2401.01573).

In: images as bytes (B, 3, H, W). Out: maps, embeddings, and weights after a step. Knows no Ray, no
files but checkpoints' bytes, and nothing of `pipeline`. `config.py` has the settings, `pvda.py` the
networks, `schedule.py` alpha and learning rates, `optimizers.py` what the rates apply to,
`training.py` the two-step update, `checkpoint.py` weights and config as bytes. Rooms: `backbones/`
(images to maps), `parts/` (pooling), `losses/` (one function per formula), `inference/` (the
encoder made fast), `weights/` (public weights, and the built-in encoder's). Begin with `pvda.py`.
"""
