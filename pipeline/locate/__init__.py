"""Photos -> answers: a position with its uncertainty, a calibrated probability, the candidates.

In: unit embeddings of photos and an opened index (room `index`). Out: `Answer` objects, and the
files made of them: GeoJSON, CSV, an HTML page.
Begin in `locate.py`: a search, the consensus of its best candidates (`consensus.py`), and the
probability of the answer (`calibration.py`).
Flights: `flight.py` decides uncertain photos by their neighbours, `track.py` has the recursions,
`movement.py` what lies between two candidates, `flight_places.py` their errors.
Calibration: `calibration_data.py` makes examples from photos of known locations, `calibrate.py`
fits them with the models of `logistic.py`, `reliability.py` measures the result.
Files: `photo_files.py` finds photos and their times, `geojson.py` and `page.py` write answers,
`gallery_map.py` and `page_map.py` put the gallery on a map.
"""
