"""Feature tables: shards and an encoder in, a folder of Parquet parts with embeddings out.

In: a shard set and the spec of an encoder (`embed.embed_gallery`), or a .mat file of another
program (`import_mat.import_features`). Out: a table, opened by `table.open_table` and read in
blocks, by filters (`core.filters.Filter`), or row by row (`row_reader.RowReader`).

Begin with `part.py`, the columns and the footer of a part; then `table.py`, how a table is read;
then `embed.py`, the stage that fills one in three steps (plan, run, report), whose workers are in
`embed_worker.py` and whose books `table_writer.py` keeps. `encoding.py` is the record of how images
became embeddings, which every table carries.
"""
