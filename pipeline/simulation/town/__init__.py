"""Procedural towns: a random generator comes in, a World around one large building goes out.

`town.py` puts a town together: `streets.py` lays out a grid of streets, `blocks.py` fills the
blocks between them (`houses.py`, `buildings.py`, `grounds.py`, `sports.py`), `landmark.py` builds
the large building in the middle. Everything is painted on a `Canvas`; a `Plot` is one block with
its town's style. All towns share the colours of `palette.py`.

Begin with `town.py`.
"""
