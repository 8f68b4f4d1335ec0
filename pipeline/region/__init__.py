"""An adapted region: what one can expect of its answers, as figures and as a page.

In: simulated photos of places that the encoder has not learned, their answers, and the truth. Out:
`expectation.py`: shares within metres, coverage, errors by height and pitch, with intervals;
`lookalikes.py`: places of the map that resemble each other; `page.py`: one HTML page of both.
`jobs/stages/adapt.py` makes a region.

Begin with `expectation.py`.
"""
