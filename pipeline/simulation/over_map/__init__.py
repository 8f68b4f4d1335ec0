"""Simulated UAV photos over anybody's map.

In: a GeoTIFF, perhaps a surface model, and a seed. Out: photos with the tags that a camera writes,
and a table of the truth. Begin with `fly.py`, the stage; `poses.py` plans the photos,
`photo.py` takes one.
"""
