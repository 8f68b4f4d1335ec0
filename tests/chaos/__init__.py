"""The fault campaign: real jobs are killed, their storage fails, their files are damaged.

`stages.py` lists the jobs, `faults.py` the faults, `workspace.py` runs jobs in scratch folders,
`campaign.py` runs one trial and compares content, `test_chaos.py` is the short campaign and
`python -m tests.chaos` the long one. `hook/` injects storage faults into every Python process.
"""
