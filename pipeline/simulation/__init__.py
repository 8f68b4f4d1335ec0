"""Simulated flights: training data without imagery, or over real overhead images.

In: `SimulationSettings`; perhaps a folder of overhead images with height maps. Out: a data set in
University-1652's layout, with geotags, camera poses and the settings that made it.

`simulate.py` is the stage: it plans locations, runs them as Ray tasks and resumes. `location.py`
makes one location's images: a world (`town/` draws procedural towns, `texture.py` uses an overhead
image), a day (`appearance.py`, `shadows.py`), a flight (`flight.py`), the renderer (`scene.py`,
`render.py`, `walls.py`). `layout.py` writes the files.

Begin with `location.py`, then `world.py`, the interface between worlds and the renderer.
"""
