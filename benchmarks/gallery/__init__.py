"""Runs thirteen examples and writes the gallery: docs/gallery.md, its images, and a record of times and machines.

    python -m benchmarks.gallery                     # all, one after the other
    python -m benchmarks.gallery glass-ball capture  # some of them
    python -m benchmarks.gallery real-sky --openexr-images FOLDER --pyrender FOLDER
    python -m benchmarks.gallery cloud --reuse       # draw the images again, from the last finished run
    python -m benchmarks.gallery --page              # write the page again, from the record

An example with data of other repositories is skipped unless options give the folders of their checkouts.
Runs are written to runs/gallery, and the record to benchmarks/gallery/record.json after each run. The machine has to
be idle: a run does not start while other processes are busy, and a time during which they became busy is not shown.
--busy starts a run nevertheless.
"""
