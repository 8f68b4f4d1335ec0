"""The pinhole camera over flat ground: pose, lens, footprint, and the homography between a photo
and the ground.

In: numbers that a camera or a simulator states of itself. Out: points of the ground, in metres or
degrees, and pixels. Begin with `pose.py` and `ground.py`; `lens.py` tells the field of view from a
photo's tags, `cameras.py` from a camera's name, `local_plane.py` turns metres into degrees,
`uncertainty.py` propagates errors, `map_window.py` puts tiles together into a north-up window.
Simulator, sources, matching and locate all use this room. NumPy, and OpenCV for pixels; no I/O.
"""
