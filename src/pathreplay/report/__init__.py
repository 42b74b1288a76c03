"""Reports: figures and pages of a run, while it goes on and when it has ended."""
