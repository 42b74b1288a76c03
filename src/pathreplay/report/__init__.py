"""Reports: figures and web pages about a run, during the run and after its end."""
