"""Part poolings: feature maps -> the parts of an image, each of which becomes a part of its
embedding.

In: maps (B, C, H, W) of a backbone, and its class token (B, C) where it has one. Out: P vectors an
image. A new pooling is one file here, with a class derived from `PartPooling`, and one line in
`POOLINGS`; `PVDAConfig.pooling` names it. `necks.py` turns each part into the numbers that are
compared. Begin with `base.py`, then read `ring_pooling.py`.
"""

POOLINGS: dict[str, str] = {
    "rings": "model.parts.ring_pooling:Rings",
    "mean": "model.parts.global_pooling:Mean",
    "gem": "model.parts.global_pooling:GeM",
    "heat_regions": "model.parts.heat_regions:HeatRegions",
    "cross_gates": "model.parts.cross_gates:CrossGates",
    "attended_rings": "model.parts.ring_attention:AttendedRings",
    "queries": "model.parts.queries:Queries",
}
"Module and class by name: command lines list them without loading torch."
