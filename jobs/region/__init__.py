"""From a map to a localizer: the stages of the other jobs on one's own map.

In: AdaptSettings (`settings.py`). Out: a folder with tiles, encoder, index, calibration and the
page that says what to expect. `adapt.py` has the order of the stages; `maps.py` tells its maps
apart, `flights.py` plans the simulated photos, `tuning.py` fine-tunes and chooses the encoder,
`alignment.py` aligns it with the UAV's own photos, `expect.py` locates photos of places that were
not learned.
"""
