"""HTTP service: a photo in, an answer out. Knows Ray Serve and aiohttp, not the encoder.

In: an index (room `index`), and a function that makes the encoder of its images. Out: the answers
of room `locate` as JSON, a page for people, an OpenAPI document, health and Prometheus metrics.
Begin in `app.py`, the routes and limits of one request. Its way: `uploads.py` reads the body,
`request.py` validates it, `batcher.py` collects requests into batches, `replicas.py` sends a batch
to a process with a `Predictor` (`predictor.py`), which answers from a `LiveIndex` (`live_index.py`)
that may be replaced meanwhile. `engine.py` is the interface between the HTTP side and replicas.
`photo_map.py` matches photos with the pixels of that index's gallery. `pictures.py` serves these
pixels. `responses.py` defines the bodies of responses; `openapi.py` derives their schemas from it,
and `pages.py` serves the files of `web/`.
"""
