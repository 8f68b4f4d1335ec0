"""Photos of known places -> the calibration of an index.

In: photos with the places that they show, and an index. Out: a `Calibration`: `calibrate.py` fits
it to the candidates that the index returns (`calibration_data.py`), `fit_matching.py` to the photos
matched with the map. No I/O.
"""
