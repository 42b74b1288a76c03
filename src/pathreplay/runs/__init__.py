"""Run folders: the files of a run, and the lock that gives write access to one process."""
