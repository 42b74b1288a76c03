"""Run folders: the files of a job, and the lock that gives one process write access."""
