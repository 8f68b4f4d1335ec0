"""The command line that all jobs share.

In: a job's function and sys.argv. Out: the function's call with validated settings, one sentence
and exit code 2 on bad input. `cli.py` parses and runs (`run`), `config.py` reads and prints
settings as YAML (`--config`, `--print-config`), `signals.py` raises Ctrl-C and SIGTERM until they
come through, `pvda.py` is the command `pvda NAME ...`. Nothing here imports torch or Ray: `--help`
and refused flags return in under a second. Begin with `cli.py`.
"""
