"""What every room stands on: the shared vocabulary, storage, files with checksums, and Ray.

In: paths (plain or URIs through fsspec), bytes, JSON, Parquet, calls to spread over a cluster.
Out: `ImageRecord`s and `Rejection`s, files that are written atomically and whose damage is found,
results of calls in the order they finish. This room imports no other.

Begin with `records` (what an image is) and `errors` (how a job refuses); then `storage`,
`json_files`, `parquet` and `integrity` (how files are written, checked and read); then `lock`,
`prefetch`, `progress`, `cluster` and `actor_pool` (how long work runs). `arrays` and `geo` hold
what many rooms need of NumPy and of the earth.
"""
