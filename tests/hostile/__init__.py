"""Hostile input: a seeded generator of cases, processes to run them in, and the rule by which each is judged.

`python -m tests.hostile --help` runs all of them or one; `test_hostile.py` is the test. A case is a room (a copy of a
folder with a job that works), one thing in it that is wrong, and a command or script that meets it.
"""
