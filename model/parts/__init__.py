"""Building blocks between backbone and embedding.

In: maps (B, C, H, W) of a backbone. Out: one vector per part (B, P, C). `ring_pooling.py` has
LPN's square rings, the only part so far; another pooling is one file here.
"""
