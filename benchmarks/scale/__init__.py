"""Annotation of large folders: how fast, in how much memory, with how many compilations, and what is refused.

`python -m benchmarks.scale` makes a folder of clips of known kinds, has `kinjax annotate` work on it in a process of its own,
and sets its rate beside two others in the same run: the number blocks of the same files parsed and nothing else, by as many
processes; and a script of a public BVH package with the usual rule on toe speed. `--kills` takes the job down at random
times and compares stores; `--query` times questions to a store of many constraints.
"""
