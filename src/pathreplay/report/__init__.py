"""Reports: figures and pages of a run, during the run and after its end."""
