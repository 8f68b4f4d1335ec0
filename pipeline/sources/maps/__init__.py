"""Maps, for the sources that read them: where their pixels lie, and what their pixels show.

In: GeoTIFF mosaics, MBTiles files and the metadata of tile sets, GeoJSON and KML. Out: windows of
tiles (`tiles`), positions on WGS84 and the accuracy of datum shifts (`georeference`, `placement`),
8-bit RGB (`colours`, `mosaic`), row orders that agree with the bounds (`tile_metadata`).

Begin with `placement.py`, which decides whether a mosaic may be placed, and `mosaic.py`, which
reads its windows.
"""
