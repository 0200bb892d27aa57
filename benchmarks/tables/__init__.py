"""Tables 1 and 2 of the 2006 paper on CMU clips: what is found, what it costs, and how it agrees with labels by eye.

    python -m benchmarks.tables --data DIR [-o OUTDIR]

DIR holds 02_01.bvh, 01_03.bvh and 49_20.bvh, at any depth. `labels` reads the labels, `scores` counts mislabelled
frames (Table 2), `costs` times the engine (Table 1), `pictures` draws what was found.
"""
